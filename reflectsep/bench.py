"""The capture job: settings to a plan and devices; simulated devices look at an object of the simulator.

The slab of a simulated scene is a sheet of light as in reflectsep/synth/rig.py, at any position: the scattering of
thin strips is transported once, and a frame is the difference of two places of their running sum.
"""

from __future__ import annotations

import math
import re
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from reflectsep.config import CaptureJob, RigSettings
from reflectsep.data import Light
from reflectsep.errors import SettingsError
from reflectsep.io.lights import read_lights
from reflectsep.progress import Progress
from reflectsep.rig.backends import build_devices
from reflectsep.rig.board import Board
from reflectsep.rig.clock import Clock, HostClock, VirtualClock
from reflectsep.rig.devices import Axis
from reflectsep.rig.finish import finish
from reflectsep.rig.plan import Plan, SlabSweep, check_plan, describe_plan, make_stills
from reflectsep.rig.runner import Runner, RunOptions
from reflectsep.rig.session import Session
from reflectsep.rig.simulated import Bench, View
from reflectsep.simulation import rig_of
from reflectsep.synth.camera import encoded, exposed, noise
from reflectsep.synth.objects import SimulatedObject
from reflectsep.synth.presets import make_object
from reflectsep.synth.rig import SimulatedRig, slab_coordinate
from reflectsep.synth.simulate import illuminate
from reflectsep.synth.transport import transport

STRIP_PX = 0.25
"""Width of the strips whose scattering is transported; within one, light is taken as even."""
MARGIN_PX = 2.0
UNKNOWN_FRAME = 20_000_000
"""Bytes of a frame that a dry run counts with, where the camera's size is not known before it is connected."""
SIMULATED: dict[str, dict[str, Any]] = {
    "stage": {
        "_target_": "simulated",
        "axes": {
            name: {
                "letter": name.upper(),
                "travel_mm": [-200.0, 0.0],
                "steps_per_mm": 250.0,
                "max_speed_mm_s": 50.0,
                "acceleration_mm_s2": 100.0,
            }
            for name in ("x", "y")
        },
    },
    "camera": {"_target_": "simulated"},
    "lights": {"_target_": "simulated"},
}
CENTRE_MM = -60.0
"""Where the slit of a simulated rig lights the object's middle."""


def capture(job: CaptureJob, progress: Progress) -> str:
    """Take the pictures of a job; returns a line that says what was done, or the plan of a dry run.

    Raises:
        SettingsError: a plan that the rig cannot carry out.
        RigError: a device failed; the session can be resumed.
        SessionError: the folder is in use, or holds something else.
    """
    config = {kind: getattr(job.rig.devices, kind) or SIMULATED[kind] for kind in SIMULATED}
    simulated = any(device.get("_target_") == "simulated" for device in config.values())
    all_simulated = all(device.get("_target_") == "simulated" for device in config.values())
    clock: Clock = VirtualClock() if all_simulated else HostClock()
    scene = SynthScene(job) if simulated else None
    bench = None
    if scene is not None:
        bench = Bench(scene=scene, clock=clock, board=Board({22: 1.0}), park_mm=job.rig.sweep.park_mm)
    devices = build_devices(config, clock=clock, bench=bench, scratch=Path(job.out))  # type: ignore[arg-type]
    plan = plan_of(job, scene)
    check_plan(plan, devices.stage.limits)
    size_bytes = UNKNOWN_FRAME if scene is None else math.prod(scene.size) * job.object.channels * 2
    if job.dry_run:
        folder = next(p for p in (Path(job.out).resolve(), *Path(job.out).resolve().parents) if p.is_dir())
        return describe_plan(plan, devices.stage.limits, size_bytes, shutil.disk_usage(folder).free)
    session = Session(job.out)
    if session.finished and job.resume:
        return f"{job.out}: finished already, nothing to do"
    session.open(resume=job.resume)
    try:
        options = RunOptions(
            resume=job.resume,
            zeroed=job.zeroed,
            latency_s=job.rig.sweep.latency_s,
            frame_bytes=0 if scene is None else size_bytes,
        )
        Runner(plan, devices, session, options, clock=clock, progress=progress, tell=tell).run()
        finish(session, plan)
    finally:
        session.close()
    frames = sum(session.step(sweep.name)["count"] for sweep in plan.sweeps)  # type: ignore[index]
    return f"{job.out}: {len(plan.stills)} pictures, {len(plan.sweeps)} sweeps of {frames} frames in all"


def tell(text: str) -> None:
    """What the person at the rig should know at once."""
    print(f"reflectsep: {text}", file=sys.stderr, flush=True)


def plan_of(job: CaptureJob, scene: SynthScene | None) -> Plan:
    """The plan of a job.

    Raises:
        SettingsError: too few lights, more sweeps than lights, or no extent of the sweeps.
    """
    rig, lights = job.rig, lights_of(job.rig)
    names = tuple(lights)
    if len(names) < 3:
        raise SettingsError(f"{rig.lights_file}: {len(names)} lights; three basis lights are needed at least")
    for name in names:
        if not re.fullmatch(r"[\w.-]*\w[\w.-]*", name):
            raise SettingsError(f"light {name!r}: it names files; expected letters, digits, - and .")
    if rig.sweeps > len(names):
        raise SettingsError(f"rig.sweeps={rig.sweeps}: must be at most the number of lights, {len(names)}")
    axes: Sequence[Axis] = ("x", "y") if rig.orthogonal else ("x",)
    sweeps = tuple(_sweep(job, scene, name, axis) for axis in axes for name in names[: rig.sweeps])
    full = job.object.full_exposure_s or rig.full_exposure_s
    slab = job.object.slab_exposure_s or rig.sweep_exposure_s
    return Plan(
        object=job.object.name or "object",
        lights=lights,
        basis=(names[0], names[1], names[2]),
        stills=make_stills(names, swept=bool(sweeps), dark_frames=rig.sweep.dark_frames),
        sweeps=sweeps,
        park_mm=rig.sweep.park_mm,
        exposure_s={
            "full": None if rig.auto_exposure in ("full", "both") else full,
            "slab": None if rig.auto_exposure in ("slab", "both") else slab,
        },
        encoding="linear" if rig.gamma is None else rig.gamma,
        mask=rig.mask,
        max_lost=rig.sweep.max_lost,
    )


def lights_of(rig: RigSettings) -> Mapping[str, Light]:
    """Lights by name: of a list, or, for a rig that has none, those of the simulator, without their directions.

    Directions that nobody measured are not made up: the fit then estimates alpha from the pictures.
    """
    if rig.lights_file is not None:
        return read_lights(rig.lights_file)
    simulated = rig.devices.lights is None or rig.devices.lights.get("_target_") == "simulated"
    made = rig_of(rig).lights_by_name
    return made if simulated else {name: Light(name=name) for name in made}


def _sweep(job: CaptureJob, scene: SynthScene | None, light: str, axis: Axis) -> SlabSweep:
    sweep = job.rig.sweep
    extent = job.object.extent_mm or sweep.extent_mm
    if extent is None:
        if scene is None:
            raise SettingsError("rig.sweep.extent_mm=null: give where the sweeps start and end, [first,last] in mm")
        extent = scene.extent_mm(light, axis)
    return SlabSweep(
        name=f"sweep-{light}-{axis}",
        light=light,
        axis=axis,
        start_mm=extent[0],
        end_mm=extent[1],
        speed_mm_s=sweep.speed_mm_s,
        rate_hz=sweep.rate_hz,
        motion=sweep.motion,
    )


@dataclass(frozen=True, kw_only=True)
class Strips:
    """Of one light and axis: running sums over thin strips of the object, in the order in which the slab passes."""

    first_px: float
    place: np.ndarray
    """Of every patch, in strips since the first."""
    scattered: np.ndarray
    """(strips + 1, channels, patches): radiance scattered from all strips before."""
    direct: np.ndarray
    """(channels, patches)."""

    def before(self, u_px: float) -> np.ndarray:
        """Radiance of everything that lies before `u_px`, (channels, patches)."""
        count = self.scattered.shape[0] - 1
        at = min(max((u_px - self.first_px) / STRIP_PX, 0.0), float(count))
        whole = min(int(at), count - 1)
        part = at - whole
        spread = (1 - part) * self.scattered[whole] + part * self.scattered[whole + 1]
        return spread + np.clip(at - np.floor(self.place), 0, 1) * self.direct


class SynthScene:
    """An object of the simulator under the lights and the slit of a rig, as a simulated camera sees it.

    Args:
        job: Names the object and the rig.
    """

    def __init__(self, job: CaptureJob) -> None:
        self._obj: SimulatedObject = make_object(
            job.object.preset, size=job.object.size_px, channels=job.object.channels
        )
        self._rig: SimulatedRig = rig_of(job.rig)
        if self._rig.camera.bits is None:
            raise SettingsError("rig.bits=null: a simulated camera gives whole numbers; give 8 to 16")
        self._px_per_mm = job.rig.slab_step_px * job.rig.sweep.rate_hz / job.rig.sweep.speed_mm_s
        self._strips: dict[tuple[str, Axis], Strips] = {}

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self._obj.size

    @property
    def lights(self) -> Sequence[str]:
        """Names."""
        return tuple(self._rig.lights_by_name)

    @property
    def largest(self) -> int:
        """Code of full scale."""
        return 2 ** (self._rig.camera.bits or 16) - 1

    def extent_mm(self, light: str, axis: Axis) -> list[float]:
        """Where the slit's middle starts and ends so that it passes over the whole object."""
        u = slab_coordinate(self._obj.points, self._rig.lights_by_name[light].direction or (0, 0, 1), axis)
        room = self._rig.slab_width_px / 2 + MARGIN_PX
        ends = (float(u.min()) - room, float(u.max()) + room)
        return [CENTRE_MM + end / self._px_per_mm for end in ends]

    def render(self, view: View) -> np.ndarray:
        """Codes of one exposure."""
        camera = self._rig.camera
        if view.light is None:
            patches = torch.zeros((self._obj.channels, len(self._obj.points)), dtype=torch.float64)
        elif view.slit is None:
            patches = self._full[view.light]
        else:
            patches = torch.from_numpy(self._slab(view.light, view.slit, view.blur_mm))
        values = self._obj.picture(self._scale * patches)
        # A full picture has the noise that the simulator gives it: a capture differs from it by what the rig does.
        rng = noise(0, f"full/{view.light}" if view.name == f"full-{view.light}" else view.name)
        seen = encoded(camera, exposed(camera, values, view.exposure_s, sigma=0.0, rng=rng))
        codes = np.rint(seen.clamp(0, 1).numpy() * self.largest)
        codes = codes.astype(np.uint8 if self.largest <= 255 else np.uint16)
        return codes[0] if codes.shape[0] == 1 else np.ascontiguousarray(codes.transpose(1, 2, 0))

    def _slab(self, light: str, slit: tuple[Axis, float], blur_mm: float) -> np.ndarray:
        axis, at_mm = slit
        if (light, axis) not in self._strips:
            self._strips[light, axis] = self._make_strips(light, axis)
        strips, half = self._strips[light, axis], self._rig.slab_width_px / 2
        total = np.zeros_like(strips.direct)
        # Simpson's rule over the way during the exposure.
        for shift, weight in ((-0.5, 1 / 6), (0.0, 4 / 6), (0.5, 1 / 6)):
            middle = (at_mm + shift * blur_mm - CENTRE_MM) * self._px_per_mm
            total += weight * (strips.before(middle + half) - strips.before(middle - half))
        return total

    @cached_property
    def _transport(self) -> Any:
        return transport(self._obj, None)

    @cached_property
    def _lit(self) -> dict[str, Any]:
        return {light.name: illuminate(self._obj, self._transport, light) for light in self._rig.lights}

    @cached_property
    def _full(self) -> dict[str, torch.Tensor]:
        columns = torch.stack([lit.entering for lit in self._lit.values()], -1)
        spread = self._transport.spread(columns)
        return {
            name: lit.direct + lit.intensity[:, None] * spread[..., at]
            for at, (name, lit) in enumerate(self._lit.items())
        }

    @cached_property
    def _scale(self) -> float:
        values = torch.cat([picture.flatten() for picture in self._full.values()]).numpy()
        return self._rig.camera.peak / float(np.quantile(values, 0.999))

    def _make_strips(self, light: str, axis: Axis) -> Strips:
        lit, towards = self._lit[light], self._rig.lights_by_name[light].direction or (0.0, 0.0, 1.0)
        u = slab_coordinate(self._obj.points, towards, axis)
        first = float(u.min())
        place = ((u - first) / STRIP_PX).numpy()
        index = torch.from_numpy(np.floor(place).astype(int))
        columns = torch.zeros((len(u), int(index.max()) + 1), dtype=torch.float64)
        columns[torch.arange(len(u)), index] = lit.entering
        spread = self._transport.spread(columns) * lit.intensity[:, None, None]
        running = np.concatenate([np.zeros((1, *spread.shape[:2])), spread.permute(2, 0, 1).numpy().cumsum(0)])
        return Strips(first_px=first, place=place, scattered=running, direct=lit.direct.numpy())
