"""How far one picture is from another, over the object's pixels."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def psnr(
    picture: Float[Tensor, "*batch height width"],
    truth: Float[Tensor, "*batch height width"],
    mask: Bool[Tensor, "height width"] | None = None,
    *,
    peak: float | None = None,
) -> float:
    """Peak signal-to-noise ratio, 10 log10(peak^2 / mean squared error), in dB; infinite for equal pictures.

    Args:
        picture: the picture in question, linear.
        truth: what it should be.
        mask: pixels that count; all where None.
        peak: of the signal; the truth's largest value over the mask where None.

    Raises:
        ValueError: shapes differ, nothing is in the mask, a value in it is not finite, or the peak is not positive.
    """
    found, expected = _inside(picture, truth, mask)
    peak = float(expected.max()) if peak is None else peak
    if not peak > 0:
        raise ValueError(f"peak {peak:g} of the true picture; expected a positive one")
    error = float((found - expected).square().mean())
    return math.inf if error == 0 else 10.0 * math.log10(peak * peak / error)


def relative_rms(
    picture: Float[Tensor, "*batch height width"],
    truth: Float[Tensor, "*batch height width"],
    mask: Bool[Tensor, "height width"] | None = None,
) -> float:
    """RMS of the error over the RMS of the truth, 0 and up; infinite where the truth is nothing and the picture is not.

    Raises:
        ValueError: shapes differ, nothing is in the mask, or a value in it is not finite.
    """
    found, expected = _inside(picture, truth, mask)
    error, size = float((found - expected).norm()), float(expected.norm())
    if size == 0:
        return 0.0 if error == 0 else math.inf
    return error / size


def _inside(picture: Tensor, truth: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Both pictures' values over the mask, in float64."""
    if picture.shape != truth.shape:
        raise ValueError(f"pictures of shapes {tuple(picture.shape)} and {tuple(truth.shape)} cannot be compared")
    if mask is not None and mask.shape != picture.shape[-2:]:
        raise ValueError(f"mask of shape {tuple(mask.shape)} for pictures of {tuple(picture.shape[-2:])}")
    found, expected = picture.detach().cpu().double(), truth.detach().cpu().double()
    if mask is not None:
        found, expected = found[..., mask.cpu()], expected[..., mask.cpu()]
    if found.numel() == 0:
        raise ValueError("no pixels to compare; expected a mask that is not empty")
    if not bool(torch.isfinite(found).all() and torch.isfinite(expected).all()):
        raise ValueError("a value to compare is not a finite number")
    return found, expected
