"""Every light as a mix of the three basis lights (Eq. 15), from known light vectors or from the pictures.

    known vectors:  L_j = sum_i alpha_ij L_i                 alpha_j = (L_1 L_2 L_3)^-1 L_j
    pictures:       r_j(x) = sum_i alpha_ij r_i(x),          r = sign(I) |I|^(1/n_d)   (Shashua; Eq. 16)

The second line holds wherever no light of the four is shadowed and none shows a highlight. Scattering does no harm to
it, for it mixes by the same alpha. The solver is in `linear_combination`; here is what to make of its answers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.calibrate.linear_combination import AlphaEstimate, EstimateSettings, estimate_alpha
from reflectsep.data import Light, PhotometricStack, Vector
from reflectsep.errors import LightError

CONDITION_LIMIT = 50.0
"""Of the matrix of the three unit directions. Three lights 1.6 degrees round one axis reach it."""


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """How a light's alpha from the pictures compares with its known vector."""

    light: str
    angle_deg: float
    """Between the known direction and the one that the pictures imply."""
    magnitude_percent: float
    """Implied over known magnitude, less one, in per cent."""
    angle_sd_deg: float
    """Standard error of the implied direction, across the line of sight to the light."""


@dataclass(frozen=True, kw_only=True)
class AlphaReport:
    """Alpha of every light of a stack, and where it came from."""

    names: tuple[str, ...]
    alpha: Float[Tensor, "lights 3"]
    source: tuple[Literal["basis", "vectors", "pictures"], ...]
    condition: float | None
    """Of the basis lights' unit directions; None where one is unknown."""
    light_vectors: Float[Tensor, "lights 3"] | None
    """Direction times intensity, unknown ones as their alpha implies; None where a basis light is unknown."""
    estimates: tuple[AlphaEstimate | None, ...]
    """From the pictures, for every light but the basis; None where they do not carry one (`warnings` says why)."""
    agreement: tuple[Agreement, ...]
    """For the lights that have both a vector and an estimate."""
    warnings: tuple[str, ...] = field(default=())


def light_vector(light: Light) -> Vector | None:
    """Direction times intensity of `light`; None where its direction is unknown.

    An intensity given per channel belongs to the pictures, which are divided by it, and counts as 1 here.
    """
    if light.direction is None:
        return None
    x, y, z = light.direction
    scale = light.intensity[0] if len(light.intensity) == 1 else 1.0
    return (x * scale, y * scale, z * scale)


def condition_number(basis: Float[Tensor, "3 3"]) -> float:
    """Condition number of the three unit directions along the rows of `basis`; infinite where they are coplanar."""
    unit = basis.double() / basis.double().norm(dim=1, keepdim=True).clamp_min(1e-300)
    values = torch.linalg.svdvals(unit)
    return float("inf") if values[2] <= 1e-12 * values[0] else float(values[0] / values[2])


def check_basis(
    basis: Float[Tensor, "3 3"], names: Sequence[str], *, condition_limit: float = CONDITION_LIMIT
) -> float:
    """Condition number of the basis lights, refused where it is too large.

    Raises:
        LightError: the lights are repeated, coplanar or nearly so, or one has no length.
    """
    labels = ", ".join(names)
    if not bool(torch.isfinite(basis).all()) or bool((basis.norm(dim=1) <= 0).any()):
        raise LightError(f"basis lights {labels}: a direction is zero or not a finite number; expected three vectors")
    condition = condition_number(basis)
    if condition > condition_limit:
        raise LightError(
            f"basis lights {labels} are coplanar or repeated: condition number {condition:.3g}, "
            f"expected at most {condition_limit:g}; choose three lights that are further apart"
        )
    return condition


def alpha_from_vectors(vectors: Float[Tensor, "lights 3"], basis: Float[Tensor, "3 3"]) -> Float[Tensor, "lights 3"]:
    """Eq. 15: rows alpha_j with `vectors[j] = sum_i alpha_j[i] * basis[i]`, intensity included.

    Args:
        vectors: direction times intensity of every light, in the unit of `basis`.
        basis: direction times intensity of the three basis lights, checked by `check_basis`.
    """
    alpha = torch.linalg.solve(basis.double().mT, vectors.double().mT).mT
    return alpha.to(vectors.dtype)


def solve_alpha(
    names: Sequence[str],
    vectors: Sequence[Vector | None],
    images: Float[Tensor, "lights channels height width"],
    usable: Bool[Tensor, "lights channels height width"],
    *,
    settings: EstimateSettings | None = None,
    condition_limit: float = CONDITION_LIMIT,
) -> AlphaReport:
    """Alpha of every light: from its vector where that and the basis are known, from the pictures where not.

    Args:
        names: of the lights, the basis first.
        vectors: direction times intensity, None where unknown.
        images: linear pictures on one scale, the basis first.
        usable: false where a value may not be used (off the object, clipped, not a number).
        settings: of the estimate from the pictures, n_d among them.
        condition_limit: largest condition number of the basis lights.

    Raises:
        LightError: coplanar or repeated basis lights, or an alpha that is needed and that the pictures do not carry.
    """
    settings = settings or EstimateSettings()
    basis = _basis_vectors(vectors)
    condition = None if basis is None else check_basis(basis, names[:3], condition_limit=condition_limit)
    alpha = torch.eye(3, dtype=torch.float64).repeat(len(names) // 3 + 1, 1)[: len(names)]
    source: list[Literal["basis", "vectors", "pictures"]] = ["basis"] * 3
    estimates: list[AlphaEstimate | None] = []
    agreement: list[Agreement] = []
    warnings: list[str] = []
    for j in range(3, len(names)):
        known = vectors[j] if basis is not None else None
        estimate = _estimate(names, j, images, usable, settings, warnings if known is not None else None)
        estimates.append(estimate)
        if known is not None and basis is not None:
            vector = torch.tensor(known, dtype=torch.float64)
            alpha[j] = alpha_from_vectors(vector[None], basis)[0]
            source.append("vectors")
            if estimate is not None:
                agreement.append(compare_vectors(names[j], vector, estimate, basis))
        elif estimate is not None:
            alpha[j] = estimate.alpha.double()
            source.append("pictures")
    return AlphaReport(
        names=tuple(names),
        alpha=alpha.float(),
        source=tuple(source),
        condition=condition,
        light_vectors=None if basis is None else (alpha @ basis).float(),
        estimates=tuple(estimates),
        agreement=tuple(agreement),
        warnings=tuple(warnings),
    )


def report_alpha(
    stack: PhotometricStack, lights: Sequence[Light], *, settings: EstimateSettings | None = None
) -> AlphaReport:
    """What `solve_alpha` says of a finished stack, e.g. once n_d is known; `lights` as in the capture, any order.

    Raises:
        LightError: as `solve_alpha`.
    """
    by_name = {light.name: light for light in lights}
    vectors = [light_vector(by_name[name]) if name in by_name else None for name in stack.names]
    usable = stack.mask & ~stack.saturated
    return solve_alpha(stack.names, vectors, stack.images, usable, settings=settings, condition_limit=math.inf)


def compare_vectors(
    name: str, known: Float[Tensor, "3"], estimate: AlphaEstimate, basis: Float[Tensor, "3 3"]
) -> Agreement:
    """Angle and magnitude between a known light vector and the one that `estimate` implies, `alpha @ basis`."""
    implied = estimate.alpha.double() @ basis.double()
    known = known.double()
    sine = torch.linalg.cross(implied, known).norm()
    angle = torch.atan2(sine, implied @ known)  # exact for small angles, where acos is not
    covariance = basis.double().mT @ estimate.covariance.double() @ basis.double()
    unit = implied / implied.norm()
    across = torch.eye(3, dtype=torch.float64) - torch.outer(unit, unit)
    spread = torch.trace(across @ covariance @ across).clamp_min(0).sqrt() / implied.norm()
    return Agreement(
        light=name,
        angle_deg=math.degrees(float(angle)),
        magnitude_percent=100.0 * (float(implied.norm() / known.norm()) - 1.0),
        angle_sd_deg=math.degrees(float(spread)),
    )


def _basis_vectors(vectors: Sequence[Vector | None]) -> Tensor | None:
    """The three basis vectors as rows, or None where one is unknown."""
    basis = [vector for vector in vectors[:3] if vector is not None]
    return torch.tensor(basis, dtype=torch.float64) if len(basis) == 3 else None


def _estimate(
    names: Sequence[str],
    j: int,
    images: Tensor,
    usable: Tensor,
    settings: EstimateSettings,
    warnings: list[str] | None,
) -> AlphaEstimate | None:
    """Light j's estimate; what fails goes to `warnings`, or is raised where there are none (it is needed)."""
    try:
        return estimate_alpha(images[:3], images[j], usable[:3].all(0) & usable[j], settings=settings)
    except LightError as error:
        message = f"light {names[j]} as a mix of {', '.join(names[:3])}: {error}"
        if warnings is None:
            raise LightError(message) from None
        warnings.append(message)
        return None
