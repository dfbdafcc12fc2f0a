"""Takes a session: every shot of the plan that is not done yet, and leaves the rig safe however it ends."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reflectsep.errors import CameraError, ReflectsepError, SessionError, StageError
from reflectsep.io.exr import write_channels
from reflectsep.progress import Progress, silent
from reflectsep.rig.clock import Clock, HostClock
from reflectsep.rig.devices import Axis, Devices, RawFrame
from reflectsep.rig.exposure import Brightness, brightness, warning
from reflectsep.rig.frames import FrameStore
from reflectsep.rig.guard import Guard, Interrupted
from reflectsep.rig.metering import find_exposures
from reflectsep.rig.plan import Exposure, Plan, SlabSweep, Still, check_plan, estimate
from reflectsep.rig.session import Session
from reflectsep.rig.sweep import SweepOptions, take_sweep

EXPOSURE_TOLERANCE = 0.02
STALL_MM = 0.2
"""Slip of the carriage over a sweep above which its motor has stalled; homing is timed to about 0.1 mm."""
WARNINGS_A_STEP = 3
TRIES = 3
"""At a picture that comes damaged."""
SPACE_SPARE = 1.2
IDLE_S = 0.005


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """How a session is run, as far as the pictures do not depend on it."""

    resume: bool = False
    zeroed: bool = False
    """A person has put the carriage of a stage without switches at its zero before going on."""
    latency_s: float = 0.0
    """From mid-exposure to the earliest arrival of a frame, for cameras whose clock cannot be read."""
    frame_bytes: int = 0
    """Of one stored frame at most, to see whether the disk has room; 0: not looked at."""


class Runner:
    """One session.

    Args:
        plan: What to take.
        devices: Built, not connected.
        session: Open.
        options: How.
        clock: The devices'.
        progress: Told ("capture", pictures done, pictures in all).
        tell: Told what a person should know at once.
    """

    def __init__(
        self,
        plan: Plan,
        devices: Devices,
        session: Session,
        options: RunOptions,
        *,
        clock: Clock | None = None,
        progress: Progress = silent,
        tell: Callable[[str], None] = print,
    ) -> None:
        self.plan, self.devices, self.session, self.options = plan, devices, session, options
        self.clock = clock or HostClock()
        self.size: tuple[int, int] | None = None
        self._progress, self._tell = progress, tell
        self._warned = 0
        self._step = "start"
        self._exposures: dict[Exposure, float] = {}

    def run(self) -> None:
        """Everything that is not done yet.

        Raises:
            RigError: a device failed; the rig is safe, or the text says what is not.
            SessionError: the folder is of another plan or rig, or the disk is full.
            Interrupted: somebody stopped it.
        """
        check_plan(self.plan, self.devices.stage.limits)
        self._check_space(self.options.frame_bytes)
        with Guard(self.devices.stage.abort) as guard:
            try:
                self._connect()
                self._take_all()
            except BaseException as error:
                guard.stopping()
                self._fail(error)
                if isinstance(error, ReflectsepError | Interrupted) or not isinstance(error, Exception):
                    raise
                if isinstance(error, OSError):
                    raise SessionError(
                        f"{self.session.folder}: {self._step}: {error.strerror or error}; the rig is stopped, "
                        "resume=true goes on from this step"
                    ) from error
                raise
            finally:
                guard.stopping()
                self._release()

    def warn(self, text: str) -> None:
        """Tell and log, a few times a step."""
        self._warned += 1
        self.session.event("warning", step=self._step, text=text)
        if self._warned <= WARNINGS_A_STEP:
            self._tell(text)

    def move(self, axis: Axis, target_mm: float) -> float | None:
        """Go somewhere as fast as the stage may, and wait for the end; where the stage says that it is then."""
        stage = self.devices.stage
        stage.begin(axis, target_mm, stage.limits[axis].speed_mm_s[1])
        while stage.moving:
            stage.poll()
            self.clock.sleep(IDLE_S)
        return stage.position(axis)

    def set_exposure(self, kind: Exposure) -> float | None:
        """Set the exposure of a kind of picture; what the camera says it is."""
        wanted = self._exposures[kind]
        actual = self.devices.camera.set_exposure(wanted)
        if actual is not None and abs(actual / wanted - 1) > EXPOSURE_TOLERANCE:
            self.warn(f"the camera made {actual:g} s of an exposure of {wanted:g} s; recorded as {actual:g} s")
        return actual

    def begin_step(self, name: str) -> Path:
        """A step of another name begins: warnings count anew; returns the folder for its files."""
        self._step, self._warned = name, 0
        return self.session.begin_step(name)

    def say(self, text: str) -> None:
        """Tell the person at the rig."""
        self._tell(text)

    def switch(self, light: str | None) -> None:
        """One light on, or none."""
        said = self.devices.lights.switch(light)
        self.session.event("light", asked=light or "off", read_back=said)

    def snap(self, name: str) -> RawFrame:
        """One picture; errors say which."""
        try:
            return self.devices.camera.snap(name)
        except CameraError as error:
            if name in str(error):
                raise
            raise CameraError(f"{name}: {error}") from error

    def look(self, what: str, seen: Brightness, exposure_s: float | None, *, slab: bool) -> None:
        """Warn where a picture is clipped or too dark."""
        text = warning(what, exposure_s, seen, slab=slab)
        if text is not None:
            self.warn(text)

    def _check_space(self, frame_bytes: int) -> None:
        wanted = SPACE_SPARE * estimate(self.plan, self.devices.stage.limits, frame_bytes).bytes
        free = shutil.disk_usage(self.session.folder).free
        if wanted > free:
            raise SessionError(
                f"{self.session.folder}: {free / 1e6:.4g} MB are free, up to {wanted / 1e6:.4g} MB are needed"
            )

    def _connect(self) -> None:
        stage, camera, lights = self.devices.stage, self.devices.camera, self.devices.lights
        lights.connect()
        camera.connect()
        if not camera.limits.streams and any(sweep.motion == "continuous" for sweep in self.plan.sweeps):
            raise CameraError("this camera takes one frame at a time: it needs rig.sweep.motion=stepped")
        stage.connect()
        self.session.agree(
            {
                "plan": self.plan.document(),
                "devices": dict(self.devices.names),
                "stage": dict(stage.identity),
                "camera": dict(camera.identity),
                "lights": dict(lights.identity),
            }
        )
        if self.session.recall("homed") and not stage.homes and not self.options.zeroed:
            raise SessionError(
                f"{self.session.folder}: the stage has no switches to find its position: put the carriage at zero, "
                "switch the stage off and on, and say zeroed=true"
            )
        self.session.event("connected")
        self._progress("homing", 0, 1)
        stage.home()
        self._progress("homing", 1, 1)
        self.session.remember("homed", True)
        self.session.event("homed", by="switches" if stage.homes else "hand")

    def _take_all(self) -> None:
        shots = self.plan.shots
        total = sum(shot.frames if isinstance(shot, SlabSweep) else 1 for shot in shots)
        done = 0
        self._exposures = find_exposures(self)
        for shot in shots:
            self._progress("capture", done, total)
            self._step, self._warned = shot.name, 0
            record = self.session.step(shot.name)
            if record is None:
                record = self._take(shot, lambda got, before=done: self._progress("capture", before + got, total))
                if done == 0:
                    # What a picture takes is known now, as it is not of every camera before.
                    self._check_space(max((self.session.folder / name).stat().st_size for name in record["files"]))
            self.size = tuple(record["size"]) if self.size is None else self.size
            done += shot.frames if isinstance(shot, SlabSweep) else 1
        self._step = "end"
        self.switch(None)
        self._progress("capture", total, total)

    def _take(self, shot: Still | SlabSweep, progress: Callable[[int], None]) -> Mapping[str, Any]:
        store = FrameStore(self.session, self.session.begin_step(shot.name), self.size)
        if isinstance(shot, Still):
            moves, facts = self._take_still(shot, store)
        else:
            options = SweepOptions(latency_s=self.options.latency_s, max_lost=self.plan.max_lost)
            moves, facts = take_sweep(self, shot, store, options, progress)
            slip = self.devices.stage.verify()
            facts["slip_mm"] = slip
            if slip is not None and abs(slip) > STALL_MM:
                raise StageError(
                    f"sweep {shot.name}: homing found the carriage {slip:+.2f} mm from where it should be: "
                    "its motor stalled, the sweep is void"
                )
        self.session.end_step(shot.name, moves, {**facts, "size": store.size, "channels": store.channels})
        record = self.session.step(shot.name)
        assert record is not None
        return record

    def _take_still(self, shot: Still, store: FrameStore) -> tuple[dict[str, Path], dict[str, Any]]:
        self.move("x", self.plan.park_mm)
        self.switch(shot.light)
        exposure = self.set_exposure(shot.exposure)
        pictures = []
        for index in range(shot.frames):
            values = store.add(self.whole(shot.name if shot.frames == 1 else f"{shot.name}/{index}"))
            if values is None:
                raise CameraError(f"{shot.name}: {store.stored[-1].fault}")
            pictures.append(values)
        self.look(f"picture {shot.name}", brightness(pictures[-1]), exposure, slab=False)
        self.switch(None)
        if shot.kind == "full":
            file = store.stored[0].file
            assert file is not None
            return {f"full/{shot.light}{file.suffix}": file}, {"exposure_s": exposure}
        mean = np.mean(pictures, axis=0).astype(np.float32)
        planes = [mean] if mean.ndim == 2 else [mean[..., c] for c in range(3)]
        path = (store.stored[0].file or Path()).with_name("mean.exr")
        write_channels(path, dict(zip("Y" if len(planes) == 1 else "RGB", planes, strict=True)))
        return {f"{shot.name}.exr": path}, {"exposure_s": exposure, "averaged": shot.frames}

    def whole(self, name: str) -> RawFrame:
        """A picture, tried again where it came damaged."""
        for _ in range(TRIES - 1):
            frame = self.snap(name)
            if frame.fault is None:
                return frame
            self.warn(f"{name}: {frame.fault}; taken again")
        return self.snap(name)

    def _fail(self, error: BaseException) -> None:
        """Stop everything, then write down what happened; nothing here raises."""
        with suppress(Exception):
            state = self.devices.stage.halt()
            if state is not None:
                self._tell(f"{self._step}: stopped: {state}; resume=true goes on from this step")
            with suppress(Exception):
                self.session.event("failed", step=self._step, error=f"{type(error).__name__}: {error}", stage=state)
        with suppress(Exception):
            self.devices.camera.stop()
        with suppress(Exception):
            self.devices.lights.switch(None)

    def _release(self) -> None:
        for device in (self.devices.camera, self.devices.lights, self.devices.stage):
            with suppress(Exception):
                device.close()
