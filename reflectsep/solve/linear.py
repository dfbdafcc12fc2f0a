"""Small symmetric systems of many pixels, solved entry by entry with the pixels last in memory.

V = L D L^T, L unit lower triangular;      V x = b   by  L y = b,  z = D^-1 y,  L^T x = z
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Factor:
    """L D L^T of every pixel's matrix."""

    L: Float[Tensor, "P P pixels"]
    """Below the diagonal; what stands on and above it means nothing."""
    inverse: Float[Tensor, "P pixels"]
    """1 / D."""


def factorise(V: Float[Tensor, "P P pixels"], damping: Float[Tensor, "P pixels"] | None = None) -> Factor:
    """L D L^T of V + diag(damping); only the lower triangle of V is read."""
    size = len(V)
    left = V.clone()
    if damping is not None:
        left.diagonal(dim1=0, dim2=1).add_(damping.mT)
    # Rounding may eat a pivot, never turn its sign.
    least = 4.0 * torch.finfo(V.dtype).eps * left.diagonal(dim1=0, dim2=1).mT.abs() + torch.finfo(V.dtype).tiny
    inverse = torch.empty_like(V[0])
    for k in range(size):
        inverse[k] = 1.0 / torch.maximum(left[k, k], least[k])
        if k + 1 < size:
            column = left[k + 1 :, k].clone()
            left[k + 1 :, k] *= inverse[k]
            for i in range(k + 1, size):
                left[i, k + 1 : i + 1] -= left[i, k] * column[: i - k]
    return Factor(left, inverse)


def solve(factor: Factor, b: Float[Tensor, "P *right pixels"]) -> Float[Tensor, "P *right pixels"]:
    """X of V x = b, for one or more right sides."""
    L, x = factor.L, b.clone()
    size = len(b)
    for k in range(size - 1):
        x[k + 1 :] -= (L[k + 1 :, k] * x[k]) if b.ndim == 2 else L[k + 1 :, k][:, None] * x[k]
    x *= factor.inverse if b.ndim == 2 else factor.inverse[:, None]
    for k in range(size - 1, 0, -1):
        x[:k] -= (L[k, :k] * x[k]) if b.ndim == 2 else L[k, :k][:, None] * x[k]
    return x


def log_determinant(factor: Factor) -> Float[Tensor, "pixels"]:
    """Log of the determinant of every pixel's matrix."""
    return -factor.inverse.log().sum(0)
