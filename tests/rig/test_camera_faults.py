"""What cameras do in the middle of a session, and that it goes on with `resume` once they behave."""

import importlib.util
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import imagecodecs
import numpy as np
import pytest

import reflectsep
from reflectsep.errors import CameraError
from reflectsep.rig.camera_command import CommandCamera
from reflectsep.rig.camera_folder import FolderCamera
from reflectsep.rig.camera_gphoto2 import Gphoto2Camera
from reflectsep.rig.devices import Devices

from .conftest import complete, whole
from .recorder import Recorder

STEPPED = {"motion": "stepped", "rate_hz": 2.0}
"""Five frames in steps of 5 mm."""


def with_camera(rig, camera):
    names = {"stage": "grbl", "camera": type(camera).__name__, "lights": "simulated"}
    rig.devices = Devices(stage=rig.devices.stage, camera=camera, lights=rig.devices.lights, names=names)
    return rig


def fails_then_completes(make, words, frames, record_fault, fault):
    """`make(fails)` gives a rig whose camera fails in its sweep, or does not."""
    rig = make(True)
    with pytest.raises(CameraError, match=words) as caught:
        rig.run()
    assert "\n" not in str(caught.value)
    assert rig.at_rest()
    done = whole(rig.folder)
    assert {"full-L1", "full-L2", "full-L3"} == set(done)
    assert not (rig.folder / "capture.json").exists()
    again = make(False)
    again.run(resume=True)
    assert complete(again.folder).sweeps[0].count == frames
    record_fault(fault, str(caught.value), rig.told[-1], f"{len(done)} steps whole", "completes")


# External command.

PROGRAM = """
import sys, time
from pathlib import Path
here, file, name = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
if (here / "fails").exists() and name.endswith("x/3"):
    {fault}
Path(file).write_bytes((here / ("dark.png" if "dark" in name else "lit.png")).read_bytes())
"""


def command_rig(rig_in, folder, fault, fails):
    values = np.zeros((12, 16), np.uint8)
    (folder / "dark.png").write_bytes(imagecodecs.png_encode(values))
    values[2:10, 2:14] = 99
    (folder / "lit.png").write_bytes(imagecodecs.png_encode(values))
    (folder / "program.py").write_text(PROGRAM.replace("{fault}", fault))
    (folder / "fails").unlink(missing_ok=True)
    if fails:
        (folder / "fails").touch()
    rig = rig_in(sweep=STEPPED)
    take = [sys.executable, "-S", str(folder / "program.py"), str(folder), "{file}", "{name}"]
    timeout_s = 1.0 if "sleep" in fault else 20.0
    return with_camera(rig, CommandCamera(take=take, timeout_s=timeout_s, scratch=rig.folder))


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("sys.exit('no battery')", "sweep-L1-x/3: .*failed with exit code 1: no battery"),
        ("time.sleep(60)", "sweep-L1-x/3: .*not done after 1 s; it was killed"),
        ("sys.exit(0)", "sweep-L1-x/3: .*succeeded, but wrote no file"),
        ("sys.exit(Path(file).write_bytes(b'half') * 0)", "sweep-L1-x/3: .*not a readable PNG"),
    ],
)
def test_command_that_fails_in_a_sweep(fault, words, rig_in, tmp_path, record_fault):
    def make(fails):
        return command_rig(rig_in, tmp_path, fault, fails)

    fails_then_completes(make, words, 5, record_fault, f"external command: {fault}")


def test_files_of_a_command_stay_in_the_session_and_what_a_crash_left_of_them_is_swept_away(
    rig_in, tmp_path, monkeypatch
):
    rig = command_rig(rig_in, tmp_path, "pass", False)
    left = rig.folder / ".camera.killed.part"
    left.mkdir(parents=True)
    (left / "000003.png").write_bytes(b"half")
    (tmp_path / "system").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "system"))
    seen = []
    snap = rig.devices.camera.snap
    rig.devices.camera.snap = lambda name: seen.append(snap(name)) or seen[-1]
    rig.run()
    assert {frame.file.parent.parent for frame in seen} == {rig.folder}
    assert list((tmp_path / "system").iterdir()) == []
    assert [path.name for path in rig.folder.iterdir() if path.name.startswith(".")] == []


# Video.


def recorded(rig_in, tmp_path, spoil=None, **options):
    pytest.importorskip("av")
    rig = rig_in(**options)
    path = tmp_path / "videos" / "{name}.mkv"
    path.parent.mkdir(exist_ok=True)
    camera = Recorder(rig.devices.camera, path=str(path), clock=rig.bench.clock, settle_s=0.1, timeout_s=5.0)
    camera.spoil = spoil
    return with_camera(rig, camera)


def halve(path, pictures):
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def test_video_cut_off_in_a_sweep(rig_in, tmp_path, record_fault):
    def make(fails):
        return recorded(rig_in, tmp_path, halve if fails else None)

    fails_then_completes(make, "sweep-L1-x: .*do not show the light going", 20, record_fault, "video cut off")


def test_video_that_never_comes(rig_in, tmp_path, record_fault):
    def make(fails):
        return recorded(rig_in, tmp_path, (lambda path, pictures: path.unlink()) if fails else None)

    fails_then_completes(make, r"sweep-L1-x\.mkv: no whole video in 5 s", 20, record_fault, "video missing")


def test_video_that_is_none(rig_in, tmp_path, record_fault):
    def make(fails):
        return recorded(rig_in, tmp_path, (lambda path, pictures: path.write_bytes(b"none" * 50)) if fails else None)

    fails_then_completes(make, r"sweep-L1-x\.mkv: .*", 20, record_fault, "video damaged")


def without(numbers):
    """The recorder lost these pictures; the others keep their own times."""

    def spoil(path, pictures):
        Recorder.write(path, [p for k, p in enumerate(pictures) if k not in numbers])

    return spoil


def test_video_with_gaps_has_its_frames_where_they_belong(rig_in, tmp_path, record_fault):
    gaps = (20, 21, 26)
    kept = recorded(rig_in, tmp_path)
    kept.run()
    wanted = complete(kept.folder).sweeps[0]
    rig = recorded(lambda **options: rig_in("gaps", **options), tmp_path, without(gaps), max_lost=0.2)
    rig.run()
    sweep = complete(rig.folder).sweeps[0]
    assert sweep.count == 20
    assert len(sweep.lost) == 3
    for index in range(20):
        if index in sweep.lost:
            assert sweep.position_mm[index] is None
        else:
            assert sweep.position_mm[index] == pytest.approx(wanted.position_mm[index], abs=1e-6)
            ours, theirs = rig.folder / sweep.frames.format(index), kept.folder / wanted.frames.format(index)
            assert ours.read_bytes() == theirs.read_bytes()
    record_fault("video with gaps", "nothing", "done", "null in the manifest", "not needed")


def test_video_with_too_many_gaps(rig_in, tmp_path, record_fault):
    def make(fails):
        return recorded(rig_in, tmp_path, without(range(16, 30)) if fails else None)

    fails_then_completes(make, "sweep-L1-x: .* frames were lost, at most 10 %", 20, record_fault, "video of gaps")


# Watched folder.


class Dropped(FolderCamera):
    """A watched folder into which the test drops what a simulated camera sees, as far as it likes."""

    def __init__(self, eye, **settings):
        super().__init__(**settings)
        self._eye, self._count, self.stops_after = eye, 0, 10**9

    def connect(self):
        super().connect()
        self._eye.connect()
        self._count = 1000 * len(list(self._folder.iterdir()))

    def drop(self, frames):
        for frame in frames:
            self._count += 1
            data = imagecodecs.png_encode(frame.pixels)
            if frame.sequence is not None and self._eye.taken(frame) > self.stops_after:
                data = data[: len(data) // 2]
            (self._folder / f"P{self._count:06d}.png").write_bytes(data)

    def snap(self, name):
        self.drop([self._eye.snap(name)])
        return super().snap(name)

    def start(self, name, rate_hz):
        super().start(name, rate_hz)
        self._eye.start(name, rate_hz)

    def poll(self):
        self.drop(self._eye.poll())
        return super().poll()

    def stop(self):
        self.drop(self._eye.stop())
        return super().stop()


def test_watched_folder_whose_files_stay_half_written(rig_in, tmp_path, record_fault):
    (tmp_path / "dropped").mkdir()

    def make(fails):
        rig = rig_in()
        eye = rig.devices.camera
        eye.taken = lambda frame: frame.sequence - 65500
        camera = Dropped(eye, folder=str(tmp_path / "dropped"), clock=rig.bench.clock, settle_s=0.05)
        camera.stops_after = 12 if fails else 10**9
        return with_camera(rig, camera)

    words = r"sweep-L1-x: \d+ of 20 frames were lost \(P\d+\.png stayed half-written\), at most 10 % may be"
    fails_then_completes(make, words, 20, record_fault, "watched folder: files stay half-written")


# DSLR.

CARD = """
import json, sys
from pathlib import Path
from killed import support
from reflectsep.errors import CameraError
from reflectsep.rig.camera_gphoto2 import Gphoto2Camera
from reflectsep.rig.devices import Devices
folder, before, resume = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3] == "resume"
tools = support()
rig = tools.Rig(folder, sweep={"motion": "stepped", "rate_hz": 4.0}, mask="none")
camera = Gphoto2Camera()
rig.devices = Devices(stage=rig.devices.stage, camera=camera, lights=rig.devices.lights)
connect = camera.connect
def fill():
    connect()
    for _ in range(before):
        camera.snap("other")
camera.connect = fill
error = None
try:
    rig.run(resume=resume)
except CameraError as caught:
    error = str(caught)
print(json.dumps({"error": error, "rest": rig.at_rest(), "told": rig.told, "done": tools.whole(folder)}))
"""


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("gphoto2") is None, reason="only with the extra `gphoto2`")
def test_card_of_a_dslr_fills_in_a_sweep(tmp_path, record_fault):
    """The virtual camera declares its card full at the 27th picture."""
    (tmp_path / "card" / "DCIM").mkdir(parents=True)

    def run(before, resume):
        picture = imagecodecs.jpeg8_encode(np.full((48, 64, 3), 100, np.uint8))
        (tmp_path / "card" / "DCIM" / "a.jpg").write_bytes(picture)
        paths = [str(Path(reflectsep.__file__).parent.parent), str(Path(__file__).parent)]
        environment = os.environ | {"VCAMERADIR": str(tmp_path / "card"), "PYTHONPATH": os.pathsep.join(paths)}
        words = [sys.executable, "-c", CARD, str(tmp_path / "session"), str(before), resume]
        done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    full = run(18, "begin")
    assert re.match(r"sweep-L1-x/5: .*its card is full", full["error"]), full
    assert full["rest"]
    assert full["done"] == ["full-L1", "full-L2", "full-L3"]
    emptied = run(0, "resume")
    assert emptied["error"] is None
    assert complete(tmp_path / "session").sweeps[0].count == 9
    record_fault("memory card full", full["error"], full["told"][-1], "3 steps whole", "completes")


class Widget:
    """A setting of a camera."""

    def __init__(self, value):
        self.value = value

    def get_value(self):
        return self.value

    def get_type(self):
        return 0


class Library:
    """As much of gphoto2 as a camera that writes raw files needs."""

    GP_CAPTURE_IMAGE, GP_FILE_TYPE_NORMAL, GP_WIDGET_RADIO, GP_WIDGET_MENU = 0, 1, 5, 6

    class GPhoto2Error(Exception):
        code = -1

    def __init__(self, data, quality):
        self.data, self.settings = data, {"imagequality": quality}
        self.deleted = []

    def Camera(self):  # noqa: N802
        return self

    def init(self):
        pass

    def exit(self):
        pass

    model, folder, name = "Test", "/DCIM", "DSC_0001.DNG"

    def get_abilities(self):
        return self

    def get_single_config(self, name):
        if name not in self.settings:
            raise self.GPhoto2Error
        return Widget(self.settings[name])

    def capture(self, kind):
        return self

    def file_get(self, folder, name, kind):
        return self

    def save(self, path):
        Path(path).write_bytes(self.data)

    def file_delete(self, folder, name):
        self.deleted.append(name)


def test_raw_file_of_a_dslr_is_kept_as_it_is(monkeypatch):
    library = Library(b"raw", "NEF (Raw)")
    monkeypatch.setattr("reflectsep.rig.camera_gphoto2._library", lambda: library)
    camera = Gphoto2Camera()
    camera.connect()
    frame = camera.snap("L1")
    assert frame.file is not None
    assert frame.file.suffix == ".dng"
    assert frame.file.read_bytes() == b"raw"
    assert library.deleted == ["DSC_0001.DNG"]
    camera.close()


def test_dslr_that_writes_two_files_a_picture_is_refused(monkeypatch):
    monkeypatch.setattr("reflectsep.rig.camera_gphoto2._library", lambda: Library(b"", "NEF+Fine"))
    with pytest.raises(CameraError, match=r"Test: imagequality=NEF\+Fine: two files a picture; set one"):
        Gphoto2Camera().connect()
