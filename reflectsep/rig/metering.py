"""Automatic exposure: one for all full pictures and one for all slab frames, found before the first picture is kept."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from reflectsep.errors import CameraError
from reflectsep.rig.exposure import find_exposure
from reflectsep.rig.frames import FrameStore
from reflectsep.rig.plan import Exposure

if TYPE_CHECKING:
    from reflectsep.rig.runner import Runner

FIRST_S = 0.01
LONGEST_S = 1e3
PERIOD_SHARE = 0.9
"""Of the time from frame to frame, for the exposure of frames that are taken on the way."""


def find_exposures(runner: Runner) -> dict[Exposure, float]:
    """Exposures of the plan, those of an earlier part of this session, or by test pictures.

    Raises:
        CameraError: the camera's exposure cannot be set, or nothing fits.
    """
    found = runner.session.recall("exposures") or {}
    exposures: dict[Exposure, float] = {}
    for kind, given in runner.plan.exposure_s.items():
        if given is not None:
            exposures[kind] = given
        elif kind in found:
            exposures[kind] = found[kind]
        elif kind == "full" or runner.plan.sweeps:
            exposures[kind] = found[kind] = _by_tests(runner, kind)
            runner.session.remember("exposures", found)
            what = "full pictures" if kind == "full" else "slab frames"
            runner.say(f"exposure of {what}: {found[kind]:.4g} s")
    return exposures


def _by_tests(runner: Runner, kind: Exposure) -> float:
    """One exposure for all lights: the shortest that any of them needs."""
    bounds = runner.devices.camera.limits.exposure_s
    if bounds is None:
        name = "rig.full_exposure_s" if kind == "full" else "rig.sweep_exposure_s"
        raise CameraError(f"the exposure of this camera cannot be set: say rig.auto_exposure=none, and give {name}")
    lights = [still.light for still in runner.plan.stills if still.kind == "full"]
    if kind == "slab":
        sweeps = runner.plan.sweeps
        lights = list(dict.fromkeys(sweep.light for sweep in sweeps))
        periods = [PERIOD_SHARE / sweep.rate_hz for sweep in sweeps if sweep.motion == "continuous"]
        bounds = (bounds[0], min(bounds[1], *periods, LONGEST_S))
        runner.move(sweeps[0].axis, (sweeps[0].start_mm + sweeps[0].end_mm) / 2)
    else:
        runner.move("x", runner.plan.park_mm)
    chosen: list[float] = []
    for light in lights:
        runner.switch(light)
        first_s = chosen[-1] if chosen else FIRST_S
        chosen.append(find_exposure(lambda exposure_s: _test(runner, kind, exposure_s), first_s, bounds))
    runner.switch(None)
    return min(chosen)


def _test(runner: Runner, kind: Exposure, exposure_s: float) -> tuple[float | None, np.ndarray]:
    """A picture that is not kept; the exposure read back, and its values."""
    name = f"test-{kind}"
    actual = runner.devices.camera.set_exposure(exposure_s)
    store = FrameStore(runner.session, runner.begin_step(name), None)
    values = store.add(runner.whole(name))
    if values is None:
        raise CameraError(f"{name}: {store.stored[-1].fault}")
    return actual, values
