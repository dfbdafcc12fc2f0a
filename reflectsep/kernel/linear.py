"""Symmetric 4 x 4 systems as ten maps, solved by hand: no matrix is ever stored, so that a compiler fuses it all.

V = L D L^T, L unit lower triangular;      V x = b   by  L y = b,  z = D^-1 y,  L^T x = z
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

PACKED = ((0, 1, 2, 3), (1, 4, 5, 6), (2, 5, 7, 8), (3, 6, 8, 9))
"""Where entry (i, j) stands among the ten maps of the upper triangle, row by row."""
DIAGONAL = tuple(PACKED[i][i] for i in range(4))


@dataclass(frozen=True)
class Factor:
    """L, below its diagonal and row by row, and D^-1."""

    L: tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
    inverse: tuple[Tensor, Tensor, Tensor, Tensor]


def scales(V: Sequence[Tensor]) -> list[Tensor]:
    """The diagonal as damping sees it: a parameter that nothing feels must not make the system singular."""
    least = 1e-9 * (V[0] + V[4] + V[7] + V[9]) + 1e-30
    return [torch.maximum(V[k], least) for k in DIAGONAL]


def factorise(V: Sequence[Tensor], damping: Sequence[Tensor]) -> Factor:
    """L D L^T of V + diag(damping); ten maps of the upper triangle, and four."""
    s00, s01, s02, s03, s11, s12, s13, s22, s23, s33 = V
    s00, s11, s22, s33 = s00 + damping[0], s11 + damping[1], s22 + damping[2], s33 + damping[3]
    # Rounding may eat a pivot, never turn its sign.
    eps = 4.0 * torch.finfo(s00.dtype).eps
    i0 = 1.0 / s00
    l10, l20, l30 = s01 * i0, s02 * i0, s03 * i0
    i1 = 1.0 / torch.maximum(s11 - l10 * s01, eps * s11)
    c21, c31 = s12 - l20 * s01, s13 - l30 * s01
    l21, l31 = c21 * i1, c31 * i1
    i2 = 1.0 / torch.maximum(s22 - l20 * s02 - l21 * c21, eps * s22)
    c32 = s23 - l30 * s02 - l31 * c21
    l32 = c32 * i2
    i3 = 1.0 / torch.maximum(s33 - l30 * s03 - l31 * c31 - l32 * c32, eps * s33)
    return Factor((l10, l20, l21, l30, l31, l32), (i0, i1, i2, i3))


def solve(factor: Factor, b: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """X of V x = b; four maps."""
    l10, l20, l21, l30, l31, l32 = factor.L
    y0 = b[0]
    y1 = b[1] - l10 * y0
    y2 = b[2] - l20 * y0 - l21 * y1
    y3 = b[3] - l30 * y0 - l31 * y1 - l32 * y2
    i0, i1, i2, i3 = factor.inverse
    x3 = y3 * i3
    x2 = y2 * i2 - l32 * x3
    x1 = y1 * i1 - l21 * x2 - l31 * x3
    x0 = y0 * i0 - l10 * x1 - l20 * x2 - l30 * x3
    return x0, x1, x2, x3
