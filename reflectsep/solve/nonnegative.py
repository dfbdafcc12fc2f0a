"""Many small least-squares problems with bounds x >= 0, solved exactly.

    minimise x^T N x / 2 - r^T x,  x >= 0      <=>      y = N x - r,  x >= 0,  y >= 0,  x^T y = 0

Block principal pivoting (Portugal, Judice and Vicente 1994): a set of free unknowns is guessed, the others are 0, and
every unknown on the wrong side (x < 0 where free, y < 0 where not) changes sides at once; a problem where that stops
to help changes one a time, the last, which is sure to end. Most need three or four rounds; the finished leave the
batch. A problem's solution depends on no other.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

PATIENCE = 3
"""Rounds without fewer unknowns on the wrong side until they change sides one at a time."""
ROUNDS = 100
FEWER = 0.7


def nonnegative_least_squares(
    normal: Float[Tensor, "unknowns unknowns values"], right: Float[Tensor, "unknowns values"]
) -> Float[Tensor, "unknowns values"]:
    """Minimise x^T N x / 2 - r^T x over x >= 0, one small problem a value.

    Args:
        normal: N, symmetric and positive definite.
        right: r.

    Returns:
        x, to about the rounding of the numbers given.
    """
    # Unit diagonal and a largest right side of 1: the tolerance is then one for all.
    scale = torch.diagonal(normal).T.clamp(min=torch.finfo(normal.dtype).tiny).rsqrt()
    size = (right * scale).abs().amax(0).clamp(min=torch.finfo(normal.dtype).tiny)
    state = _Pivoting(normal * scale[:, None] * scale, right * scale / size)
    for _ in range(ROUNDS):
        if not state.round():
            break
    return state.solution.clamp(min=0.0) * scale * size


class _Pivoting:
    """The problems that are not solved yet, and the solutions so far."""

    def __init__(self, normal: Tensor, right: Tensor) -> None:
        unknowns, values = right.shape
        self.normal, self.right = normal, right
        self.tolerance = torch.finfo(right.dtype).eps ** 0.7
        self.free = torch.ones_like(right, dtype=torch.bool)
        self.fewest = torch.full((values,), unknowns + 1)
        self.patience = torch.full((values,), PATIENCE)
        self.place: Tensor | None = None
        self.solution = right

    def round(self) -> bool:
        """Solve with the present sets and change them; false when all is solved."""
        x = _solve(self.normal, self.right, self.free)
        y = (self.normal * x).sum(1).sub_(self.right)
        wrong = torch.where(self.free, x, y) < -self.tolerance
        if self.place is None:
            self.solution = x
        else:
            self.solution[:, self.place] = x
        count = wrong.sum(0)
        left = count.nonzero()[:, 0]
        if not len(left):
            return False
        # The finished may stay: they change no more. Copying the others pays where they are fewer.
        if len(left) < FEWER * len(count):
            self._keep(left)
            wrong, count = wrong[:, left], count[left]
        self._exchange(wrong, count)
        return True

    def _keep(self, left: Tensor) -> None:
        self.place = left if self.place is None else self.place[left]
        self.normal, self.right, self.free = self.normal[..., left], self.right[:, left], self.free[:, left]
        self.fewest, self.patience = self.fewest[left], self.patience[left]

    def _exchange(self, wrong: Bool[Tensor, "unknowns left"], count: Tensor) -> None:
        better = count < self.fewest
        self.fewest = torch.minimum(self.fewest, count)
        self.patience = torch.where(better, PATIENCE, self.patience - 1)
        index = torch.arange(len(wrong))[:, None]
        last = torch.where(wrong, index, -1).amax(0)
        self.free = self.free ^ torch.where(self.patience < 0, wrong & (index == last), wrong)


def _solve(normal: Tensor, right: Tensor, free: Tensor) -> Tensor:
    """X of N x = r over the free unknowns, 0 for the others: LDL^T, the pivots of the others left out."""
    unknowns = len(right)
    # Upper triangle and right side in one, row by row.
    rows = torch.cat([normal, right[:, None]], 1)
    inverse = torch.empty_like(right)
    least = torch.finfo(right.dtype).eps
    for k in range(unknowns):
        torch.div(free[k], rows[k, k].clamp(min=least), out=inverse[k])
        factor = rows[k, k + 1 : unknowns] * inverse[k]
        for i in range(k + 1, unknowns):
            rows[i, i:].addcmul_(rows[k, i:], factor[i - k - 1], value=-1)
    x = torch.empty_like(right)
    for k in reversed(range(unknowns)):
        torch.mul(rows[k, unknowns], inverse[k], out=x[k])
        if k:
            rows[:k, unknowns].addcmul_(rows[:k, k], x[k], value=-1)
    return x
