"""Small symmetric systems as maps, solved entry by entry: no matrix is ever stored, so that a compiler fuses it all.

V = L D L^T, L unit lower triangular;      V x = b   by  L y = b,  z = D^-1 y,  L^T x = z
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


def packed_at(size: int, i: int, j: int) -> int:
    """Where entry (i, j), i <= j, stands among the maps of the upper triangle, row by row."""
    return i * size - i * (i - 1) // 2 + j - i


def places(size: int) -> tuple[tuple[int, ...], ...]:
    """The same for all entries of both triangles."""
    return tuple(tuple(packed_at(size, min(i, j), max(i, j)) for j in range(size)) for i in range(size))


PACKED = places(4)


@dataclass(frozen=True)
class Factor:
    """L, below its diagonal and row by row, and D^-1."""

    L: tuple[tuple[Tensor, ...], ...]
    inverse: tuple[Tensor, ...]


def scales(V: Sequence[Tensor]) -> list[Tensor]:
    """The diagonal as damping sees it: a parameter that nothing feels must not make the system singular."""
    diagonal = [V[PACKED[k][k]] for k in range(4)]
    least = 1e-9 * (diagonal[0] + diagonal[1] + diagonal[2] + diagonal[3]) + 1e-30
    return [torch.maximum(v, least) for v in diagonal]


def factorise(V: Sequence[Tensor], damping: Sequence[Tensor]) -> Factor:
    """L D L^T of V + diag(damping); the maps of the upper triangle, and of the diagonal."""
    size = len(damping)
    # Columns below the diagonal; what the pivots before have left of them.
    left = [[V[packed_at(size, k, i)] for k in range(i + 1)] for i in range(size)]
    for i in range(size):
        left[i][i] = left[i][i] + damping[i]
    whole = [row[-1] for row in left]
    # Rounding may eat a pivot, never turn its sign.
    eps = 4.0 * torch.finfo(V[0].dtype).eps
    L: list[list[Tensor]] = [[] for _ in range(size)]
    inverse = []
    for k in range(size):
        pivot = left[k][k] if k == 0 else torch.maximum(left[k][k], eps * whole[k])
        inverse.append(1.0 / pivot)
        for i in range(k + 1, size):
            L[i].append(left[i][k] * inverse[k])
            for j in range(k + 1, i + 1):
                left[i][j] = left[i][j] - L[i][k] * left[j][k]
    return Factor(tuple(map(tuple, L)), tuple(inverse))


def solve(factor: Factor, b: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """X of V x = b; a map an unknown."""
    L, size = factor.L, len(b)
    y = list(b)
    for i in range(size):
        for k in range(i):
            y[i] = y[i] - L[i][k] * y[k]
    x = list(y)
    for i in reversed(range(size)):
        x[i] = y[i] * factor.inverse[i]
        for k in range(i + 1, size):
            x[i] = x[i] - L[k][i] * x[k]
    return tuple(x)
