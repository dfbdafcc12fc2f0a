"""Relit pictures that a fit of another model is made on, and how far that model is from them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.errors import LightError
from reflectsep.separation import Separation
from reflectsep.srgb import encoded

GOLDEN_DEG = 180.0 * (3.0 - math.sqrt(5.0))
"""Turn from one place of a sunflower to the next."""


@dataclass(frozen=True, kw_only=True)
class Distance:
    """Peak signal-to-noise ratio of screen values (0 to 1, peak 1) against `relight`, over the object, in dB."""

    inside_db: float
    """Lights between the basis lights."""
    all_db: float
    """Lights up to the largest angle that was fitted."""


def cap(count: int, tilt_deg: float) -> Float[Tensor, "lights 3"]:
    """Unit vectors spread evenly over the cap around the view (z): a sunflower's places."""
    rank = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1.0 - rank / count * (1.0 - math.cos(math.radians(tilt_deg)))
    r, turn = (1.0 - z.square()).sqrt(), rank * math.radians(GOLDEN_DEG)
    return torch.stack([r * turn.cos(), r * turn.sin(), z], -1)


def mixes(separation: Separation, directions: Float[Tensor, "lights 3"]) -> Float[Tensor, "lights 3"]:
    """Alpha of lights of the basis lights' mean intensity.

    Raises:
        LightError: the directions of the basis lights are unknown or coplanar.
    """
    if separation.light_vectors is None:
        raise LightError("the result's lights have no directions: an export by light direction needs them")
    basis = separation.light_vectors[:3].double()
    sizes = torch.linalg.svdvals(basis)
    if float(sizes[2]) <= 1e-6 * float(sizes[0]):
        raise LightError("the result's basis lights are coplanar; expected three directions that span space")
    return torch.linalg.solve(basis.mT, directions.mT).mT * float(basis.norm(dim=1).mean())


def screen_picture(
    separation: Separation, alpha: Float[Tensor, "3"], white: float
) -> Float[Tensor, "channels height width"]:
    """The relit picture as a screen shows it, 0 to 1."""
    with torch.no_grad():
        return encoded(separation.relight(alpha.float()).double() / white)


def distance(
    separation: Separation, model: Callable[[Tensor], Tensor], *, white: float, tilt_deg: float, count: int = 16
) -> Distance:
    """Compare `model(direction)`, a screen picture, with the relit one at directions that no fit has used.

    Raises:
        LightError: as `mixes`.
    """
    # Half a step off those of a fit, which start at another count.
    directions = cap(count, tilt_deg)
    basis = separation.light_vectors
    inside = torch.empty(0, 3, dtype=torch.float64)
    if basis is not None:
        weights = torch.rand(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) + 0.02
        inside = torch.nn.functional.normalize(weights @ basis[:3].double(), dim=1)
    errors = []
    for group in (inside, directions):
        alphas = mixes(separation, group)
        square = [
            (model(v) - screen_picture(separation, alpha, white))[:, separation.mask].square().mean()
            for v, alpha in zip(group, alphas, strict=True)
        ]
        errors.append(float(torch.stack(square).mean()))
    inside_db, all_db = (math.inf if e == 0 else -10.0 * math.log10(e) for e in errors)
    return Distance(inside_db=inside_db, all_db=all_db)
