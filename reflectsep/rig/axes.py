"""Axes of a stage as they are configured: which of the controller's axes moves the slit, and how far and fast."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

from reflectsep.errors import SettingsError, StageError
from reflectsep.rig.devices import Axis, AxisLimits
from reflectsep.settings import nearest


@dataclass(frozen=True, kw_only=True)
class StageAxis:
    """One axis, by its configuration."""

    letter: str
    """Of the controller's axis."""
    travel_mm: tuple[float, float]
    steps_per_mm: float
    max_speed_mm_s: float
    acceleration_mm_s2: float

    def limits(self, slowest_steps_s: float) -> AxisLimits:
        """With the slowest step rate at which the controller keeps time."""
        return AxisLimits(
            travel_mm=self.travel_mm,
            speed_mm_s=(slowest_steps_s / self.steps_per_mm, self.max_speed_mm_s),
            acceleration_mm_s2=self.acceleration_mm_s2,
            step_mm=1.0 / self.steps_per_mm,
        )


def stage_axes(config: Mapping[str, Mapping[str, Any]], where: str) -> dict[Axis, StageAxis]:
    """Axes from settings.

    Args:
        config: By axis of the picture: letter, travel_mm, steps_per_mm, max_speed_mm_s, acceleration_mm_s2.
        where: Names the settings in errors.

    Raises:
        SettingsError: an axis that is not x or y, a key missing or unknown, or a value that cannot be.
    """
    if not config or not set(config) <= {"x", "y"}:
        raise SettingsError(f"{where}.axes: {', '.join(config) or 'none'}; expected x, and y where there is one")
    return {cast(Axis, name): _axis(given, f"{where}.axes.{name}") for name, given in config.items()}


def within(limits: Mapping[Axis, AxisLimits], axis: Axis, target_mm: float, speed_mm_s: float, where: str) -> None:
    """Refuse a motion that the stage cannot make.

    Raises:
        StageError: no such axis, outside the travel, too slow or too fast.
    """
    if axis not in limits:
        raise StageError(f"{where}: no axis {axis}; it has {', '.join(limits)}")
    known = limits[axis]
    low, high = known.travel_mm
    if not low - 1e-9 <= target_mm <= high + 1e-9:
        raise StageError(f"{where}: {axis} = {target_mm:g} mm is outside its travel, {low:g} to {high:g} mm")
    slowest, fastest = known.speed_mm_s
    if not slowest * (1 - 1e-9) <= speed_mm_s <= fastest * (1 + 1e-9):
        raise StageError(f"{where}: {speed_mm_s:g} mm/s along {axis}; it keeps time from {slowest:g} to {fastest:g}")


def _axis(given: Mapping[str, Any], where: str) -> StageAxis:
    known = ("letter", "travel_mm", "steps_per_mm", "max_speed_mm_s", "acceleration_mm_s2")
    for key in given:
        if key not in known:
            raise SettingsError(f"{where}.{key}: no such setting{nearest(key, known)}")
    for key in known:
        if key not in given:
            raise SettingsError(f"{where}.{key}: missing")
    travel = given["travel_mm"]
    if not isinstance(travel, Sequence) or len(travel) != 2 or not float(travel[0]) < float(travel[1]):
        raise SettingsError(f"{where}.travel_mm={travel}: expected [lowest, highest]")
    numbers = {key: float(given[key]) for key in known[2:]}
    for key, value in numbers.items():
        if not 0 < value < float("inf"):
            raise SettingsError(f"{where}.{key}={value:g}: must be above 0")
    return StageAxis(letter=str(given["letter"]), travel_mm=(float(travel[0]), float(travel[1])), **numbers)
