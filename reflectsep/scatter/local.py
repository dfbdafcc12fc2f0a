"""Sums over neighbours and quantiles of pictures of any size, in time that goes with the number of pixels."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d, pad


def box_sum(
    pictures: Float[Tensor, "*channels height width"], size: int = 5
) -> Float[Tensor, "*channels height width"]:
    """Sum over size x size neighbours, nothing beyond the border."""
    height, width = pictures.shape[-2:]
    reach = size // 2
    padded = pad(pictures, (reach, reach, reach, reach))
    rows = padded[..., :height, :].clone()
    for i in range(1, size):
        rows += padded[..., i : i + height, :]
    result = rows[..., :width].clone()
    for i in range(1, size):
        result += rows[..., i : i + width]
    return result


def quantile(values: Float[Tensor, "*shape"], q: float) -> Float[Tensor, ""]:
    """As torch's, linear between neighbours, but of any number of values and without sorting them."""
    values = values.flatten()
    place = q * (values.numel() - 1)
    low, high = math.floor(place), math.ceil(place)
    lower = values.kthvalue(low + 1).values
    return lower if high == low else lower.lerp(values.kthvalue(high + 1).values, place - low)


def gaussian(picture: Float[Tensor, "height width"], sigma: float) -> Float[Tensor, "height width"]:
    """Mean over neighbours with Gaussian weights, nothing beyond the border."""
    reach = max(1, math.ceil(3 * sigma))
    bell = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, dtype=picture.dtype) / sigma) ** 2)
    bell = bell / bell.sum()
    rows = conv2d(picture[None, None], bell[None, None, None], padding=(0, reach))
    return conv2d(rows, bell[None, None, :, None], padding=(reach, 0))[0, 0]
