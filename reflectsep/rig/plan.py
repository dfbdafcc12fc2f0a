"""The plan: every picture and sweep of a session as data, before anything moves; and whether the rig can do it."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from reflectsep.data import Light
from reflectsep.errors import SettingsError
from reflectsep.rig.devices import Axis, AxisLimits

Exposure = Literal["full", "slab"]
SETTLE_S = 0.8
"""Around a still picture: switching the light, setting the exposure, writing."""
REPORTS_LEAST_S = 1.2
"""Cruise below which the position reports, five a second, are too few for a line."""
LEAD_FRAMES = 2
"""Frames that the camera takes before the stage moves, and after it has stopped."""


@dataclass(frozen=True, kw_only=True)
class Still:
    """One picture: a light on and the slit out of it, or no light."""

    name: str
    kind: Literal["full", "dark"]
    light: str | None
    exposure: Exposure
    frames: int = 1
    """Averaged; more than one only in dark pictures, where nothing saturates."""


@dataclass(frozen=True, kw_only=True)
class SlabSweep:
    """The slit of one light moving over the object."""

    name: str
    light: str
    axis: Axis
    start_mm: float
    end_mm: float
    """Where the slit is in the first and the last frame; the run-up lies outside."""
    speed_mm_s: float
    rate_hz: float
    motion: Literal["continuous", "stepped"] = "continuous"
    """Stepped: the stage stands still for every frame, for cameras that take one at a time."""

    @property
    def step_mm(self) -> float:
        """Way from frame to frame."""
        return self.speed_mm_s / self.rate_hz

    @property
    def frames(self) -> int:
        """Number of frames, within one."""
        return int(abs(self.end_mm - self.start_mm) / self.step_mm) + 1


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Everything that decides the pictures; the same plan takes the same session."""

    object: str
    lights: Mapping[str, Light]
    basis: tuple[str, str, str]
    stills: tuple[Still, ...]
    sweeps: tuple[SlabSweep, ...]
    park_mm: float
    """On axis x, where the slit is out of the light."""
    exposure_s: Mapping[Exposure, float | None]
    """None: found by test frames."""
    encoding: str | float
    """`linear`, or a gamma."""
    mask: Literal["auto", "none"]
    max_lost: float
    """Share of a sweep's frames that may be lost."""

    def digest(self) -> str:
        """SHA-256 of the whole plan."""
        return hashlib.sha256(json.dumps(self.document(), sort_keys=True).encode()).hexdigest()

    def document(self) -> dict[str, object]:
        """The plan as JSON."""
        return json.loads(json.dumps(dataclasses.asdict(self)))

    @property
    def shots(self) -> tuple[Still | SlabSweep, ...]:
        """In the order in which they are taken."""
        full = [still for still in self.stills if still.kind == "full"]
        dark = [still for still in self.stills if still.kind == "dark"]
        return (*full, *self.sweeps, *dark)


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """What a plan will cost."""

    duration_s: float
    frames: int
    bytes: int


def make_stills(lights: tuple[str, ...], *, swept: bool, dark_frames: int) -> tuple[Still, ...]:
    """A full picture of every light, and dark ones of every exposure."""
    stills = [Still(name=f"full-{light}", kind="full", light=light, exposure="full") for light in lights]
    if dark_frames:
        stills.append(Still(name="dark", kind="dark", light=None, exposure="full", frames=dark_frames))
        if swept:
            stills.append(Still(name="dark-slab", kind="dark", light=None, exposure="slab", frames=dark_frames))
    return tuple(stills)


def check_plan(plan: Plan, limits: Mapping[Axis, AxisLimits]) -> None:
    """Refuse what the stage cannot do.

    Raises:
        SettingsError: a sweep too slow or too fast, too short to be checked, or outside the travel with its run-up.
    """
    for sweep in plan.sweeps:
        where = f"sweep of {sweep.light} along {sweep.axis}"
        if sweep.axis not in limits:
            raise SettingsError(f"{where}: the stage has no axis {sweep.axis}; it has {', '.join(limits)}")
        known = limits[sweep.axis]
        slowest, fastest = known.speed_mm_s
        speed = sweep.speed_mm_s
        if not slowest <= speed <= fastest:
            which = (
                f"below {slowest:.4g} mm/s its motor steps too slowly for the controller to keep time"
                if speed < slowest
                else f"the stage reaches {fastest:g} mm/s at most"
            )
            raise SettingsError(f"{where}: rig.sweep.speed_mm_s={speed:g}: {which}")
        if not sweep.start_mm < sweep.end_mm:
            raise SettingsError(f"{where}: from {sweep.start_mm:g} to {sweep.end_mm:g} mm; expected start below end")
        if sweep.motion == "continuous" and (sweep.end_mm - sweep.start_mm) / speed < REPORTS_LEAST_S:
            raise SettingsError(
                f"{where}: takes {(sweep.end_mm - sweep.start_mm) / speed:.2g} s; its speed cannot be checked in less "
                f"than {REPORTS_LEAST_S:g} s"
            )
        low, high = known.travel_mm
        first, last = run(sweep, known)
        if first < low or last > high:
            raise SettingsError(
                f"{where}: with its run-up from {first:.3f} to {last:.3f} mm; the stage travels {low:g} to {high:g} mm"
            )
    low, high = limits["x"].travel_mm
    if not low <= plan.park_mm <= high:
        raise SettingsError(f"rig.sweep.park_mm={plan.park_mm:g}: the stage travels {low:g} to {high:g} mm")


def run(sweep: SlabSweep, limits: AxisLimits) -> tuple[float, float]:
    """Where the motion of a sweep starts and ends: with run-up, and room for the frames at its ends."""
    if sweep.motion == "stepped":
        return sweep.start_mm - 2 * sweep.step_mm, sweep.end_mm
    room = 1.1 * limits.ramp_mm(sweep.speed_mm_s) + 0.5 * sweep.step_mm
    return sweep.start_mm - room, sweep.end_mm + room


def estimate(plan: Plan, limits: Mapping[Axis, AxisLimits], frame_bytes: int) -> Estimate:
    """Time, frames and disk space of a plan; space is an upper bound, of frames that do not compress."""
    duration, frames = 0.0, 0
    for still in plan.stills:
        exposure = plan.exposure_s[still.exposure] or 0.1
        duration += SETTLE_S + still.frames * exposure
        frames += 1
    for sweep in plan.sweeps:
        known = limits[sweep.axis]
        first, last = run(sweep, known)
        back = (last - first) / known.speed_mm_s[1]
        each = SETTLE_S / 2 if sweep.motion == "stepped" else 0.0
        duration += (last - first) / sweep.speed_mm_s + back + 2 * SETTLE_S + sweep.frames * each
        frames += sweep.frames
    return Estimate(duration_s=duration, frames=frames, bytes=(frames + len(plan.stills)) * frame_bytes)


def describe_plan(plan: Plan, limits: Mapping[Axis, AxisLimits], frame_bytes: int, free_bytes: int | None) -> str:
    """The plan for a person."""
    lines = [f"object {plan.object}, {len(plan.lights)} lights, basis {' '.join(plan.basis)}"]
    said = {key: "by test frames" if value is None else f"{value:g} s" for key, value in plan.exposure_s.items()}
    lines.append(f"exposures: full pictures {said['full']}, slab frames {said['slab']}")
    for shot in plan.shots:
        if isinstance(shot, Still):
            what = f"light {shot.light}" if shot.light else f"no light, mean of {shot.frames}"
            lines.append(f"  {shot.name:14} {shot.kind} picture, {what}, {said[shot.exposure]}")
        else:
            first, last = run(shot, limits[shot.axis])
            lines.append(
                f"  {shot.name:14} {shot.motion} sweep along {shot.axis}, light {shot.light}, {shot.start_mm:g} to "
                f"{shot.end_mm:g} mm (motion {first:.2f} to {last:.2f}) at {shot.speed_mm_s:g} mm/s, "
                f"{shot.frames} frames every {shot.step_mm:g} mm"
            )
    for name, axis in limits.items():
        lines.append(
            f"stage {name}: {axis.travel_mm[0]:g} to {axis.travel_mm[1]:g} mm, {axis.speed_mm_s[0]:.4g} to "
            f"{axis.speed_mm_s[1]:g} mm/s, {axis.acceleration_mm_s2:g} mm/s^2, steps of {1000 * axis.step_mm:g} um"
        )
    cost = estimate(plan, limits, frame_bytes)
    free = "" if free_bytes is None else f" of {free_bytes / 1e9:.1f} GB free"
    minutes, seconds = divmod(round(cost.duration_s), 60)
    lines.append(f"about {minutes} min {seconds} s, {cost.frames} pictures, at most {cost.bytes / 1e6:.1f} MB{free}")
    return "\n".join(lines)
