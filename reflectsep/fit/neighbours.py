"""What the pixels around a pixel say: smooth maps with their scatter, and lobes handed on from neighbour to neighbour.

About one pixel in a hundred has two minima of nearly equal cost, one wrong. Smoothing would blur the ninety-nine;
instead a pixel is offered its neighbours' lobe as a start, and keeps whichever of its minima costs least. What the
neighbours would have a pixel be is a regression over them that leaves the pixel itself out.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn.functional import conv2d, pad, unfold

from reflectsep.fit.chunks import in_chunks
from reflectsep.kernel.linear import factorise, packed_at, solve
from reflectsep.room import rows

MAD_TO_SD = 1.4826
PIXELS_OF_WINDOWS = 1 << 16
PIXELS_OF_A_BAND = 1 << 18
"""Of the frame, at once: of a quadratic surface some hundred megabytes are in between."""
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
    reach = max(1, round(3 * sigma_px))
    window, sigma = (2 * reach + 1, 2 * reach + 1), (sigma_px, sigma_px)
    blurred = lambda p: gaussian_blur2d(p[None], window, sigma, "constant")[0]  # noqa: E731

    def mean(pixels: slice, part: Tensor, wanted: Tensor) -> Tensor:
        total = blurred(to_map(values[pixels] * weight[pixels, None], part))
        count = blurred(to_map(weight[pixels, None], part))
        return (total / count.clamp_min(1e-12))[:, part].T[wanted]

    return in_bands(mask, reach, PIXELS_OF_A_BAND, mean)


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

    def median(pixels: slice, part: Tensor, wanted: Tensor) -> Tensor:
        own = values[pixels]
        found = neighbourhood(own, part, radius)[wanted].nanmedian(-1).values
        return torch.where(found.isfinite(), found, own[wanted])

    # The windows are far larger than the picture.
    return in_bands(mask, radius, PIXELS_OF_WINDOWS, median)


def in_bands(
    mask: Bool[Tensor, "height width"], reach: int, at_once: int, work: Callable[[slice, Tensor, Tensor], Tensor]
) -> Tensor:
    """Rows of the picture some at a time, each time with the rows beside them that windows reach into.

    `work` has the band's pixels as a slice of the mask's, its part of the mask, and which of these pixels are wanted;
    it gives these one row each.
    """
    height, width = mask.shape
    band = max(1, at_once // width)
    before = [0, *mask.sum(1).cumsum(0).tolist()]
    result: Tensor | None = None
    for top in range(0, height, band):
        end = min(top + band, height)
        if before[top] == before[end] and (result is not None or end < height):
            continue
        first, last = max(0, top - reach), min(height, end + reach)
        within = torch.zeros_like(mask[first:last])
        within[top - first : end - first] = True
        part = work(slice(before[first], before[last]), mask[first:last], within[mask[first:last]])
        if result is None:
            result = rows(before[-1], part)
        result[before[top] : before[end]] = part
    assert result is not None  # a picture has rows
    return result


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

    def predicted(pixels: slice, part: Tensor, wanted: Tensor) -> Tensor:
        return _quadratic(values[pixels], weight[pixels], part, sigma_px)[wanted]

    found = in_bands(mask, reach, PIXELS_OF_A_BAND, predicted)
    return found[:, :-1], found[:, -1]


def _quadratic(values: Tensor, weight: Tensor, mask: Tensor, sigma_px: float) -> Float[Tensor, "pixels channels+1"]:
    """`local_quadratic` of one band: predictions and, last, their variance."""
    reach = max(1, round(3 * sigma_px))
    along = torch.arange(-reach, reach + 1, dtype=values.dtype) / sigma_px
    window = torch.exp(-0.5 * along.square())
    profiles = torch.stack([along**power * window for power in range(5)])
    holed = window.clone()
    holed[reach] = 0.0  # the pixel itself has no say

    def moments(picture: Float[Tensor, "channels height width"], degree: int) -> dict[tuple[int, int], Tensor]:
        """(channels, pixels) of x^px y^py under the window for every px + py <= degree, the pixel itself left out."""
        # Of a power of x and one of y: two passes along lines, each with all powers at once.
        columns = lines(picture, torch.cat([profiles[: degree + 1], holed[None]]), 0)
        found = {}
        for py in range(degree + 1):
            powers = profiles[: degree + 1 - py]
            if py == 0:
                powers = torch.cat([holed[None], powers[1:]])
            for px, moment in enumerate(lines(columns[:, py], powers, 1).unbind(1)):
                total = moment + columns[:, -1] if px == py == 0 else moment
                found[px, py] = total[:, mask]
        return found

    weights, right = to_map(weight[:, None], mask), to_map(values * weight[:, None], mask)
    of_weights, of_values = moments(weights, 4), moments(right, 2)
    size = len(QUADRATIC)
    upper = [(i, j) for i in range(size) for j in range(i, size)]

    def centre(cut: slice) -> Tensor:
        at = [of_weights[a + c, b + d][0, cut] for (a, b), (c, d) in ((QUADRATIC[i], QUADRATIC[j]) for i, j in upper)]
        unit = [at[packed_at(size, k, k)].clamp_min(1e-30).rsqrt() for k in range(size)]
        system = [entry * unit[i] * unit[j] for (i, j), entry in zip(upper, at, strict=True)]
        # A trace of a ridge: where few neighbours are left the surface is flatter rather than wild.
        ridge = [torch.full_like(unit[0], 1e-4)] * size
        # Of the surface only its height here is wanted, a sum of the right hand sides by the inverse's first row.
        first = [torch.ones_like(unit[0]), *[torch.zeros_like(unit[0])] * (size - 1)]
        row = [x * u * unit[0] for x, u in zip(solve(factorise(system, ridge), first), unit, strict=True)]
        height = torch.zeros_like(of_values[0, 0][:, cut])
        for x, power in zip(row, QUADRATIC, strict=True):
            height = height + x * of_values[power][:, cut]
        return torch.cat([height, row[0][None]]).T

    return in_chunks(len(values), centre)


def lines(
    picture: Float[Tensor, "channels height width"], profiles: Float[Tensor, "profiles window"], axis: int
) -> Float[Tensor, "channels profiles height width"]:
    """The picture correlated with each profile along its columns (axis 0) or its rows (1); zeros beyond its edge."""
    reach = profiles.shape[1] // 2
    shape, padding = ((-1, 1), (reach, 0)) if axis == 0 else ((1, -1), (0, reach))
    return conv2d(picture[:, None], profiles.view(len(profiles), 1, *shape), padding=padding)
