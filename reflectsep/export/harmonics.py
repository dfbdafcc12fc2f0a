"""Pictures as a sum of few functions of the light's direction, fitted to relit pictures by least squares.

* `ptm`: the polynomial of Malzbender, Gelb and Wolters (2001): 1, u, v, u^2, uv, v^2 of the projected direction.
* `hsh`: hemispherical harmonics to the second order (Gautron, Krivanek, Pattanaik and Bouatouch, 2004): 9 functions.

Both are fitted to what a screen shows (sRGB curve, 0 to 1), because RTI viewers show what the functions give.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.export.lights import cap, mixes, screen_picture
from reflectsep.progress import Progress, silent
from reflectsep.separation import Separation

Family = Literal["ptm", "hsh"]
LIGHTS = 48
"""Relit pictures that the functions are fitted to."""


def ptm_terms(directions: Float[Tensor, "lights 3"]) -> Float[Tensor, "lights 6"]:
    """1, u, v, u^2, uv, v^2."""
    u, v = directions[..., 0], directions[..., 1]
    return torch.stack([torch.ones_like(u), u, v, u * u, u * v, v * v], -1)


def hsh_terms(directions: Float[Tensor, "lights 3"]) -> Float[Tensor, "lights 9"]:
    """The nine functions, in the order of their degree and, within it, from -m to m turned to cosines and sines."""
    x, y, c = directions.unbind(-1)
    phi = torch.atan2(y, x)
    g = (c - c * c).clamp_min(0.0).sqrt()
    one = torch.ones_like(c)
    return torch.stack(
        [
            one / math.sqrt(2 * math.pi),
            math.sqrt(6 / math.pi) * phi.cos() * g,
            math.sqrt(3 / (2 * math.pi)) * (2 * c - 1),
            math.sqrt(6 / math.pi) * phi.sin() * g,
            math.sqrt(30 / math.pi) * (2 * phi).cos() * (c * c - c),
            math.sqrt(30 / math.pi) * phi.cos() * (2 * c - 1) * g,
            math.sqrt(5 / (2 * math.pi)) * (1 - 6 * c + 6 * c * c),
            math.sqrt(30 / math.pi) * phi.sin() * (2 * c - 1) * g,
            math.sqrt(30 / math.pi) * (2 * phi).sin() * (c * c - c),
        ],
        -1,
    )


TERMS: dict[str, Callable[[Tensor], Tensor]] = {"ptm": ptm_terms, "hsh": hsh_terms}


def fit_terms(
    separation: Separation, family: Family, *, white: float, tilt_deg: float, progress: Progress = silent
) -> Float[Tensor, "terms channels height width"]:
    """Coefficients of the least squares fit to relit pictures spread over the cap around the view.

    Args:
        separation: to be relit, one light at a time.
        family: which functions.
        white: linear value that is shown as 1.
        tilt_deg: largest angle of the lights off the view.
        progress: told of every light.

    Raises:
        LightError: as `export.lights.mixes`.
    """
    directions = cap(LIGHTS, tilt_deg)
    alphas = mixes(separation, directions)
    solver = torch.linalg.pinv(TERMS[family](directions))
    coefficients = torch.zeros(len(solver), *separation.d.shape[1:], dtype=torch.float64)
    for k, alpha in enumerate(alphas):
        picture = screen_picture(separation, alpha, white)
        coefficients += solver[:, k, None, None, None] * picture
        progress("export", k + 1, LIGHTS)
    return coefficients


def evaluated(
    coefficients: Float[Tensor, "terms channels height width"], family: Family, direction: Float[Tensor, "3"]
) -> Float[Tensor, "channels height width"]:
    """Screen picture of one light, clipped to 0 to 1 as a viewer does."""
    return torch.einsum("t,tchw->chw", TERMS[family](direction[None].double())[0], coefficients).clamp(0.0, 1.0)


def quantised(
    coefficients: Float[Tensor, "terms channels height width"],
) -> tuple[Tensor, list[float], list[float]]:
    """8-bit codes of every coefficient, with one scale and bias a term: value = (code / 255 - bias) * scale.

    The bias is a whole number of 255ths, and the code of 0 is exact, so that what is black stays black.
    """
    codes, scales, biases = [], [], []
    for plane in coefficients:
        low, high = min(0.0, float(plane.min())), max(0.0, float(plane.max()))
        span = max(high - low, 1e-6) * 255 / 253  # room for the rounding of the bias
        bias = math.ceil(-low / span * 255) / 255
        codes.append((255 * (plane / span + bias)).round().clamp(0, 255).to(torch.uint8))
        scales.append(span)
        biases.append(bias)
    return torch.stack(codes), scales, biases
