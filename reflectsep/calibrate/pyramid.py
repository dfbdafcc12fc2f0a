"""Two pictures at one scale after the other, blurred, with the slopes that a motion is read from."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from kornia.filters import gaussian_blur2d, spatial_gradient
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from reflectsep.calibrate.register_options import RegisterOptions

MAD_TO_SIGMA = 1.4826
COARSEST_PX = 24
SLOPE_BLURS = (0.0, 1.0, 1.6, 2.4, 3.6)
SLOPE_NOISE = 0.05


@dataclass(frozen=True, kw_only=True)
class Level:
    """Both sides at one scale."""

    moving: Float[Tensor, "height width"]
    moving_bad: Float[Tensor, "height width"] | None
    """1 next to values that are clipped or not finite; None where there are none."""
    template: Float[Tensor, "height width"]
    weight: Float[Tensor, "height width"]
    slopes: Float[Tensor, "2 height width"]
    slope_blur_px: float
    """Further blur of pictures that slopes are taken from."""
    time: Float[Tensor, "height width"]
    factor: int


def to_level(matrix: Tensor, factor: int) -> Tensor:
    """A matrix of full pixels in those of a picture that was shrunk by `factor`."""
    shrink = _shrink(factor)
    return shrink @ matrix @ torch.linalg.inv(shrink)


def from_level(matrix: Tensor, factor: int) -> Tensor:
    """A matrix of a picture that was shrunk by `factor` in full pixels."""
    shrink = _shrink(factor)
    back = torch.linalg.inv(shrink) @ matrix @ shrink
    return back / back[2, 2]


def _shrink(factor: int) -> Tensor:
    offset = (1.0 / factor - 1.0) / 2.0  # pixel centres of averaged blocks
    return torch.tensor([[1.0 / factor, 0, offset], [0, 1.0 / factor, offset], [0, 0, 1.0]], dtype=torch.float64)


def pyramid_of(
    moving: Tensor, moving_usable: Tensor, template: Tensor, usable: Tensor, time: Tensor, options: RegisterOptions
) -> list[Level]:
    """Coarsest first."""
    pictures = torch.stack([moving, template]).double()
    pictures = torch.where(torch.isfinite(pictures), pictures, 0.0)
    bad, weight, time = (~moving_usable).double(), usable.double(), time.double()
    factor, levels = 1, []
    while True:
        if pictures[0].numel() <= options.most_pixels:
            levels.append(_level(pictures, bad, weight, time, factor, options.blur_px))
            if len(levels) > options.levels or min(pictures.shape[1:]) < 2 * COARSEST_PX:
                break
        pictures = avg_pool2d(pictures[:, None], 2)[:, 0]
        time = avg_pool2d(time[None, None], 2)[0, 0]
        bad = max_pool2d(bad[None, None], 2)[0, 0]
        weight = avg_pool2d(weight[None, None], 2)[0, 0]
        factor *= 2
    return levels[::-1]


def _level(pictures: Tensor, bad: Tensor, weight: Tensor, time: Tensor, factor: int, blur_px: float) -> Level:
    radius = max(1, round(3 * blur_px))
    smooth = blurred(pictures, blur_px)
    slope_blur_px = _slope_blur(pictures, smooth, weight, blur_px)
    grown = max_pool2d(bad[None, None], 2 * radius + 1, stride=1, padding=radius)[0, 0]
    holes = max_pool2d((weight == 0).double()[None, None], 3, stride=1, padding=1)[0, 0]
    return Level(
        moving=smooth[0],
        moving_bad=grown if bool((bad > 0).any()) else None,
        template=smooth[1],
        weight=torch.where(holes > 0, 0.0, weight),
        slopes=slopes_of(smooth[1:], slope_blur_px)[0],
        slope_blur_px=slope_blur_px,
        time=time,
        factor=factor,
    )


def blurred(pictures: Tensor, blur_px: float) -> Tensor:
    """Gaussian, of pictures (any, height, width)."""
    if blur_px <= 0:
        return pictures
    size = 2 * max(1, round(3 * blur_px)) + 1
    size = min(size, 2 * ((min(pictures.shape[1:]) - 1) // 2) + 1)
    return gaussian_blur2d(pictures[:, None], (size, size), (blur_px, blur_px), border_type="replicate")[:, 0]


def slopes_of(pictures: Tensor, blur_px: float) -> Tensor:
    """Slopes (any, 2, height, width) along x and y, of pictures blurred further."""
    return spatial_gradient(blurred(pictures, blur_px)[:, None], mode="diff", order=1)[:, 0]


def _slope_blur(raw: Tensor, smooth: Tensor, weight: Tensor, blur_px: float) -> float:
    """The least further blur at which noise makes up less than `SLOPE_NOISE` of the slopes' energy.

    Noisy slopes would be taken for signal: the estimate would seem surer than it is, and follow the noise.
    """
    kernel = torch.tensor([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]], dtype=raw.dtype) / 6.0
    counts = weight > 0
    detail = torch.nn.functional.conv2d(raw[:, None], kernel[None, None], padding=1)[:, 0, counts]
    noise = MAD_TO_SIGMA * detail.abs().median(1).values
    for more in SLOPE_BLURS:
        energy = slopes_of(smooth, more).square().sum(1)[:, counts].mean(1)
        width = (blur_px**2 + more**2) ** 0.5
        share = noise.square() / (4 * torch.pi * width**4) / energy.clamp_min(1e-300)
        if bool((share < SLOPE_NOISE).all()):
            return more
    return SLOPE_BLURS[-1]
