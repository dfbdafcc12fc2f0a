"""Exposure: whether a picture fits into the camera's range, what would fit, and finding it by test pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from reflectsep.errors import CameraError

CLIPPED = 0.995
"""Of full scale; at and above it a value counts as saturated."""
SATURATED_SHARE = 0.001
AIM = 0.7
"""Of full scale, for the brightest 0.1 % of a picture."""
DARK = 0.08
"""A slab frame whose brightest 0.1 % are below this wastes the camera's range."""
TRIES = 8


@dataclass(frozen=True, kw_only=True)
class Brightness:
    """What a picture uses of the range."""

    high: float
    """The 99.9 % quantile, 0 to 1."""
    saturated: float
    """Share of values at full scale."""


def brightness(values: np.ndarray) -> Brightness:
    """Of a picture from 0 to 1."""
    return Brightness(high=float(np.quantile(values, 0.999)), saturated=float((values >= CLIPPED).mean()))


def fitting(exposure_s: float, seen: Brightness) -> float:
    """The exposure that would bring the brightest 0.1 % to where they should be; a guess where they are clipped."""
    if seen.high >= CLIPPED:
        return exposure_s * 0.25
    return exposure_s * min(AIM / max(seen.high, 1e-3), 16.0)


def warning(what: str, exposure_s: float | None, seen: Brightness, *, slab: bool) -> str | None:
    """A line for the person at the rig where a picture is clipped, or a slab frame too dark; else None."""
    if seen.saturated > SATURATED_SHARE:
        said = f"{100 * seen.saturated:.2g} % of its pixels are saturated"
    elif slab and seen.high < DARK:
        said = f"its brightest pixels reach only {100 * seen.high:.2g} % of the range"
    else:
        return None
    fit = "" if exposure_s is None else f"; {fitting(exposure_s, seen):.3g} s would fit ({exposure_s:.3g} s is set)"
    return f"{what}: {said}{fit}"


def find_exposure(
    take: Callable[[float], tuple[float | None, np.ndarray]], first_s: float, bounds_s: tuple[float, float]
) -> float:
    """The exposure whose brightest 0.1 % are between a half and nine tenths of full scale.

    Args:
        take: Takes a test picture at an exposure; returns the exposure read back, and values from 0 to 1.
        first_s: To begin with.
        bounds_s: Shortest and longest that may be used.

    Returns:
        The exposure as it was set; at a bound where nothing within fits better.

    Raises:
        CameraError: still clipped at the shortest.
    """
    low, high = bounds_s
    exposure_s = min(max(first_s, low), high)
    for _ in range(TRIES):
        actual_s, values = take(exposure_s)
        seen = brightness(values)
        if 0.5 <= seen.high <= 0.9:
            return exposure_s
        wanted = min(max(fitting(exposure_s if actual_s is None else actual_s, seen), low), high)
        if wanted == exposure_s:
            if seen.high >= CLIPPED:
                raise CameraError(f"pictures saturate even at the shortest exposure, {exposure_s:g} s: dim the lights")
            return exposure_s
        exposure_s = wanted
    return exposure_s
