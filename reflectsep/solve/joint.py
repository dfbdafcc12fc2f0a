"""Levenberg-Marquardt on all blocks and what they share, by the Schur complement.

    [ V  W ; W^T H ] [dl ; dg] = -[gl ; gg]          V block diagonal, one block a pixel
    S dg = -(gg - W^T V^-1 gl),   S = H - W^T V^-1 W,   dl = -V^-1 (gl + W dg)

Every trial of the shared parameters is followed by a few iterations of the blocks on their own (variable projection,
Golub & Pereyra 1973), each with its own damping: one damping for everything is a poor solver.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.solve.levenberg import Problem, Solution, Status, Termination, solve_in_chunks
from reflectsep.solve.linear import factorise, solve
from reflectsep.solve.sharing import by_chunks

TRIALS = 5
"""Dampings of the shared parameters that are tried in one iteration."""


class JointProblem(Problem, Protocol):
    """A problem that can tell how its blocks hang on what they share."""

    def take(self, index: Tensor | slice) -> Self:
        """Some of the blocks."""
        ...

    def coupled(
        self, local: Float[Tensor, "P blocks"], shared: Float[Tensor, "G"]
    ) -> tuple[Float[Tensor, "P P blocks"], Float[Tensor, "P blocks"], Tensor, Tensor, Tensor]:
        """V, gl, W (P, G, blocks), and of every block its part of H (G, G, blocks) and gg (G, blocks)."""
        ...

    def shared_rows(self, shared: Float[Tensor, "G"]) -> Float[Tensor, "rows"]:
        """What is expected of the shared parameters themselves, as residuals."""
        ...

    def bounded(self, shared: Float[Tensor, "G"]) -> Float[Tensor, "G"]:
        """The nearest shared parameters that mean something."""
        ...


@dataclass(frozen=True, kw_only=True)
class JointSolution:
    """Where a joint solve ended."""

    local: Float[Tensor, "P blocks"]
    shared: Float[Tensor, "G"]
    cost: Float[Tensor, "blocks"]
    iterations: int
    status: Status
    history: tuple[float, ...]


def solve_joint(  # noqa: PLR0913  (a problem, where it starts, and when it ends)
    problem: JointProblem,
    local: Float[Tensor, "P blocks"],
    shared: Float[Tensor, "G"],
    free: Bool[Tensor, "G"],
    *,
    end: Termination,
    inner: Termination,
    chunk: int,
    trim: float = 1.0,
    watch: Callable[[int], None] = lambda _: None,
) -> JointSolution:
    """Minimum over all blocks and the `free` shared parameters.

    `trim` is the share of the blocks, those of least cost, that has a say in the shared parameters.
    """
    if len(problem) == 0:
        raise ValueError("a joint solve of no blocks")

    def settled(at: Tensor, shared: Tensor) -> Solution:
        return solve_in_chunks(len(problem), chunk, shared, inner, lambda cut: (problem.take(cut), at[:, cut]))

    now = settled(local, shared)
    damping, status = 1e-3, Status.EXHAUSTED
    history: list[float] = []
    index = free.nonzero()[:, 0]
    iteration = 0
    for iteration in range(1, end.max_iterations + 1):
        voters = now.cost.argsort()[: max(1, int(trim * len(problem)))].sort().values
        voters = voters[now.cost[voters].isfinite()]
        if len(voters) == 0:
            status = Status.FAILED
            break
        total = lambda s, g, v=voters: float(s.cost[v].sum() + 0.5 * problem.shared_rows(g).square().sum())  # noqa: E731
        before = total(now, shared)
        history.append(before)
        S, right = reduced(problem, now.local, shared, chunk, voters)
        S, right = S[index][:, index], right[index]
        moved = None
        for _ in range(TRIALS if len(index) else 0):
            system = S + torch.diag(damping * S.diagonal().clamp_min(1e-12) + 1e-9 * S.diagonal().amax())
            step = torch.linalg.lstsq(system, right[:, None]).solution[:, 0].clamp(-0.5, 0.5)
            trial = shared.clone()
            trial[index] += step
            trial = problem.bounded(trial)
            found = settled(now.local, trial)
            if total(found, trial) < before:
                moved = found, trial
                break
            damping = max(10.0 * damping, 1e-2)
        watch(iteration)
        if moved is None:
            status = Status.CONVERGED
            break
        change = float((moved[1] - shared).abs().max())
        fall = before - total(*moved)
        now, shared, damping = *moved, 0.1 * damping
        if fall <= end.tolerance * before or change < 1e-4:
            status = Status.CONVERGED
            break
    return JointSolution(
        local=now.local, shared=shared, cost=now.cost, iterations=iteration, status=status, history=tuple(history)
    )


def reduced(
    problem: JointProblem, local: Tensor, shared: Tensor, chunk: int, voters: Tensor
) -> tuple[Float[Tensor, "G G"], Float[Tensor, "G"]]:
    """S and -(gg - W^T V^-1 gl) over the blocks `voters`, the shared parameters' own prior included."""

    def part(cut: slice) -> tuple[Tensor, Tensor]:
        which = voters[cut]
        V, gl, W, H, gg = problem.take(which).coupled(local[:, which], shared)
        factor = factorise(V, 1e-12 * V.diagonal(dim1=0, dim2=1).mT.amax(0) * torch.ones_like(gl))
        X = solve(factor, torch.cat([W, gl[:, None]], 1))
        S = H.sum(-1) - torch.einsum("pgn,phn->gh", W, X[:, :-1])
        return S[None], (-(gg.sum(-1) - torch.einsum("pgn,pn->g", W, X[:, -1])))[None]

    S, right = by_chunks(len(voters), chunk, part)
    # Forward mode may answer in double precision where single came in.
    J = torch.func.jacfwd(problem.shared_rows)(shared).to(shared.dtype)
    return S.sum(0) + J.mT @ J, right.sum(0) - J.mT @ problem.shared_rows(shared)
