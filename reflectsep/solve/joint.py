"""Gauss-Newton on blocks and shared parameters together, by the Schur complement.

    [ V    W ] [dl]     [gl]
    [ W^T  H ] [dg] = - [gg],       V block diagonal (one block a pixel), W (P, G) a block, H (G, G)

    S dg = -(gg - W^T V^-1 gl),     S = H - W^T V^-1 W,     dl = -V^-1 (gl + W dg)

Only S and the reduced gradient are summed over blocks, a handful of numbers a chunk, so memory is bounded by the
chunk and chunks may live anywhere. One damping for everything is a poor solver: blocks are damped each on its own by
a few local iterations after every shared step (variable projection), the shared parameters by theirs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.solve.local import LocalSolution, Termination, scale_of, solve_local, solve_positive
from reflectsep.solve.problem import BlockProblem
from reflectsep.solve.sharing import by_chunks, workers

MOST_DAMPING = 1e8
"""Where no step is short enough to lower the cost, there is none."""


COMPANY = 16
"""The last blocks of so many chunks are few, and few take as long as many."""


@dataclass(frozen=True, kw_only=True)
class JointOptions:
    """How the shared parameters are stepped and when they are done."""

    max_iterations: int = 40
    tolerance: float = 1e-7
    """Stop where the undamped shared step promises a relative decrease of the whole cost below this."""
    inner: Termination = field(default_factory=Termination)
    """Local iterations after every shared step. To the end: on blocks that are on their way the shared steps creep
    (20 steps and 20 s where 6 steps and 6 s do), and few blocks need more than two or three."""
    chunk: int = 1 << 12
    damping: float = 1e-4


@dataclass(frozen=True, kw_only=True)
class JointSolution:
    """Where blocks and shared parameters ended."""

    local: Float[Tensor, "blocks P"]
    shared: Float[Tensor, "G"]
    cost: float
    information: Float[Tensor, "G G"]
    """S: inverse covariance of the shared parameters, the blocks marginalised."""
    iterations: int
    converged: bool
    settled: Bool[Tensor, "blocks"]
    """Of every block: its own iterations have come to their end at the final shared parameters."""
    history: tuple[float, ...]


@dataclass(frozen=True)
class ReducedSystem:
    """The shared parameters' own normal equations after the blocks are eliminated; systems of chunks add."""

    S: Tensor
    gradient: Tensor


def reduced_system(problem: BlockProblem, local: Tensor, shared: Tensor, chunk: int) -> ReducedSystem:
    """S and the reduced gradient at (local, shared), chunk by chunk."""

    def reduced(cut: slice) -> tuple[Tensor, Tensor]:
        part, here, there = problem.chunk(cut, local[cut], shared)
        at = part.coupled_equations(here, there)
        solved = solve_firm(at.V, torch.cat([at.W.transpose(0, 1), at.gradient[None]]))
        taken = torch.einsum("pgn,hpn->gh", at.W, solved)
        S, gradient = at.H - taken[:, :-1], at.shared_gradient - taken[:, -1]
        return S[None].to(local.device), gradient[None].to(local.device)

    S, gradient = (parts.sum(0) for parts in by_chunks(len(local), chunk, reduced))
    if problem.shared_residual is not None:
        q = problem.shared_residual(shared)
        # In single precision, zeros come back from torch in double.
        Q = torch.func.jacrev(problem.shared_residual)(shared).to(q.dtype)
        S, gradient = S + Q.mT @ Q, gradient + Q.mT @ q
    return ReducedSystem(S, gradient)


def shared_step(system: ReducedSystem, mu: float, free: Tensor | None) -> Tensor:
    """-(S + mu diag S)^-1 gradient over the free parameters, 0 for the others."""
    G = len(system.gradient)
    index = torch.arange(G) if free is None else free.nonzero()[:, 0]
    S, gradient = system.S[index][:, index], system.gradient[index]
    # In units of each parameter's own curvature; rounding must not make the system singular in single precision.
    unit = S.diagonal().clamp_min(1e-30).rsqrt()
    least = 10.0 * G * torch.finfo(S.dtype).eps
    scaled = S * unit[:, None] * unit + max(mu, least) * torch.eye(len(index), dtype=S.dtype, device=S.device)
    step = torch.zeros_like(system.gradient)
    step[index] = -unit * torch.linalg.solve(scaled, unit * gradient)
    return step


def promised(system: ReducedSystem, free: Tensor | None) -> float:
    """By how much the undamped shared step would lower the cost, were it quadratic: 1/2 gradient S^-1 gradient."""
    step = shared_step(system, 0.0, free)
    return float(-(system.gradient @ step) - 0.5 * step @ system.S @ step)


def solve_firm(V: Float[Tensor, "P P blocks"], right: Float[Tensor, "sides P blocks"]) -> Tensor:
    """V^-1 right of every block; directions that no residual feels get no say instead of an infinite one."""
    scale = scale_of(V)
    least = max(1e-9, 20.0 * torch.finfo(V.dtype).eps)
    return solve_positive(V, torch.maximum(V.diagonal().T, scale) + least * scale, right)


def inverse(V: Float[Tensor, "blocks P P"]) -> Float[Tensor, "blocks P P"]:
    """V^-1 of every block; directions that no residual feels get no say instead of an infinite one."""
    diagonal = V.diagonal(dim1=-2, dim2=-1)
    unit = diagonal.clamp_min(1e-12 * diagonal.amax(-1, keepdim=True)).clamp_min(1e-30).rsqrt()
    system = V * unit[..., :, None] * unit[..., None, :]
    least = max(1e-9, 20.0 * torch.finfo(V.dtype).eps)
    system = system + least * torch.eye(V.shape[-1], dtype=V.dtype, device=V.device)
    factor, info = torch.linalg.cholesky_ex(system)
    result = torch.cholesky_inverse(factor) * unit[..., :, None] * unit[..., None, :]
    sound = (info == 0)[..., None, None] & result.isfinite().all(-1, keepdim=True).all(-2, keepdim=True)
    return torch.where(sound, result, torch.zeros_like(result))


def follow(problem: BlockProblem, local: Tensor, shared: Tensor, step: Tensor, chunk: int) -> Tensor:
    """Blocks moved along with the shared step, dl = -V^-1 (gl + W dg), each only where that lowers its cost.

    Along a flat valley (here: a against B) blocks that wait for their own iterations would make every shared step
    look bad.
    """

    def moved(cut: slice) -> tuple[Tensor]:
        part, here, before, by = problem.chunk(cut, local[cut], shared, step)
        at = part.coupled_equations(here, before)
        pull = at.gradient + torch.einsum("pgn,g->pn", at.W, by)
        there = here - solve_firm(at.V, pull[None])[0].T
        better = part.costs(there, before + by) < part.costs(here, before + by)
        return (torch.where(better[:, None], there, here).to(local.device),)

    return by_chunks(len(local), chunk, moved)[0]


def costs_in_chunks(problem: BlockProblem, local: Tensor, shared: Tensor, chunk: int) -> Float[Tensor, "blocks"]:
    """Cost of every block, chunk by chunk."""

    def costs(cut: slice) -> tuple[Tensor]:
        part, here, there = problem.chunk(cut, local[cut], shared)
        return (part.costs(here, there).to(local.device),)

    return by_chunks(len(local), chunk, costs)[0]


def local_in_chunks(
    problem: BlockProblem,
    local: Tensor,
    shared: Tensor,
    termination: Termination,
    chunk: int,
    which: Tensor | None = None,
) -> LocalSolution:
    """`solve_local` with `chunk` blocks under way of `COMPANY` times as many, and so on to the last.

    Of the blocks `which` alone, whose places `local` are, where it is given.
    """

    def solved(cut: slice) -> tuple[Tensor, ...]:
        blocks, here, there = problem.chunk(cut if which is None else which[cut], local[cut], shared)
        part = solve_local(blocks, here, there, termination, at_once=chunk)
        found = (each.to(local.device) for each in (part.local, part.cost, part.converged))
        return *found, torch.tensor([part.iterations])

    # Where a block ends depends on no other, so that these cuts may go by who is there to work on them.
    crew = workers().count
    share = -(-len(local) // (2 * crew)) if crew > 1 else len(local)
    places, cost, converged, iterations = by_chunks(len(local), max(chunk, min(COMPANY * chunk, share)), solved)
    return LocalSolution(local=places, cost=cost, converged=converged, iterations=int(iterations.max()))


def solve_joint(
    problem: BlockProblem,
    local: Float[Tensor, "blocks P"],
    shared: Float[Tensor, "G"],
    options: JointOptions = JointOptions(),
    *,
    free: Bool[Tensor, "G"] | None = None,
    watch: Callable[[int, float], None] | None = None,
) -> JointSolution:
    """Minimise the whole cost over blocks and shared parameters from (local, shared).

    Shared parameters where `free` is false stay as they are; `watch(iteration, cost)` is called after every step.
    """
    # Not the blocks first: under shared parameters that are off, their ends are further off, and in wrong minima.
    cost = float(costs_in_chunks(problem, local, shared, options.chunk).sum() + problem.shared_cost(shared))
    history, mu, converged, iteration = [cost], options.damping, False, 0
    settled = torch.zeros(len(local), dtype=torch.bool, device=local.device)
    system = reduced_system(problem, local, shared, options.chunk)
    while not converged and iteration < options.max_iterations:
        iteration += 1
        better: tuple[Tensor, Tensor, float] | None = None
        while better is None and mu < MOST_DAMPING:
            step = shared_step(system, mu, free)
            moved = follow(problem, local, shared, step, options.chunk)
            trial = local_in_chunks(problem, moved, shared + step, options.inner, options.chunk)
            settled = trial.converged
            trial_cost = float(trial.cost.sum() + problem.shared_cost(shared + step))
            if trial_cost < cost:
                better = trial.local, shared + step, trial_cost
            else:
                mu *= 8.0
        if better is None:
            converged = True
            break
        local, shared, cost = better
        mu = max(mu * 0.2, 1e-9)
        history.append(cost)
        if watch is not None:
            watch(iteration, cost)
        system = reduced_system(problem, local, shared, options.chunk)
        converged = promised(system, free) <= options.tolerance * cost
    return JointSolution(
        local=local,
        shared=shared,
        cost=cost,
        information=system.S,
        iterations=iteration,
        converged=converged,
        settled=settled,
        history=tuple(history),
    )
