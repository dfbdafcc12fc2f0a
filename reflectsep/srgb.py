"""The sRGB curve (IEC 61966-2-1), for whatever is shown on a screen."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def encoded(linear: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Linear values, clipped to 0 to 1, as a screen wants them: 0 to 1."""
    linear = linear.clamp(0.0, 1.0)
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
