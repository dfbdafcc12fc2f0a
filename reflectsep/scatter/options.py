"""Settings of the scattering stage."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from reflectsep.data import SweepReport
from reflectsep.errors import SettingsError

HoleFilling = Literal["profile", "maximum", "interpolation"]
LitBand = Literal["threshold", "profile"]


@dataclass(frozen=True, kw_only=True)
class HeldSweeps:
    """Exponent and gains that the sweeps of another part of the same object, taken alike, have given."""

    n_d: float
    n_d_sd: float
    n_d_source: Literal["estimated", "fixed", "unidentifiable"]
    sweeps: tuple[SweepReport, ...]

    def of(self, light: str, direction: str) -> SweepReport:
        """What there is of a sweep.

        Raises:
            SettingsError: nothing.
        """
        for report in self.sweeps:
            if (report.light, report.direction) == (light, direction):
                return report
        known = ", ".join(f"{report.light} along {report.direction}" for report in self.sweeps) or "none"
        raise SettingsError(f"sweep of {light} along {direction}: no gain of it is given; given are {known}")


@dataclass(frozen=True, kw_only=True)
class ScatterOptions:
    """How the scattering comes out of the sweeps.

    Raises:
        SettingsError: a value that cannot be.
    """

    hole_filling: HoleFilling = "profile"
    """What stands in where the slab itself lit (see reflectsep/scatter/filling.py)."""
    lit_band: LitBand = "profile"
    """Fillings `maximum` and `interpolation` only. Lit frames of a pixel: those near its passage that exceed
    `threshold`, or those of its lit interval in time."""
    threshold: float = 0.25
    """Frame over full picture, both on one scale, above which a pixel is lit."""
    n_d: float | None = None
    """Exponent of the diffuse part; None: estimated from Eq. 25."""
    distance_px: float = 1.0
    """Filling `profile` only: light that left farther than this from where it entered counts as scattering."""
    lit_frames: float | None = None
    """Frames in which a patch is lit (slab width over step), where the rig knows it; None: from the profiles."""
    held: HeldSweeps | None = None
    """n_d, gains, lit frames and steps that are not to be estimated."""
    reach_frames: int = 9
    """Frames on either side of the lit interval from which a pixel's profile is fitted."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("threshold", 0.0, 1.0),
            ("n_d", 0.0, 10.0),
            ("lit_frames", 0.0, 1e4),
            ("reach_frames", 1.0, 1e3),
        ):
            value = getattr(self, name)
            if value is not None and not low < value <= high:
                raise SettingsError(f"scatter.{name}={value}: must be above {low:g} and at most {high:g}")
        if not (math.isfinite(self.distance_px) and self.distance_px >= 0.0):
            raise SettingsError(f"scatter.distance_px={self.distance_px}: must be 0 or more")
        if self.hole_filling not in HoleFilling.__args__:
            raise SettingsError(f"scatter.hole_filling={self.hole_filling}: expected {', '.join(HoleFilling.__args__)}")
        if self.lit_band not in LitBand.__args__:
            raise SettingsError(f"scatter.lit_band={self.lit_band}: expected {', '.join(LitBand.__args__)}")
