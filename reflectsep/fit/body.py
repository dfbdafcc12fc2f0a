"""The whole diffuse root before anything is known of the lobe: robust least squares of b in I = max(A b, 0)^n_d.

Highlights and cast shadows are outliers, attached shadows are clamped inside the formula. b is where a fit starts.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.model import mixed, signed_root
from reflectsep.solve.linear import factorise, solve


def robust_body(
    images: Float[Tensor, "lights channels pixels"],
    sigma: float,
    alpha: Float[Tensor, "lights 3"],
    n_d: float,
    *,
    iterations: int = 15,
) -> Float[Tensor, "3 channels pixels"]:
    """Signed whole diffuse root of the basis lights, by reweighted least squares.

    Values above the model are highlights and count less than values below it, which are noise or cast shadows.

    Args:
        images: for lights of unit intensity.
        sigma: standard deviation of every value.
        alpha: every light as a mix of the basis lights.
        n_d: diffuse exponent.
        iterations: of the reweighting.
    """
    root = signed_root(images, n_d).to(alpha.dtype)
    weight = torch.ones_like(root)
    b: Tensor | None = None
    for _ in range(iterations):
        found = solve_weighted(root, weight, alpha)
        b = found if b is None else 0.5 * (b + found)
        x = mixed(alpha, b)
        # In units of noise; the root's derivative is near 1 wherever n_d is.
        size = (root - x.clamp_min(0.0)) / sigma
        trust = torch.where(size > 0, 1.5 / size.clamp_min(1.5), 4.0 / (-size).clamp_min(4.0))
        # A light behind the horizon has nothing to say unless the picture is lit.
        weight = (trust * ((x > 0) | (root > 3.0 * sigma))).clamp_min(1e-6)
    assert b is not None
    return b


def solve_weighted(root: Tensor, weight: Tensor, alpha: Float[Tensor, "lights 3"]) -> Tensor:
    """argmin_b sum_j weight_j (root_j - A_j b)^2, with a trace of a ridge."""
    system = root.new_zeros(3, 3, *root.shape[1:])
    for k in range(3):
        for i in range(k + 1):
            system[k, i] = torch.tensordot(alpha[:, k] * alpha[:, i], weight, 1)
    ridge = 1e-6 * system.diagonal(dim1=0, dim2=1).amax(-1).clamp_min(1e-12)
    right = torch.tensordot(alpha.mT, weight * root, 1)
    shape = right.shape
    factor = factorise(system.flatten(2), ridge.flatten().expand(3, -1))
    return solve(factor, right.flatten(1)).view(shape)
