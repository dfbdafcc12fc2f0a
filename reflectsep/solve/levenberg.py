"""Levenberg-Marquardt for many small least-squares problems at once: every pixel has its own damping and its own end.

    (V + lambda diag V) step = -g,      gain = (cost before - after) / (decrease that V and g foretell)

A problem is anything that gives V, g and the cost of every block (here: a pixel) at given unknowns; it knows nothing of
the solver. Blocks that have ended are taken out of the work of those that have not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from reflectsep.solve.linear import factorise, solve
from reflectsep.solve.sharing import by_chunks

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-9, 1e8
ACCEPTED_GAIN = 1e-4
FIRMNESS = 1e-9
"""Share of the largest diagonal entry that damping treats every unknown as having: nothing may make V singular."""


class Status(IntEnum):
    """How a block's iterations ended."""

    CONVERGED = 0
    """The cost no longer falls by more than the tolerance."""
    EXHAUSTED = 1
    """The limit of iterations came first."""
    FAILED = 2
    """No finite cost, or no step that lowers it although the slope says that there is one."""


@dataclass(frozen=True, kw_only=True)
class Termination:
    """When to stop."""

    tolerance: float = 1e-7
    """Relative decrease of a block's cost that counts as none."""
    max_iterations: int = 30


@dataclass(frozen=True)
class Normal:
    """Gauss-Newton's view of every block at its present unknowns."""

    cost: Float[Tensor, "blocks"]
    g: Float[Tensor, "P blocks"]
    V: Float[Tensor, "P P blocks"]
    """Only the lower triangle counts."""

    def take(self, index: Tensor) -> Normal:
        """Some of the blocks."""
        return Normal(self.cost[index], self.g[:, index], self.V[:, :, index])

    def where(self, chosen: Tensor, other: Normal) -> Normal:
        """The blocks `chosen` of this, the rest of `other`."""
        return Normal(
            torch.where(chosen, self.cost, other.cost),
            torch.where(chosen, self.g, other.g),
            torch.where(chosen, self.V, other.V),
        )


class Problem(Protocol):
    """Blocks of a least-squares problem that share `shared` and nothing else."""

    def __len__(self) -> int:
        """Number of blocks."""
        ...

    def take(self, index: Tensor | slice) -> Self:
        """Some of the blocks."""
        ...

    def normal(self, local: Float[Tensor, "P blocks"], shared: Float[Tensor, "G"]) -> Normal:
        """Cost, gradient and Gauss-Newton matrix of every block."""
        ...


@dataclass(frozen=True)
class Solution:
    """Where the iterations ended."""

    local: Float[Tensor, "P blocks"]
    cost: Float[Tensor, "blocks"]
    status: Int[Tensor, "blocks"]


def solve_blocks(problem: Problem, local: Float[Tensor, "P blocks"], shared: Tensor, end: Termination) -> Solution:
    """Minimum of every block's cost from `local`, the shared parameters held."""
    x = local.clone()
    at = problem.normal(x, shared)
    cost = at.cost.clone()
    status = torch.full(cost.shape, int(Status.EXHAUSTED), dtype=torch.int8, device=x.device)
    cost[~at.g.isfinite().all(0)] = torch.inf
    status[~cost.isfinite()] = int(Status.FAILED)
    active = cost.isfinite().nonzero()[:, 0]
    if len(active) < len(cost):
        problem, at = problem.take(active), at.take(active)
    here, damping = x[:, active], torch.full_like(at.cost, FIRST_DAMPING)
    for _ in range(end.max_iterations):
        if len(active) == 0:
            break
        scale = at.V.diagonal(dim1=0, dim2=1).mT
        scale = torch.maximum(scale, FIRMNESS * scale.amax(0) + torch.finfo(scale.dtype).tiny)
        step = solve(factorise(at.V, damping * scale), -at.g)
        foretold = -0.5 * (step * (at.g - damping * scale * step)).sum(0)
        new = problem.normal(here + step, shared)
        gain = (at.cost - new.cost) / foretold
        # False for what is not a number; a cost may be finite where its slope is none.
        better = (gain > ACCEPTED_GAIN) & new.g.isfinite().all(0) & new.V.isfinite().flatten(0, 1).all(0)
        ended = better & (at.cost - new.cost <= end.tolerance * at.cost)
        # At rest: not even the linear model promises a decrease that counts.
        ended |= foretold <= 0.1 * end.tolerance * at.cost
        stuck = ~ended & (damping >= MOST_DAMPING) & ~better
        factor = torch.where(better, (1.0 - (2.0 * gain.clamp(0.0, 1.0) - 1.0) ** 3).clamp(0.1, 2.0), 6.0)
        damping = (damping * factor).clamp(LEAST_DAMPING, MOST_DAMPING)
        here = torch.where(better, here + step, here)
        at = new.where(better, at)
        done = ended | stuck
        if bool(done.any()):
            which = active[done]
            x[:, which], cost[which] = here[:, done], at.cost[done]
            status[which] = torch.where(ended[done], int(Status.CONVERGED), int(Status.FAILED)).to(torch.int8)
            left = (~done).nonzero()[:, 0]
            active, here, damping = active[left], here[:, left], damping[left]
            problem, at = problem.take(left), at.take(left)
    x[:, active], cost[active] = here, at.cost
    return Solution(x, cost, status)


def solve_in_chunks(
    count: int,
    chunk: int,
    shared: Tensor,
    end: Termination,
    start: Callable[[slice], tuple[Problem, Tensor]],
) -> Solution:
    """`solve_blocks` chunk by chunk, the chunks shared among the processes of a run.

    `start` gives the problem of a run of blocks and where its iterations begin.
    """

    def part(cut: slice) -> tuple[Tensor, Tensor, Tensor]:
        found = solve_blocks(*start(cut), shared, end)
        return found.local.mT, found.cost, found.status

    local, cost, status = by_chunks(count, chunk, part)
    return Solution(local.mT, cost, status)
