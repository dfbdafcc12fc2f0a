"""How light that entered a surface at one point leaves at another: radially symmetric spreading kernels.

A kernel R(r) has unit 1/px^2: of the flux that enters at a point, R(r) dA leaves through a patch dA at distance r.
Its integral over a plane is the share that leaves at all (at most 1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.errors import SettingsError


class Kernel(Protocol):
    """A radially symmetric spreading kernel."""

    def __call__(self, r_px: Float[Tensor, "*pairs"]) -> Float[Tensor, "*pairs"]:
        """R(r), 1/px^2, at distances r >= 0."""
        ...

    def within(self, radius_px: float) -> float:
        """Share of the entering flux that leaves within `radius_px` on a plane, 0..1."""
        ...

    @property
    def reach_px(self) -> float:
        """Length over which the far tail falls by a factor e."""
        ...


@dataclass(frozen=True)
class ExponentialKernel:
    """R(r) = sum_m w_m exp(-r / l_m) / (2 pi l_m^2), with sum_m w_m = 1: everything that enters leaves."""

    weights: tuple[float, ...]
    lengths_px: tuple[float, ...]

    def __post_init__(self) -> None:
        """Refuse weights that make or lose light."""
        if len(self.weights) != len(self.lengths_px) or not self.weights:
            raise SettingsError(
                f"exponential kernel: {len(self.weights)} weights for {len(self.lengths_px)} lengths, expected as many"
            )
        if min(self.weights) < 0 or abs(sum(self.weights) - 1) > 1e-9:
            raise SettingsError(f"exponential kernel: weights {self.weights}, expected none below 0 and a sum of 1")
        if not min(self.lengths_px) > 0:
            raise SettingsError(f"exponential kernel: lengths {self.lengths_px} px, expected all above 0")

    def __call__(self, r_px: Float[Tensor, "*pairs"]) -> Float[Tensor, "*pairs"]:
        """R(r), 1/px^2."""
        value = torch.zeros_like(r_px)
        for weight, length in zip(self.weights, self.lengths_px, strict=True):
            value += (r_px / -length).exp_().mul_(weight / (2 * math.pi * length**2))
        return value

    def within(self, radius_px: float) -> float:
        """Share that leaves within `radius_px`: sum_m w_m (1 - (1 + r/l) exp(-r/l))."""
        ratios = [radius_px / length for length in self.lengths_px]
        return sum(w * (1 - (1 + q) * math.exp(-q)) for w, q in zip(self.weights, ratios, strict=True))

    @property
    def reach_px(self) -> float:
        """The longest length."""
        return max(self.lengths_px)


@dataclass(frozen=True)
class DipoleKernel:
    """Diffuse reflectance R_d(r) of a semi-infinite medium, by a pair of point sources (Jensen et al. 2001, Eq. 4)."""

    scattering_per_px: float
    """Reduced scattering coefficient sigma_s'."""
    absorption_per_px: float
    """Absorption coefficient sigma_a."""
    ior: float = 1.4

    def __post_init__(self) -> None:
        """Refuse a medium that does not scatter or that amplifies."""
        if not (self.scattering_per_px > 0 and self.absorption_per_px > 0 and self.ior >= 1):
            raise SettingsError(
                f"dipole kernel: sigma_s' {self.scattering_per_px}, sigma_a {self.absorption_per_px}, ior {self.ior}; "
                "expected both coefficients above 0 and ior >= 1"
            )

    @property
    def _sources(self) -> tuple[float, float, float, float]:
        """(reduced albedo, effective attenuation, depth of the real source, height of the virtual one)."""
        extinction = self.scattering_per_px + self.absorption_per_px
        attenuation = math.sqrt(3 * self.absorption_per_px * extinction)
        f_dr = -1.440 / self.ior**2 + 0.710 / self.ior + 0.668 + 0.0636 * self.ior
        boundary = (1 + f_dr) / (1 - f_dr)
        real = 1 / extinction
        return self.scattering_per_px / extinction, attenuation, real, real * (1 + 4 / 3 * boundary)

    def __call__(self, r_px: Float[Tensor, "*pairs"]) -> Float[Tensor, "*pairs"]:
        """R_d(r), 1/px^2."""
        albedo, attenuation, *depths = self._sources
        value = torch.zeros_like(r_px)
        for depth in depths:
            distance = (r_px.square() + depth**2).sqrt()
            value += depth * (1 + attenuation * distance) * (-attenuation * distance).exp() / distance**3
        return value * (albedo / (4 * math.pi))

    def within(self, radius_px: float) -> float:
        """Share that leaves within `radius_px`; the integral of R_d over a disc has a closed form."""
        albedo, attenuation, *depths = self._sources
        total = 0.0
        for depth in depths:
            edge = math.hypot(radius_px, depth)
            total += math.exp(-attenuation * depth) - depth / edge * math.exp(-attenuation * edge)
        return albedo / 2 * total

    @property
    def reach_px(self) -> float:
        """One over the effective attenuation."""
        return 1 / self._sources[1]
