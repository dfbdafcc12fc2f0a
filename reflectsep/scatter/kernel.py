"""How scattered light spreads: exponentials of the distance, and what they make of a line and of a slab of light.

    phi(r; l) = e^(-r/l) / (2 pi l^2),    a line at distance t: 2 t K_1(t/l) / (2 pi l^2) = -d/dt strip(t; l),
    strip(t; l) = Lambda(t/l) / (2 pi),   Lambda(v) = integral over u > v of 2 u K_1(u),   Lambda(0) = pi

so that strip is the light from all that lies farther than t on one side, and a half for t = 0. Lambda has no closed
form and is tabulated.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

SCALES = 5
FINEST = 0.25
"""Smallest scale, in steps of the slab; the others are each twice the one before."""
LARGEST_V, ENTRIES = 16.0, 4096
"""Reach and size of the table; e^-16 is nothing."""


def scales(step_px: float) -> Float[Tensor, "scales"]:
    """Scales l of the exponentials, pixels: from a part of a step to four of them."""
    return FINEST * step_px * 2.0 ** torch.arange(SCALES, dtype=torch.float32)


def spread(distance: Float[Tensor, "*pairs"], scale: float) -> Float[Tensor, "*pairs"]:
    """Phi at a distance, 1/px^2: all that enters leaves."""
    return (distance * (-1.0 / scale)).exp_().mul_(1.0 / (2.0 * math.pi * scale**2))


def strip(distance: Float[Tensor, "*places"], scale: float | Tensor) -> Float[Tensor, "*places"]:
    """Part of the light that enters farther than a distance on one side and leaves here."""
    place = (distance * ((ENTRIES - 1) / LARGEST_V / scale)).clamp(0.0, ENTRIES - 1.001)
    low = place.to(torch.int32)
    return torch.lerp(_TABLE[low], _TABLE[low + 1], place - low)


def _table() -> Float[Tensor, "entries"]:
    """Lambda / (2 pi) at equal steps of v, by Simpson's rule."""
    step = LARGEST_V / (ENTRIES - 1)
    v = torch.arange(2 * ENTRIES - 1, dtype=torch.float64) * (step / 2)
    line = torch.where(v > 0, 2 * v * torch.special.modified_bessel_k1(v.clamp(min=1e-9)), 2.0)
    parts = (line[:-2:2] + 4 * line[1:-1:2] + line[2::2]) * (step / 6)
    beyond = parts.flip(0).cumsum(0).flip(0)
    return (torch.cat([beyond, beyond.new_zeros(1)]) / (2 * math.pi)).float()


_TABLE = _table()
