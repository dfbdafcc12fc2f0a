"""What the pixels around a pixel say: smooth maps with their scatter, and lobes handed on from neighbour to neighbour.

About one pixel in a hundred has two minima of nearly equal cost, one wrong. Smoothing would blur the ninety-nine;
instead a pixel is offered its neighbours' lobe as a start, and keeps whichever of its minima costs least. What the
neighbours would have a pixel be is a regression over them that leaves the pixel itself out.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn.functional import conv2d, pad, unfold

from reflectsep.fit.chunks import in_chunks

MAD_TO_SD = 1.4826
PIXELS_OF_A_BAND = 1 << 16
QUADRATIC = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
"""Powers of x and y of a quadratic surface."""


def to_map(values: Float[Tensor, "pixels channels"], mask: Bool[Tensor, "height width"]) -> Tensor:
    """Values of the mask's pixels as pictures (channels, height, width), zero elsewhere."""
    picture = values.new_zeros(values.shape[1], *mask.shape)
    picture[:, mask] = values.T
    return picture


def smooth(
    values: Float[Tensor, "pixels channels"],
    weight: Float[Tensor, "pixels"],
    mask: Bool[Tensor, "height width"],
    sigma_px: float,
) -> Float[Tensor, "pixels channels"]:
    """Gaussian mean over the pixels of the mask, each counted by its weight (normalised convolution)."""
    reach = 2 * max(1, round(3 * sigma_px)) + 1
    blur = lambda p: gaussian_blur2d(p[None], (reach, reach), (sigma_px, sigma_px), "constant")[0]  # noqa: E731
    total = blur(to_map(values * weight[:, None], mask))
    count = blur(to_map(weight[:, None], mask))
    return (total / count.clamp_min(1e-12))[:, mask].T


def neighbourhood(
    values: Float[Tensor, "pixels channels"], mask: Bool[Tensor, "height width"], radius: int
) -> Float[Tensor, "pixels channels window"]:
    """Values of the window about every pixel, the pixel itself left out; NaN where the mask ends."""
    picture = to_map(values, mask)
    picture = torch.where(mask, picture, torch.nan)
    side = 2 * radius + 1
    window = unfold(pad(picture[:, None], (radius,) * 4, value=torch.nan), side)
    window = torch.cat([window[:, : side * side // 2], window[:, side * side // 2 + 1 :]], 1)
    return window[:, :, mask.flatten()].permute(2, 0, 1)


def local_median(
    values: Float[Tensor, "pixels channels"], mask: Bool[Tensor, "height width"], radius: int
) -> Float[Tensor, "pixels channels"]:
    """Median of the neighbours, channel by channel; a pixel without neighbours keeps its own value."""
    result, (height, width), at = torch.empty_like(values), mask.shape, 0
    band = max(1, PIXELS_OF_A_BAND // width)
    before = mask.sum(1).cumsum(0).tolist()
    # Band by band, with the rows that its windows reach into: the windows are far larger than the picture.
    for top in range(0, height, band):
        first, last = max(0, top - radius), min(height, top + band + radius)
        pixels = slice(before[first - 1] if first else 0, before[last - 1])
        wanted = torch.zeros_like(mask[first:last])
        wanted[top - first : top - first + band] = True
        windows = neighbourhood(values[pixels], mask[first:last], radius)[wanted[mask[first:last]]]
        end = before[min(top + band, height) - 1]
        result[at:end] = windows.nanmedian(-1).values
        at = end
    return torch.where(result.isfinite(), result, values)


def local_quadratic(
    values: Float[Tensor, "pixels channels"],
    weight: Float[Tensor, "pixels"],
    mask: Bool[Tensor, "height width"],
    sigma_px: float,
) -> tuple[Float[Tensor, "pixels channels"], Float[Tensor, "pixels"]]:
    """Every pixel as its neighbours predict it, and the variance of that if `weight` is 1 / variance.

    A quadratic surface through the others, by least squares under a Gaussian window: a mean would flatten whatever is
    curved, and a curved surface is what a highlight lies on.
    """
    reach = max(1, round(3 * sigma_px))
    along = torch.arange(-reach, reach + 1, dtype=values.dtype) / sigma_px
    window = torch.exp(-0.5 * along.square())
    weights, weighted = to_map(weight[:, None], mask), to_map(values * weight[:, None], mask)

    holed = window.clone()
    holed[reach] = 0.0  # the pixel itself has no say

    def line(picture: Tensor, kernel: Tensor, axis: int) -> Tensor:
        shape, padding = ((-1, 1), (reach, 0)) if axis == 0 else ((1, -1), (0, reach))
        return conv2d(picture[:, None], kernel.view(1, 1, *shape), padding=padding)[:, 0]

    # Moments are products of a power of x and one of y: two passes along lines, the first ones shared.
    pictures = (weights, weighted)
    rows = [[line(picture, along**py * window, 0) for py in range(5 - 2 * i)] for i, picture in enumerate(pictures)]

    def moment(px: int, py: int, which: int) -> Float[Tensor, "pixels channels"]:
        if px == py == 0:
            total = line(rows[which][0], holed, 1) + line(pictures[which], holed, 0)
        else:
            total = line(rows[which][py], along**px * window, 1)
        return total[:, mask].T

    powers = {(a + c, b + d) for a, b in QUADRATIC for c, d in QUADRATIC}
    moments = {power: moment(*power, 0)[:, 0] for power in sorted(powers)}
    right = torch.stack([moment(a, b, 1) for a, b in QUADRATIC], 1)
    # A trace of a ridge: where few neighbours are left the surface is flatter rather than wild.
    ridge = 1e-4 * torch.eye(len(QUADRATIC), dtype=values.dtype)

    def centre(cut: slice) -> Tensor:
        rows = [torch.stack([moments[a + c, b + d][cut] for c, d in QUADRATIC], -1) for a, b in QUADRATIC]
        system = torch.stack(rows, -2)
        unit = system.diagonal(dim1=-2, dim2=-1).clamp_min(1e-30).rsqrt()
        inverse = torch.linalg.inv(system * unit[:, :, None] * unit[:, None, :] + ridge)
        surface = (inverse @ (right[cut] * unit[:, :, None])) * unit[:, :, None]
        return torch.cat([surface[:, 0], (inverse[:, 0, 0] * unit[:, 0].square())[:, None]], -1)

    found = in_chunks(len(values), centre)
    return found[:, :-1], found[:, -1]
