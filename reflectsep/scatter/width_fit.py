"""The slab's width by the profiles themselves, where no exposure ratio gives it.

Counting (width.py) takes the scattering within the lit interval for that beside it, which is off by 1 to 3 per cent on
wax and pudding, and by 5 to 7 where the width is no whole number of steps. Here every pixel's frames are fitted by what
they are, a plateau with the width of the slab and edges as wide as a pixel, and line spreads of the same slab on either
side,

    v(u) = D clamp((h + e - |u|) / 2 e, 0, 1) + sum_i [A-_i E-(u; s_i, h) + A+_i E+(u; s_i, h)],     D, A >= 0
    E-(u; s) = e^(min(u+h,0)/s) - e^(min(u-h,0)/s),    E+(u; s) = E-(-u; s)

and the width 2 h, one for all pixels, is where they leave least. A frame that is lit in part goes from dark to bright
within 2 e, so that hundreds of pixels tell the width to some parts in a thousand.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from reflectsep.scatter.width import FEWEST, Kept
from reflectsep.solve.nonnegative import nonnegative_least_squares

SMALLEST_SCALE, LARGEST_SCALE = 0.35, 2.8
"""Of the line spreads, in frames; the largest for half a slab of a frame."""
PIXELS = 800
"""Pixels at most that are fitted."""
REACH = 6.0
"""Frames beyond the lit interval that are fitted."""
OUTSHINE = 2.0
"""A pixel counts where its brightest frame is so many times as bright as those beside."""
LEAST_PEAK = 0.2
"""Of the median pixel's brightest frame."""
BEST = 0.7
"""Part of the pixels that has a say: those which the model explains best."""
RIDGE = 1e-5
COARSE = (0.82, 0.86, 0.90, 0.94, 0.97, 1.0, 1.03, 1.06, 1.10, 1.14, 1.18)
"""Of the first guess."""
FINE = (0.97, 0.98, 0.99, 1.0, 1.01, 1.02, 1.03)
"""Of the best of those."""


def fitted_width(
    kept: Kept,
    centre: Float[Tensor, "height width"],
    narrow: Tensor,
    *,
    guess: float,
    step_px: float,
) -> float | None:
    """Frames that light a patch, by the profiles of pixels that show them clearly.

    Args:
        kept: frames of some pixels.
        centre: frame in which the middle of the slab passes a pixel.
        narrow: pixels that the slab lights.
        guess: of the number.
        step_px: pixels that the slab moves in a frame.

    Returns:
        The number; None where fewer than 64 pixels show it, or none of the widths tried is best.
    """
    offset = kept.index[:, None] - centre.flatten()[kept.at]
    chosen = _clear(kept, offset, narrow.flatten()[kept.at], guess)
    if len(chosen) < FEWEST:
        return None
    value, u = kept.value[:, chosen], offset[:, chosen]
    value = value / value.masked_fill(u.abs() > guess, 0.0).amax(0)
    weight = (~kept.spoilt[:, chosen] & (u.abs() <= 0.5 * guess + REACH)).to(value)
    rows = weight.any(1)
    profiles = value[rows], u[rows], weight[rows]
    edge = max(0.5 / step_px, 0.05)

    def left(half: float) -> Tensor:
        return _left(*profiles, half, edge)

    coarse = torch.stack([left(0.5 * guess * f) for f in COARSE])
    least = coarse.amin(0)
    believed = least <= least.quantile(BEST)
    k = int(coarse[:, believed].mean(1).argmin())
    if k in (0, len(COARSE) - 1):
        return None
    best = guess * COARSE[k]
    fine = [float(left(0.5 * best * f)[believed].double().mean()) for f in FINE]
    return best * _lowest(FINE, fine)


def scales(half: float) -> Float[Tensor, "scales"]:
    """Scales of the exponentials in frames, a factor of two apart: from what a frame resolves to nearly three slabs."""
    count = 1 + round(math.log2(LARGEST_SCALE * max(1.0, half) / SMALLEST_SCALE))
    return SMALLEST_SCALE * 2.0 ** torch.arange(count, dtype=torch.float32)


def line_response(
    u: Float[Tensor, "frames values"], half: float, s: Float[Tensor, "scales"]
) -> Float[Tensor, "frames sides_scales values"]:
    """E- then E+ for every scale, of a slab at offset u; the sum over frames a unit step apart is 2 h."""
    columns = []
    for side in (u, -u):
        v, scale = side[:, None, :], s[:, None]
        far, near = ((half - v) / scale).clamp(min=0), ((-half - v) / scale).clamp(min=0)
        columns.append(torch.exp(-near) - torch.exp(-far))
    return torch.cat(columns, 1)


def _clear(kept: Kept, offset: Tensor, narrow: Tensor, guess: float) -> Int[Tensor, "some"]:
    """Pixels with all frames near their passage sound, whose lit frames stand out."""
    away = offset.abs()
    near = away <= 0.5 * guess + 2.0
    peak = kept.value.masked_fill(~near, 0.0).amax(0)
    beside = kept.value.masked_fill((away <= 0.5 * guess + 1.0) | (away > 0.5 * guess + 3.0), 0.0).amax(0)
    whole = near.sum(0) >= guess + 3.0  # the sweep neither begins nor ends there
    sound = narrow & whole & ~(kept.spoilt & near).any(0) & (peak > OUTSHINE * beside)
    if not bool(sound.any()):
        return sound.nonzero()[:, 0]
    sound &= peak > LEAST_PEAK * peak[sound].median()
    found = sound.nonzero()[:, 0]
    return found[:: max(1, -(-len(found) // PIXELS))]


def _left(
    value: Float[Tensor, "frames P"],
    u: Float[Tensor, "frames P"],
    weight: Float[Tensor, "frames P"],
    half: float,
    edge: float,
) -> Float[Tensor, "P"]:
    """Squared residual of every pixel's best profile for a width."""
    plateau = ((half + edge - u.abs()) / (2.0 * edge)).clamp(0.0, 1.0)
    spread = line_response(u, half, scales(half))
    columns = torch.cat([spread, plateau[:, None]], 1)
    normal = torch.einsum("fap,fbp,fp->abp", columns, columns, weight)
    normal = normal + RIDGE * torch.eye(len(normal))[..., None]
    right = torch.einsum("fap,fp,fp->ap", columns, value, weight)
    amplitude = nonnegative_least_squares(normal, right)
    return ((value - torch.einsum("fap,ap->fp", columns, amplitude)).square() * weight).sum(0)


def _lowest(places: tuple[float, ...], values: list[float]) -> float:
    """Place of the minimum, by the parabola through the least value and its neighbours."""
    k = min(max(values.index(min(values)), 1), len(values) - 2)
    (a, b, c), (x, y, z) = places[k - 1 : k + 2], values[k - 1 : k + 2]
    below, above = (y - x) / (b - a), (z - y) / (c - b)
    bend = (above - below) / (c - a)
    if bend <= 0:
        return b
    return min(max(0.5 * (a + b) - below / (2.0 * bend), a), c)
