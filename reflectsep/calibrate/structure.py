"""Fine structure of a picture's logarithm: what of it stays on the surface whatever the light.

    f = whitened (G_fine - G_coarse) * log(I / bright + SMALL)

Albedo is a summand of the logarithm. Shading is smooth, and outlines, shadows and whatever else is dark are left out.
Whitened, every frequency has one vote, as in phase correlation: otherwise the contrast of shaded relief outvotes print.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from reflectsep.calibrate.pyramid import blurred

SMALL = 0.05
"""Of the picture's bright end: darker values are noise in the logarithm."""
DARK = 0.1
"""Of the bright end: what is darker over more than `STROKE_PX` to all sides is shadow or background, not print."""
STROKE_PX = 3
FINE_PX, COARSE_PX = 0.8, 2.0
RIM_PX = 5
"""Within so many pixels of the object's rim and of a shadow nothing counts: such edges go with the light."""


@dataclass(frozen=True, kw_only=True)
class Structure:
    """What of a picture is compared, in the object's box at the level."""

    values: Float[Tensor, "rows columns"]
    """Whitened fine structure of the logarithm, of RMS 1 where it counts."""
    weight: Float[Tensor, "rows columns"]
    """1 where it counts: away from the object's rim, from shadows and from whatever else is dark."""


def structure_of(picture: Tensor, corner: tuple[int, int], inner: Tensor, factor: int) -> Structure:
    """Fine structure of a picture's logarithm inside the object, and where it is the surface's."""
    (top, left), (rows, columns) = corner, (length * factor for length in inner.shape)
    values = halved(picture[top : top + rows, left : left + columns], factor).double().clamp_min(0)
    on_object = values[inner > 0]
    bright = on_object.kthvalue(max(1, round(0.9 * on_object.numel()))).values.clamp_min(1e-12)
    lit = inner * _shrunk((_grown(values, STROKE_PX) > DARK * bright).double(), STROKE_PX)
    logarithm = torch.log(values / bright + SMALL) * lit
    # Blurs count lit pixels alone, so that outlines and shadows leave no edge.
    fine, coarse = (blurred(torch.stack([logarithm, lit]), width) for width in (FINE_PX, COARSE_PX))
    structure = (fine[0] / fine[1].clamp_min(1e-3) - coarse[0] / coarse[1].clamp_min(1e-3)) * lit
    weight = torch.zeros_like(lit)
    weight[RIM_PX:-RIM_PX, RIM_PX:-RIM_PX] = _shrunk(lit, RIM_PX)[RIM_PX:-RIM_PX, RIM_PX:-RIM_PX]
    whitened = _whitened(structure * blurred(_shrunk(lit, STROKE_PX)[None], COARSE_PX)[0])
    rms = (whitened.square() * weight).sum() / weight.sum().clamp_min(1.0)
    return Structure(values=whitened / rms.sqrt().clamp_min(1e-300), weight=weight)


def _whitened(values: Tensor) -> Tensor:
    """All frequencies of a map at one amplitude, up to those that its grid carries well."""
    spectrum = torch.fft.rfft2(values, padded(values.shape))
    size = spectrum.abs()
    y, x = torch.fft.fftfreq(size.shape[0]).double()[:, None], torch.fft.rfftfreq(2 * size.shape[1] - 2).double()
    low = torch.exp(-2 * (math.pi * FINE_PX) ** 2 * (x.square() + y.square()))
    white = spectrum * low / (size + 0.05 * size.mean() + 1e-300)
    return torch.fft.irfft2(white, padded(values.shape))[: values.shape[0], : values.shape[1]]


def padded(shape: torch.Size) -> list[int]:
    """Even lengths with small factors that leave a margin, for a transform that does not meet its other end."""
    return [64 * math.ceil((length + 4 * RIM_PX) / 64) for length in shape]


def halved(values: Tensor, factor: int) -> Tensor:
    """Means of blocks of `factor` by `factor` values."""
    return avg_pool2d(values[None], factor)[0] if factor > 1 else values


def _grown(values: Tensor, pixels: int) -> Tensor:
    """The largest value within so many pixels along both axes."""
    return max_pool2d(values[None], 2 * pixels + 1, stride=1, padding=pixels)[0]


def _shrunk(values: Tensor, pixels: int) -> Tensor:
    """The least value within so many pixels along both axes."""
    return -_grown(-values, pixels)
