"""Every fault: what the person sees, that the rig stands still and dark, what is on disk, and that resuming completes.

With REFLECTSEP_FAULT_TABLE=FILE the rows of the table are appended to FILE.
"""

import dataclasses
import errno
import json
import re
import signal
import termios
from types import SimpleNamespace

import numpy as np
import pytest
import serial

from reflectsep.errors import ReflectsepError, SettingsError
from reflectsep.rig import runner as runner_module
from reflectsep.rig import session as session_module
from reflectsep.rig.backends import build
from reflectsep.rig.devices import RawFrame
from reflectsep.rig.session import Session, read_events

from .conftest import NAMES, complete, whole


def at_sweep(rig, poll, action):
    rig.hooks[poll] = action


def breaks(rig, where, error):
    rig.line_errors[where] = error


def no_space(path, *rest):
    raise OSError(errno.ENOSPC, "No space left on device", str(path))


MOVING = 120
"""Poll of the camera at which the stage is on its way over the object."""

LOST = "THE STAGE MAY STILL BE MOVING"


def unplug(where, error):
    def inject(rig, monkeypatch):
        at_sweep(rig, MOVING, lambda: breaks(rig, where, error))

    return inject


def alarm(code, dead):
    def inject(rig, monkeypatch):
        at_sweep(rig, MOVING, lambda: rig.bench.board.alarm(code, dead=dead))

    return inject


def send(data):
    """Bytes into the board, as from another program on the same line."""

    def inject(rig, monkeypatch):
        at_sweep(rig, MOVING, lambda: rig.bench.board.receive(data, rig.bench.clock.now()))

    return inject


def press(*signals):
    def inject(rig, monkeypatch):
        def act():
            for number in signals:
                signal.raise_signal(number)

        at_sweep(rig, MOVING, act)

    return inject


def press_twice(rig, monkeypatch):
    stage = rig.devices.stage
    held = stage._board.hold

    def again():
        signal.raise_signal(signal.SIGINT)
        return held()

    monkeypatch.setattr(stage._board, "hold", again)
    at_sweep(rig, MOVING, lambda: signal.raise_signal(signal.SIGINT))


def press_while_stopping(rig, monkeypatch):
    """The camera dies, and somebody presses Ctrl-C while the stage is being held."""
    press_twice(rig, monkeypatch)
    rig.hooks.clear()
    camera_dies(rig, monkeypatch)


def press_while_homing(rig, monkeypatch):
    board = rig.bench.board
    advance = board.advance

    def watch(now):
        if board._homing is not None and not rig.told_homing:
            rig.told_homing = True
            signal.raise_signal(signal.SIGINT)
        advance(now)

    rig.told_homing = False
    monkeypatch.setattr(board, "advance", watch)


def press_while_writing(rig, monkeypatch):
    from reflectsep.io import files

    def act():
        sync = files._sync

        def interrupted(path):
            monkeypatch.setattr(files, "_sync", sync)
            signal.raise_signal(signal.SIGINT)
            sync(path)

        monkeypatch.setattr(files, "_sync", interrupted)

    at_sweep(rig, MOVING, act)


def full_disk(what):
    def inject(rig, monkeypatch):
        def act():
            if what == "frame":
                from reflectsep.rig import frames

                monkeypatch.setattr(frames, "write_picture", no_space)
            elif what == "log":
                monkeypatch.setattr(session_module.os, "write", no_space)
            else:
                monkeypatch.setattr(session_module, "write_json", no_space)

        at_sweep(rig, MOVING, act)

    return inject


def override(rig, monkeypatch):
    rig.bench.board.override = 90
    power_on = rig.bench.board.power_on

    def keep(now):
        power_on(now)
        rig.bench.board.override = 90

    monkeypatch.setattr(rig.bench.board, "power_on", keep)


def stall(rig, monkeypatch):
    def slip():
        rig.bench.board.slip_mm = 1.5

    at_sweep(rig, MOVING, slip)


def wrong_size(rig, monkeypatch):
    rig.change = lambda frame: [dataclasses.replace(frame, pixels=frame.pixels[:-1])]


def torn(rig, monkeypatch):
    rig.change = lambda frame: [dataclasses.replace(frame, pixels=None, fault="missing-packets")]


def dropped(rig, monkeypatch):
    rig.change = lambda frame: [] if frame.sequence % 3 == 0 else [frame]


def camera_dies(rig, monkeypatch):
    from reflectsep.errors import CameraError

    def die():
        raise CameraError("camera: no longer there")

    at_sweep(rig, MOVING, die)


def drifting(rig, monkeypatch):
    at_sweep(rig, MOVING, lambda: setattr(rig.devices.camera, "_exposure_s", 0.012))


def light_lies(rig, monkeypatch):
    from reflectsep.errors import LightsError

    def lie(light):
        if light == "L2":
            raise LightsError("lights: L2 was asked for, but 'L3' is on")
        return switch(light)

    switch = rig.devices.lights.switch
    monkeypatch.setattr(rig.devices.lights, "switch", lie)


def freeze(rig, monkeypatch):
    at_sweep(rig, MOVING, lambda: setattr(rig, "frozen", True))


def lose_ok(rig, monkeypatch):
    rig.eat.append(b"ok\r\n")


def lose_last_ok(rig, monkeypatch):
    at_sweep(rig, MOVING, lambda: rig.eat.append(b"ok\r\n"))


def silent(rig, monkeypatch):
    monkeypatch.setattr(rig.bench.board, "transmit", lambda now: b"")


def foreign(rig, monkeypatch):
    told = []
    monkeypatch.setattr(
        rig.bench.board, "transmit", lambda now: b"" if told else told.append(1) or b"start\r\necho:M\r\n"
    )


def cannot_open(error):
    def inject(rig, monkeypatch):
        def refuse(port, **options):
            raise error

        rig.devices.stage._link._opener = refuse

    return inject


def slow_homing(rig, monkeypatch):
    rig.bench.board.homing_s = 500.0


def homing_off(rig, monkeypatch):
    rig.bench.board.settings[22] = 0


def never_homed(rig, monkeypatch):
    """A driver that forgot to home meets the boot lock."""
    monkeypatch.setattr(rig.devices.stage, "home", lambda: setattr(rig.devices.stage, "_known", True))


def refused(answer):
    def inject(rig, monkeypatch):
        move = rig.bench.board._move
        sent = []

        def deny(asked):
            sent.append(1)
            return answer if len(sent) > 6 else move(asked)

        monkeypatch.setattr(rig.bench.board, "_move", deny)

    return inject


FAULTS = {
    "unplugged, at read": (unplug("read", serial.SerialException("device reports readiness but")), LOST, "moving?"),
    "unplugged, at write": (unplug("write", serial.SerialException("write failed")), LOST, "moving?"),
    "unplugged, at in_waiting": (unplug("in_waiting", OSError(5, "Input/output error")), LOST, "moving?"),
    "unplugged, at flush": (unplug("flush", termios.error(5, "Input/output error")), LOST, "moving?"),
    "port absent": (cannot_open(serial.SerialException("No such file: 'board'")), "cannot be opened", "safe"),
    "port busy": (cannot_open(serial.SerialException("Could not exclusively lock")), "exclusively lock", "safe"),
    "not a GRBL": (foreign, "no GRBL banner in 6 s: it says 'start'", "safe"),
    "silent port": (silent, "no GRBL banner in 6 s: it is silent", "safe"),
    "lost ok to a line": (lose_ok, "no answer to .* in 3 s", "safe"),
    "lost ok at the end": (lose_last_ok, "no end of the motion in time", "safe"),
    "frozen board": (freeze, "the board is frozen", "moving?"),
    "homing takes too long": (slow_homing, r"no answer to \$H in 90 s", "safe"),
    "homing is off (error 5)": (homing_off, r"\$H was refused: error:5 \(homing is switched off", "safe"),
    "ALARM 1 in a sweep": (alarm(1, True), r"ALARM:1 \(a limit switch was hit", "safe"),
    "ALARM 2 in a sweep": (alarm(2, True), r"ALARM:2 \(the motion would leave", "safe"),
    "ALARM 3 in a sweep": (send(b"\x18"), r"ALARM:3 \(it was reset while moving", "safe"),
    "boot lock, error 9": (never_homed, "state Alarm, expected Idle before a motion", "safe"),
    "error 9 to a motion": (refused("error:9"), r"error:9 \(locked", "safe"),
    "error 15 to a motion": (refused("error:15"), r"error:15 \(the jog leaves the travel\)", "safe"),
    "error 22 to a motion": (refused("error:22"), r"error:22 \(no feed rate was given\)", "safe"),
    "power cut of the board": (
        lambda rig, m: at_sweep(rig, MOVING, lambda: rig.bench.board.power_on(rig.bench.clock.now())),
        "the board was reset",
        "safe",
    ),
    "stalled motor": (stall, "homing found the carriage .* its motor stalled", "safe"),
    "feed override 90 %": (override, "feed override of the stage is 90 %", "safe"),
    "noise to the board": (
        lambda rig, m: at_sweep(rig, MOVING, lambda: setattr(rig, "noise_out", b"\x00\xfe")),
        "was refused: error:1",
        "safe",
    ),
    "feed hold by hand": (send(b"!"), "is in state Hold:. in the middle of a motion", "safe"),
    "safety door opened": (send(b"\x84"), "is in state Door:. in the middle of a motion", "safe"),
    "Ctrl-C once": (press(signal.SIGINT), "SIGINT", "safe"),
    "Ctrl-C twice": (press_twice, "SIGINT", "safe"),
    "Ctrl-C while an error is handled": (press_while_stopping, "no longer there", "safe"),
    "Ctrl-C while homing": (press_while_homing, "SIGINT", "safe"),
    "Ctrl-C while a frame is written": (press_while_writing, "SIGINT", "safe"),
    "SIGTERM": (press(signal.SIGTERM), "SIGTERM", "safe"),
    "disk full at a frame": (full_disk("frame"), "No space left on device; the rig is stopped", "safe"),
    "disk full at the log": (full_disk("log"), "No space left on device; the rig is stopped", "safe"),
    "disk full at the manifest": (full_disk("manifest"), "No space left on device; the rig is stopped", "safe"),
    "frames of a wrong size": (wrong_size, "none of them whole", "safe"),
    "torn frames": (torn, "none of them whole", "safe"),
    "a third of the frames dropped": (dropped, "of 20 frames were lost", "safe"),
    "camera dies": (camera_dies, "no longer there", "safe"),
    "exposure drifts": (drifting, "the exposure was 0.01 s before the sweep and 0.012 s after it", "safe"),
    "light reads back as another": (light_lies, "L2 was asked for, but 'L3' is on", "safe"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_stops_the_rig_keeps_the_disk_whole_and_is_resumed(fault, rig_in, record_fault):
    inject, words, state = FAULTS[fault]
    rig = rig_in()
    with pytest.MonkeyPatch.context() as monkeypatch:
        inject(rig, monkeypatch)
        with pytest.raises((ReflectsepError, KeyboardInterrupt)) as caught:
            rig.run()
        told = " ".join([str(caught.value), *rig.told])
    assert re.search(words, told), told
    assert "\n" not in str(caught.value)
    assert rig.bench.light is None
    assert all(text.endswith("resume=true goes on from this step") for text in rig.told if ": stopped: " in text)
    motions = len(rig.bench.board.motion_lines)
    if state == "safe":
        assert rig.at_rest()
    else:
        assert LOST in told
    done = whole(rig.folder)
    assert "sweep-L1-x" not in done
    assert not (rig.folder / "capture.json").exists()
    assert len(rig.bench.board.motion_lines) == motions

    again = rig_in()
    again.run(resume=True)
    assert complete(again.folder).sweeps[0].count == 20
    kept = [e["step"] for e in read_events(rig.folder) if e["event"] == "begin"]
    assert all(kept.count(name) == 1 for name in done), "a step that was done is not taken again"
    record_fault(
        fault, str(caught.value), rig.told[-1] if rig.told else "not begun", f"{len(done)} steps whole", "completes"
    )


def bend(rig, monkeypatch):
    rig.noise_in = b"\xff\x00<Idle|MPos:9"
    rig.partial = True


def reorder(rig, monkeypatch):
    held = []

    def swap(frame):
        if frame.sequence % 5 == 0 and not held:
            held.append(frame)
            return []
        return [frame, *[held.pop() for _ in held[:]]]

    rig.change = swap


SURVIVED = {
    "no fault": lambda rig, m: None,
    "noise and partial lines from the board": bend,
    "duplicate frames": lambda rig, m: setattr(rig, "change", lambda frame: [frame, frame]),
    "reordered frames": reorder,
    "the camera's count wraps": lambda rig, m: setattr(rig.devices.camera, "_sequence_first", 65530),
    "the host sleeps for 0.5 s": lambda rig, m: at_sweep(rig, MOVING, lambda: rig.bench.clock.sleep(0.5)),
}


@pytest.mark.parametrize("fault", SURVIVED)
def test_what_a_session_survives(fault, rig_in, record_fault):
    rig = rig_in()
    with pytest.MonkeyPatch.context() as monkeypatch:
        SURVIVED[fault](rig, monkeypatch)
        rig.run()
    sweep = complete(rig.folder).sweeps[0]
    assert (sweep.count, sweep.lost) == (20, frozenset())
    steps = np.diff(np.array(sweep.position_mm, dtype=float))
    assert np.abs(steps - 1.0).max() < 0.001
    assert rig.at_rest()
    record_fault(fault, "nothing", rig.told[-1] if rig.told else "done", "complete", "not needed")


def test_few_lost_frames_stay_lost_and_null(rig_in, record_fault):
    rig = rig_in()
    rig.change = lambda frame: [] if frame.sequence == 65511 else [frame]
    rig.run()
    sweep = complete(rig.folder).sweeps[0]
    (lost,) = sweep.lost
    assert sweep.position_mm[lost] is None
    assert sweep.position_mm[lost + 1] - sweep.position_mm[lost - 1] == pytest.approx(2.0, abs=1e-3)
    assert not (rig.folder / sweep.frames.format(lost)).exists()
    record_fault("a dropped frame", "nothing", "done", "null in the manifest", "not needed")


def test_commands_before_the_banner_vanish_and_are_not_relied_on(rig_in, record_fault):
    rig = rig_in()
    rig.run()
    assert rig.bench.board.motion_lines[0][0] > 1.0
    record_fault("commands before the banner", "nothing", "waits for the banner", "complete", "not needed")


@pytest.mark.parametrize(
    ("sweep", "settings", "words"),
    [
        ({"speed_mm_s": 0.1}, {}, "below 0.124 mm/s its motor steps too slowly"),
        ({"speed_mm_s": 60.0}, {}, "the stage reaches 50 mm/s"),
        ({"start_mm": -199.9}, {}, "with its run-up from -200.950 to"),
        ({"end_mm": -69.0}, {}, "its speed cannot be checked"),
        ({}, {110: 1000.0}, "is 16.6667 mm/s, less than max_speed_mm_s=50"),
        ({}, {100: 200.0}, r"\$100=200, but the configuration says steps_per_mm=250"),
        ({}, {10: 0.0}, r"expected an odd \$10, and \$13=0"),
        ({}, {13: 1.0}, r"expected an odd \$10, and \$13=0"),
        ({}, {20: 1.0, 130: 150.0}, "soft limits allow -150 to 0 mm"),
    ],
)
def test_what_the_stage_cannot_do_is_refused_before_anything_moves(sweep, settings, words, rig_in, record_fault):
    rig = rig_in(sweep=sweep, settings=settings)
    with pytest.raises(ReflectsepError, match=words) as caught:
        rig.run()
    assert rig.bench.board.motion_lines == []
    record_fault(f"{sweep or settings}", str(caught.value), "nothing moved", "no step", "after correction")


def test_a_slow_sweep_that_the_board_runs_too_fast_is_noticed(rig_in):
    rig = rig_in(sweep={"speed_mm_s": 0.13, "start_mm": -60.5, "end_mm": -60.0, "rate_hz": 5.0})
    rig.bench.board.planner.true_speed = lambda speed: speed * 1.22 if speed < 1 else speed
    with pytest.raises(ReflectsepError, match=r"more than 0\.5 % off"):
        rig.run()


def test_exposure_that_the_camera_changed_is_told_and_recorded_as_it_is(rig_in, record_fault):
    rig = rig_in()
    camera = rig.devices.camera
    set_exposure = camera.set_exposure
    camera.set_exposure = lambda s: set_exposure(0.02)
    rig.run()
    capture = complete(rig.folder)
    assert {p.exposure_s for p in capture.images} == {0.02}
    assert capture.sweeps[0].exposure_s == 0.02
    assert any("made 0.02 s of an exposure of 0.01 s" in text for text in rig.told)
    record_fault("exposure coerced", "the camera made 0.02 s of ...", "goes on", "0.02 s recorded", "not needed")


def test_unknown_exposure_is_recorded_as_unknown(rig_in):
    rig = rig_in()
    rig.devices.camera.set_exposure = rig.devices.camera.read_exposure = lambda *a: None
    rig.run()
    assert {p.exposure_s for p in complete(rig.folder).images} == {None}


def test_torn_log_line_is_left_alone_and_the_session_goes_on(rig_in, record_fault):
    rig = rig_in()
    at_sweep(rig, MOVING, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        rig.run()
    with open(rig.folder / "events.jsonl", "ab") as log:
        log.write(b'{"event": "fra')
    rig_in().run(resume=True)
    events = [e["event"] for e in read_events(rig.folder)]
    assert "torn line" in events
    assert events[-1] == "finished"
    record_fault("torn log line", "nothing", "done", "noted in the log", "completes")


def test_changed_plan_firmware_or_camera_refuses_to_go_on(rig_in, record_fault):
    rig = rig_in()
    at_sweep(rig, MOVING, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        rig.run()
    changes = {
        "plan.sweeps": {"sweep": {"end_mm": -49.0}},
        r"stage.\$130 was": {"settings": {130: 210.0}},
    }
    for words, change in changes.items():
        with pytest.raises(ReflectsepError, match=words) as caught:
            rig_in(**change).run(resume=True)
        record_fault(f"changed {words}", str(caught.value), "stopped", "unchanged", "refused")
    other = rig_in()
    other.bench.scene.largest = 254
    with pytest.raises(ReflectsepError, match=r"camera.largest was .255., is .254."):
        other.run(resume=True)
    rig_in().run(resume=True)
    complete(rig.folder)


def test_existing_session_needs_resume_and_a_finished_one_has_nothing_to_do(rig_in, record_fault):
    rig = rig_in()
    rig.run()
    with pytest.raises(ReflectsepError, match="say resume=true"):
        rig_in().run()
    assert Session(rig.folder).finished
    record_fault("finished session", "finished already, nothing to do", "not connected", "unchanged", "nothing to do")


def test_stage_without_switches_goes_on_only_when_a_person_has_zeroed_it(rig_in):
    here = {"settings": {22: 0}, "stage": {"reference": "here"}}
    rig = rig_in(**here)
    at_sweep(rig, MOVING, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        rig.run()
    with pytest.raises(ReflectsepError, match="zeroed=true"):
        rig_in(**here).run(resume=True)
    rig_in(**here).run(resume=True, zeroed=True)
    complete(rig.folder)


def test_lock_of_a_running_session_keeps_others_out_and_a_stale_one_does_not(rig_in, tmp_path, record_fault):
    held = Session(tmp_path / "session")
    held.open(resume=False)
    with pytest.raises(ReflectsepError, match="another session is running in it"):
        Session(tmp_path / "session").open(resume=True)
    held.close()
    assert (tmp_path / "session" / "session.lock").exists()
    rig_in().run()
    record_fault("stale lock", "nothing", "done", "taken over", "not needed")


def test_foreign_folder_is_left_alone(tmp_path):
    (tmp_path / "holiday.txt").write_text("mine")
    with pytest.raises(ReflectsepError, match="not empty"):
        Session(tmp_path).open(resume=True)


def test_damaged_file_of_a_done_step_is_taken_again(rig_in):
    rig = rig_in()
    at_sweep(rig, MOVING, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        rig.run()
    (rig.folder / "full/L2.png").write_bytes(b"no picture")
    rig_in().run(resume=True)
    assert [e["step"] for e in read_events(rig.folder) if e["event"] == "begin"].count("full-L2") == 2
    complete(rig.folder)


def test_wall_clock_jump_changes_nothing(rig_in, monkeypatch, record_fault):
    rig = rig_in()

    class Jumping(session_module.datetime):
        @classmethod
        def now(cls, zone=None):
            return cls(1970, 1, 1, tzinfo=zone)

    at_sweep(rig, MOVING, lambda: monkeypatch.setattr(session_module, "datetime", Jumping))
    rig.run()
    assert complete(rig.folder).sweeps[0].count == 20
    record_fault("wall clock jumps", "nothing", "done", "complete", "not needed")


def test_disk_without_room_for_what_the_first_picture_shows_is_refused(rig_in, monkeypatch):
    rig = rig_in()
    room = []

    def usage(folder):
        room.append(10**12 if not room else 10_000)
        return SimpleNamespace(free=room[-1])

    monkeypatch.setattr(runner_module.shutil, "disk_usage", usage)
    rig.devices.camera.snap = lambda name: RawFrame(
        pixels=np.random.default_rng(0).integers(0, 255, (30, 30), np.uint8)
    )
    with pytest.raises(ReflectsepError, match=r"0\.01 MB are free, up to 0\.\d+ MB are needed"):
        rig.run()
    assert rig.at_rest()
    assert whole(rig.folder) == ["full-L1"]


def test_plan_names_what_it_refuses():
    with pytest.raises(SettingsError, match=r"rig.devices.stage._target_=os.system: no such backend"):
        build("stage", {"_target_": "os.system"})


def test_saturated_and_dark_frames_are_told_while_it_runs_with_the_exposure_that_fits(rig_in):
    rig = rig_in(exposure={"full": 0.05, "slab": 0.0011})
    rig.run()
    bright = next(text for text in rig.told if text.startswith("picture full-L1"))
    assert "saturated; 0.0125 s would fit (0.05 s is set)" in bright
    (dark,) = [text for text in rig.told if "brightest frame so far" in text]
    fits = float(re.search(r"; ([\d.]+) s would fit", dark)[1])
    # 110 of 255 at 10 ms: 0.7 of full scale needs 16 ms.
    assert 0.012 < fits < 0.018


def test_automatic_exposure_fits_and_is_kept_over_a_resumption(rig_in):
    rig = rig_in(exposure={"full": None, "slab": None})
    at_sweep(rig, MOVING, lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        rig.run()
    before = json.loads((rig.folder / "session.json").read_text())["exposures"]
    again = rig_in(exposure={"full": None, "slab": None})
    capture = again.run(resume=True)
    # The brightest light shows 140 of 255 at 10 ms: aims between 0.5 and 0.9 of full scale.
    assert 0.5 <= before["full"] / 0.01 * 140 / 255 <= 0.9
    assert 0.5 <= before["slab"] / 0.01 * 110 / 255 <= 0.9
    assert {p.exposure_s for p in capture.images if p.kind == "full"} == {round(before["full"], 6)}
    assert capture.sweeps[0].exposure_s == round(before["slab"], 6)
    assert set(NAMES) == set(capture.lights)
