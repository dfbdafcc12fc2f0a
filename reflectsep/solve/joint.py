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

    def settled(at: Tensor, shared: Tensor, other: Tensor | None = None) -> Solution:
        def start(cut: slice) -> tuple[Problem, Tensor]:
            part, here = problem.take(cut), at[:, cut].contiguous()
            if other is None:
                return part, here
            # Where the linear model has a block, unless that is worse than where it was.
            there = other[:, cut].contiguous()
            better = part.normal(there, shared).cost < part.normal(here, shared).cost
            return part, torch.where(better, there, here)

        return solve_in_chunks(len(problem), chunk, shared, inner, start)

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
        S, right, X = reduced(problem, now.local, shared, chunk, voters)
        S, right = S[index][:, index], right[index]
        moved = None
        for _ in range(TRIALS if len(index) else 0):
            system = S + torch.diag(damping * S.diagonal().clamp_min(1e-12) + 1e-9 * S.diagonal().amax())
            step = torch.linalg.solve_ex(system, right)[0].nan_to_num(0.0).clamp(-0.5, 0.5)
            trial = shared.clone()
            trial[index] += step
            trial = problem.bounded(trial)
            found = settled(now.local, trial, now.local + following(X, trial - shared))
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


def following(X: Float[Tensor, "blocks P G1"], dg: Float[Tensor, "G"]) -> Float[Tensor, "P blocks"]:
    """Step of the blocks dl = -V^-1 (gl + W dg), with X = V^-1 [W gl]; none where that means nothing."""
    step = -(X[..., :-1] @ dg + X[..., -1])
    return torch.where(step.isfinite().all(1, keepdim=True), step, 0.0).mT


def reduced(
    problem: JointProblem, local: Tensor, shared: Tensor, chunk: int, voters: Tensor
) -> tuple[Float[Tensor, "G G"], Float[Tensor, "G"], Float[Tensor, "blocks P G1"]]:
    """S, -(gg - W^T V^-1 gl) over the blocks `voters`, the shared parameters' own prior included; and V^-1 [W gl]."""
    votes = torch.zeros(len(problem), dtype=local.dtype)
    votes[voters] = 1.0

    def part(cut: slice) -> tuple[Tensor, Tensor, Tensor]:
        V, gl, W, H, gg = problem.take(cut).coupled(local[:, cut].contiguous(), shared)
        factor = factorise(V, 1e-12 * V.diagonal(dim1=0, dim2=1).mT.amax(0) * torch.ones_like(gl))
        X = solve(factor, torch.cat([W, gl[:, None]], 1))
        # A block without finite numbers has no say; nought times such a number would be none either.
        say = votes[cut] > 0
        say &= X.isfinite().all(0).all(0) & H.isfinite().all(0).all(0) & gg.isfinite().all(0)
        S = H[..., say].sum(-1) - torch.einsum("pgn,phn->gh", W[..., say], X[:, :-1, say])
        right = -(gg[:, say].sum(-1) - torch.einsum("pgn,pn->g", W[..., say], X[:, -1, say]))
        return S[None], right[None], X.movedim(-1, 0)

    S, right, X = by_chunks(len(problem), chunk, part)
    # Forward mode may answer in double precision where single came in.
    J = torch.func.jacfwd(problem.shared_rows)(shared).to(shared.dtype)
    return S.sum(0) + J.mT @ J, right.sum(0) - J.mT @ problem.shared_rows(shared), X
