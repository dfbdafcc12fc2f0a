"""The measured pictures of a result, for the page to show beside the model's: 8-bit codes of the sRGB curve."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.separation import Separation
from reflectsep.srgb import encoded
from reflectsep.viewer.planes import halved_picture

MOST = 24
"""Lights whose pictures go along: the basis and the first of the others."""


def measured_pictures(separation: Separation) -> dict[str, Float[Tensor, "channels height width"]]:
    """Pictures as captured, by light, linear: the basis lights' components, the others' model plus residual.

    A light outside the basis that has a sweep of its own was fitted with its measured scattering, which a result does
    not keep; its picture cannot be put together again and is left out.
    """
    swept = {sweep["light"] for sweep in separation.document.get("sweeps", [])}
    basis = separation.highlight_free + separation.specular
    pictures = {name: basis[i] for i, name in enumerate(separation.basis)}
    for i, name in enumerate(separation.names[3:MOST], start=3):
        if name not in swept:
            pictures[name] = separation.relight(separation.alpha[i]) + separation.residual[i]
    return {name: torch.nan_to_num(picture) * separation.mask for name, picture in pictures.items()}


def coded(picture: Float[Tensor, "channels height width"], white: float) -> np.ndarray:
    """8-bit codes (channels, height, width) of the sRGB curve, with `white` at 255."""
    return (255.0 * encoded(picture.double() / white) + 0.5).floor().to(torch.uint8).numpy()


def reduced(picture: Float[Tensor, "channels height width"], mask: Tensor, factor: int) -> Tensor:
    """`picture` at a level's resolution: means over the object's pixels, 2 x 2 at a time."""
    weight = mask[None].float()
    picture = picture * weight
    while factor > 1:
        share = halved_picture(weight)
        picture = halved_picture(picture * weight) / share.clamp_min(1e-6)
        weight, factor = (share >= 0.5).float(), factor // 2
    return picture * weight
