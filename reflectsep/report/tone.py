"""Linear pictures to 8-bit sRGB: one curve for everything that is shown."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8, UInt16
from torch import Tensor

from reflectsep.srgb import encoded

INVALID = (255, 0, 255)
"""Magenta: shown where a value is not a finite number."""


def tone(picture: Float[Tensor, "channels height width"], *, white: float = 1.0) -> UInt8[np.ndarray, "height width 3"]:
    """The picture as it is shown: divided by `white`, clipped to 0..1, through the sRGB curve.

    Args:
        picture: linear, 1 or 3 channels.
        white: linear value that is shown as full white.

    Returns:
        8-bit sRGB, grey pictures with three equal channels; magenta where a value is not finite.

    Raises:
        ValueError: not 1 or 3 channels, or a white that is not positive.
    """
    codes, valid = _coded(picture, white, 255)
    pixels = codes.astype(np.uint8)
    pixels[~valid] = INVALID
    return pixels


def tone_16(
    picture: Float[Tensor, "channels height width"], *, white: float = 1.0
) -> UInt16[np.ndarray, "height width 3"]:
    """As `tone`, with 16 bits: 65535 is white.

    Raises:
        ValueError: not 1 or 3 channels, or a white that is not positive.
    """
    codes, valid = _coded(picture, white, 65535)
    pixels = codes.astype(np.uint16)
    pixels[~valid] = [257 * value for value in INVALID]
    return pixels


def _coded(picture: Tensor, white: float, largest: int) -> tuple[np.ndarray, np.ndarray]:
    """Codes (height, width, 3) of the sRGB curve as floats, and which pixels are finite."""
    if picture.ndim != 3 or picture.shape[0] not in (1, 3):
        raise ValueError(f"picture of shape {tuple(picture.shape)}; expected (1 or 3, height, width)")
    if not white > 0:
        raise ValueError(f"white {white:g}; expected a positive value")
    linear = picture.detach().cpu().double() / white
    valid = torch.isfinite(linear).all(0)
    linear = torch.nan_to_num(linear, nan=0.0, posinf=0.0, neginf=0.0)
    codes = (largest * encoded(linear) + 0.5).floor().expand(3, -1, -1).permute(1, 2, 0)
    return codes.numpy().copy(), valid.numpy()


def white_point(
    pictures: Iterable[Float[Tensor, "channels height width"]],
    mask: Bool[Tensor, "height width"] | None = None,
    *,
    share: float = 0.995,
) -> float:
    """Value that `share` of the object's values of these pictures stay below; 1 where they are all zero or less."""
    values = [picture.detach().cpu().float() for picture in pictures]
    inside = torch.cat([(v if mask is None else v[:, mask.cpu()]).reshape(-1) for v in values])
    inside = inside[torch.isfinite(inside)]
    if inside.numel() == 0:
        return 1.0
    rank = min(inside.numel(), max(1, round(share * inside.numel())))
    limit = float(inside.kthvalue(rank).values)
    return limit if limit > 0 else 1.0
