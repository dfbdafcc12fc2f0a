"""One sweep: approach, run-up, frames and position reports, then where the slit was in each frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from reflectsep.errors import CameraError, StageError
from reflectsep.rig.clock import Deadline
from reflectsep.rig.devices import AxisLimits, ClockReading, RawFrame, StageReport
from reflectsep.rig.exposure import brightness
from reflectsep.rig.frames import FrameStore, Slot, row
from reflectsep.rig.marks import Switched, clock_of_marks
from reflectsep.rig.plan import LEAD_FRAMES, SlabSweep, run
from reflectsep.rig.sync import Line, fit_clock, fit_track, place

if TYPE_CHECKING:
    from reflectsep.rig.runner import Runner

LOOP_S = 0.004
MARK_FRAMES = 4
"""Before and after each switching of the light that a camera's clock is found by."""
CLOCK_EVERY_S = 0.2
DRIFT = 0.005
"""Relative change of the exposure over a sweep that is still none."""
UNTIMED_SD_S = 0.02
"""Of the time of a frame whose camera has no clock: its arrival is all there is."""

Taken = tuple[dict[str, Path], dict[str, Any]]
"""Files in `incoming/` by their final name, and the facts of the step."""


@dataclass(frozen=True, kw_only=True)
class SweepOptions:
    """See RunOptions and Plan."""

    latency_s: float
    max_lost: float


@dataclass(kw_only=True)
class Recording:
    """What came during a sweep."""

    reports: list[StageReport]
    readings: list[ClockReading]
    frames: list[RawFrame]
    """Times only: the pixels are on disk."""
    on_s: float = 0.0
    off_s: float = 0.0
    """When the light was switched, for cameras whose frames alone can tell."""


def take_sweep(
    runner: Runner, shot: SlabSweep, store: FrameStore, options: SweepOptions, progress: Callable[[int], None]
) -> Taken:
    """Take one sweep.

    Args:
        runner: Whose devices and session.
        shot: What to take.
        store: Takes the frames.
        options: Limits.
        progress: Told the number of frames so far.

    Raises:
        StageError: a motion that was not what was asked for.
        CameraError: frames lost beyond the limit, or an exposure that drifted.
    """
    limits = runner.devices.stage.limits[shot.axis]
    first, last = run(shot, limits)
    if shot.axis != "x":
        runner.move("x", runner.plan.park_mm)
    # From the same side always: the backlash of the screw is taken up before the run-up begins.
    runner.move(shot.axis, max(first - 0.5, limits.travel_mm[0]))
    runner.move(shot.axis, first)
    marked = not runner.devices.camera.limits.host_times
    runner.switch(None if marked else shot.light)
    exposure = runner.set_exposure("slab")
    if shot.motion == "stepped":
        taken = _take_steps(runner, shot, store, exposure, progress)
    else:
        recording = _record(runner, shot, store, exposure, last, progress)
        runner.switch(None)
        taken = _assemble(runner, shot, store, recording, options, limits)
    after = runner.devices.camera.read_exposure()
    if exposure is not None and after is not None and abs(after / exposure - 1) > DRIFT:
        raise CameraError(f"{shot.name}: the exposure was {exposure:g} s before the sweep and {after:g} s after it")
    taken[1]["exposure_s"] = exposure
    if shot.axis != "x":
        runner.move(shot.axis, min(limits.travel_mm[1], max(limits.travel_mm[0], 0.0)))
    return taken


def _record(
    runner: Runner,
    shot: SlabSweep,
    store: FrameStore,
    exposure: float | None,
    last_mm: float,
    progress: Callable[[int], None],
) -> Recording:
    """Camera on, a few frames, the motion, a few frames, camera off."""
    camera, stage, clock = runner.devices.camera, runner.devices.stage, runner.clock
    recording = Recording(reports=[], readings=[], frames=[])
    next_reading = [clock.now()]

    def drain() -> None:
        _keep(runner, shot, store, exposure, recording, camera.poll())
        progress(min(len(recording.frames), shot.frames))
        if clock.now() >= next_reading[0]:
            next_reading[0] = clock.now() + CLOCK_EVERY_S
            reading = camera.read_clock()
            if reading is not None:
                recording.readings.append(reading)

    camera.start(shot.name, shot.rate_hz)
    _idle(runner, drain, LEAD_FRAMES / shot.rate_hz + 0.2)
    if not camera.limits.host_times:
        _idle(runner, drain, MARK_FRAMES / shot.rate_hz)
        recording.on_s = _switched(runner, shot.light)
        _idle(runner, drain, MARK_FRAMES / shot.rate_hz)
    stage.begin(shot.axis, last_mm, shot.speed_mm_s)
    while stage.moving:
        report = stage.poll()
        if report is not None:
            recording.reports.append(report)
            runner.session.event("report", time_s=report.time_s, position_mm=report.position_mm, state=report.state)
        drain()
        clock.sleep(LOOP_S)
    _idle(runner, drain, LEAD_FRAMES / shot.rate_hz)
    if not camera.limits.host_times:
        recording.off_s = _switched(runner, None)
        _idle(runner, drain, MARK_FRAMES / shot.rate_hz)
    _keep(runner, shot, store, exposure, recording, camera.stop())
    return recording


def _switched(runner: Runner, light: str | None) -> float:
    """Switch, and when that was."""
    before = runner.clock.now()
    runner.switch(light)
    return (before + runner.clock.now()) / 2


def _idle(runner: Runner, drain: Callable[[], None], duration_s: float) -> None:
    deadline = Deadline.after(runner.clock, duration_s)
    while not deadline.passed:
        drain()
        runner.clock.sleep(LOOP_S)


def _keep(
    runner: Runner, shot: SlabSweep, store: FrameStore, exposure: float | None, recording: Recording, frames: Any
) -> None:
    for frame in frames:
        values = store.add(frame)
        recording.frames.append(
            RawFrame(
                pixels=None,
                sequence=frame.sequence,
                device_time_s=frame.device_time_s,
                host_time_s=frame.host_time_s,
                fault=frame.fault,
            )
        )
        if values is not None:
            _judge(runner, shot, store, exposure, values)


def _judge(runner: Runner, shot: SlabSweep, store: FrameStore, exposure: float | None, values: np.ndarray) -> None:
    """Warn of a saturated frame, and past the middle of the sweep when no frame so far was bright enough."""
    seen = brightness(values)
    store.brightest = seen if store.brightest is None or seen.high > store.brightest.high else store.brightest
    runner.look(f"{shot.name}, frame {len(store.stored)}", seen, exposure, slab=False)
    if len(store.stored) == int(0.6 * shot.frames) + 1:
        runner.look(f"{shot.name}, its brightest frame so far", store.brightest, exposure, slab=True)


def _assemble(
    runner: Runner,
    shot: SlabSweep,
    store: FrameStore,
    recording: Recording,
    options: SweepOptions,
    limits: AxisLimits,
) -> Taken:
    """Positions of the frames, the ramp frames dropped, the lost ones left open."""
    ramp = limits.ramp_mm(shot.speed_mm_s)
    first, last = run(shot, limits)
    track = fit_track(recording.reports, (first + ramp, last - ramp), shot.speed_mm_s, limits.step_mm)
    camera = runner.devices.camera.limits
    slots = row(store.stored, first=camera.sequence_first, last=camera.sequence_last, period_s=1.0 / shot.rate_hz)
    clock = _camera_clock(shot, recording, store, options.latency_s)
    placed = place(np.array([slot.time_s for slot in slots]), clock, track, limits.step_mm)
    tolerance = 1e-6
    kept = np.flatnonzero(
        (placed.position_mm >= shot.start_mm - tolerance) & (placed.position_mm <= shot.end_mm + tolerance)
    )
    chosen = [slots[index] for index in kept]
    _check_lost(shot, chosen, store, options.max_lost)
    origin = float(placed.time_s[kept[0]])
    lost = [index for index, slot in enumerate(chosen) if slot.file is None]
    facts: dict[str, Any] = {
        "count": len(chosen),
        "lost": lost,
        "position_mm": _per_frame(chosen, placed.position_mm[kept]),
        "position_sd_mm": _per_frame(chosen, placed.sd_mm[kept]),
        "time_s": _per_frame(chosen, placed.time_s[kept] - origin),
        "speed_mm_s": track.line.slope,
        "speed_sd_mm_s": track.line.slope_sd,
        "track_rms_mm": track.line.rms,
        "track_worst_mm": track.worst_mm,
        "reports": track.reports,
        "clock_drift": clock.slope - 1.0,
        "clock_sd_s": clock.value_sd,
        "clock_readings": len(recording.readings),
    }
    return _moves(shot, chosen, facts)


def _moves(shot: SlabSweep, chosen: list[Slot], facts: dict[str, Any]) -> Taken:
    suffix = next(slot.file.suffix for slot in chosen if slot.file is not None)
    folder = f"sweep/{shot.light}" if shot.axis == "x" else f"sweep_y/{shot.light}"
    facts["frames"] = folder + "/{:04d}" + suffix
    moves = {facts["frames"].format(i): slot.file for i, slot in enumerate(chosen) if slot.file is not None}
    return moves, facts


def _camera_clock(shot: SlabSweep, recording: Recording, store: FrameStore, latency_s: float) -> Line:
    """Host time of the frames' times."""
    if recording.off_s > recording.on_s:
        whole = [s for s in store.stored if s.level is not None and s.device_time_s is not None]
        times, levels = np.array([s.device_time_s for s in whole]), np.array([s.level for s in whole])
        switched = Switched(on_s=recording.on_s, off_s=recording.off_s)
        try:
            return clock_of_marks(times, levels, switched)
        except CameraError as error:
            why = next((f" ({s.fault})" for s in store.stored if s.fault), "")
            raise CameraError(f"{shot.name}: {error}{why}") from error
    if any(frame.device_time_s is not None for frame in recording.frames):
        return fit_clock(recording.frames, recording.readings, latency_s)
    return Line(centre=0.0, value=-latency_s, slope=1.0, value_sd=UNTIMED_SD_S, slope_sd=0.0, rms=UNTIMED_SD_S)


def _check_lost(shot: SlabSweep, chosen: list[Slot], store: FrameStore, max_lost: float) -> None:
    lost = sum(slot.file is None for slot in chosen)
    why = next((f" ({s.fault})" for s in store.stored if s.fault), "")
    if len(chosen) < max(2, shot.frames - 2):
        raise CameraError(f"{shot.name}: {len(chosen)} frames during the sweep, expected {shot.frames}{why}")
    if lost > max_lost * len(chosen):
        raise CameraError(
            f"{shot.name}: {lost} of {len(chosen)} frames were lost{why}, at most {100 * max_lost:g} % may be"
        )


def _per_frame(chosen: list[Slot], values: np.ndarray) -> list[float | None]:
    return [None if slot.file is None else float(v) for slot, v in zip(chosen, values, strict=True)]


def _take_steps(
    runner: Runner, shot: SlabSweep, store: FrameStore, exposure: float | None, progress: Callable[[int], None]
) -> Taken:
    """Frame by frame, the stage standing still for each: the position is what the stage reports at rest."""
    limits = runner.devices.stage.limits[shot.axis]
    chosen: list[Slot] = []
    positions: list[float | None] = []
    began = runner.clock.now()
    for index in range(shot.frames):
        reached = runner.move(shot.axis, shot.start_mm + index * shot.step_mm)
        values = store.add(runner.snap(f"{shot.name}/{index}"))
        if values is None:
            raise CameraError(f"{shot.name}/{index}: {store.stored[-1].fault}")
        _judge(runner, shot, store, exposure, values)
        chosen.append(Slot(file=store.stored[-1].file, time_s=runner.clock.now() - began))
        positions.append(reached)
        progress(index + 1)
    if len(chosen) < 2:
        raise StageError(f"{shot.name}: {len(chosen)} frames; a sweep needs two or more")
    runner.switch(None)
    facts: dict[str, Any] = {"count": len(chosen), "lost": [], "position_mm": positions}
    facts["time_s"] = [slot.time_s for slot in chosen]
    facts["position_sd_mm"] = [limits.step_mm] * len(chosen)
    return _moves(shot, chosen, facts)
