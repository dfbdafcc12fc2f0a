"""Levenberg-Marquardt on many independent blocks at once, the shared parameters held fixed.

    (V + mu diag V) dl = -gl,    V = J^T w J,    gl = J^T w r          one small system a block

Every block has its own damping mu, its own acceptance and its own end; nothing is summed over the batch, so that a
block's result depends neither on its neighbours nor on how the batch was cut. Converged blocks leave the batch.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.solve.problem import BlockProblem, robust_cost, robust_weight


@dataclass(frozen=True, kw_only=True)
class Termination:
    """When a block is finished."""

    tolerance: float = 1e-8
    """Stop where the predicted relative decrease of the cost is below this; it works in single precision too."""
    floor: float = 1e-12
    """Costs below this count as zero."""
    max_iterations: int = 60


@dataclass(frozen=True, kw_only=True)
class LocalSolution:
    """Where every block ended."""

    local: Float[Tensor, "blocks P"]
    cost: Float[Tensor, "blocks"]
    converged: Bool[Tensor, "blocks"]
    iterations: int


def solve_damped(V: Tensor, gradient: Tensor, mu: Tensor) -> Tensor:
    """-(V + mu diag V)^-1 gradient, block by block; (..., P, P), (..., P), (...)."""
    diagonal = V.diagonal(dim1=-2, dim2=-1)
    # A parameter that no residual feels must not make the system singular, in whatever unit it is.
    scale = diagonal.clamp_min(1e-12 * diagonal.amax(-1, keepdim=True)).clamp_min(torch.finfo(V.dtype).tiny * 1e6)
    unit = scale.rsqrt()
    system = V * unit[..., :, None] * unit[..., None, :]
    system = system + torch.diag_embed(mu[..., None].expand_as(diagonal))
    factor, info = torch.linalg.cholesky_ex(system)
    step = torch.cholesky_solve(-(gradient * unit)[..., None], factor)[..., 0] * unit
    return torch.where((info == 0)[..., None] & step.isfinite(), step, torch.zeros_like(step))


def normal_equations(r: Tensor, J: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """J^T w J and J^T w r."""
    weighted = J * weight[..., None]
    return weighted.mT @ J, (weighted.mT @ r[..., None])[..., 0]


@dataclass(frozen=True)
class Linearised:
    """Cost, gradient and Gauss-Newton matrix of every block at some place."""

    cost: Float[Tensor, "blocks"]
    gradient: Float[Tensor, "blocks P"]
    V: Float[Tensor, "blocks P P"]

    @classmethod
    def at(cls, problem: BlockProblem, local: Tensor, shared: Tensor) -> Linearised:
        """At `local`; a cost that is no number counts as infinite."""
        r, J = problem.linearise_local(local, shared)
        V, gradient = normal_equations(r, J, robust_weight(r, problem.threshold))
        return cls(robust_cost(r, problem.threshold).nan_to_num(nan=torch.inf), gradient, V)

    def take(self, index: Tensor) -> Linearised:
        """Some of the blocks."""
        return Linearised(self.cost[index], self.gradient[index], self.V[index])

    def where(self, chosen: Bool[Tensor, "blocks"], other: Linearised) -> Linearised:
        """This where `chosen`, else the other."""
        return Linearised(
            torch.where(chosen, self.cost, other.cost),
            torch.where(chosen[:, None], self.gradient, other.gradient),
            torch.where(chosen[:, None, None], self.V, other.V),
        )


def solve_local(
    problem: BlockProblem,
    local: Float[Tensor, "blocks P"],
    shared: Float[Tensor, "G"],
    termination: Termination = Termination(),
    *,
    damping: float = 1e-3,
) -> LocalSolution:
    """Minimise every block's cost over its own unknowns from `local`.

    A block ends converged when its predicted relative decrease falls below the tolerance, or when damping has grown
    so far that no step can decrease its cost.
    """
    local = local.clone()
    # Cost, gradient and matrix at the present place are kept: every iteration evaluates once, at the trial place.
    here = Linearised.at(problem, local, shared)
    cost, converged = here.cost.clone(), torch.zeros_like(here.cost, dtype=torch.bool)
    mu = torch.full_like(cost, damping)
    active = torch.arange(len(local), device=local.device)
    part = problem
    iteration = 0
    for iteration in range(1, termination.max_iterations + 1):  # noqa: B007  (reported at the end)
        place, cost_here = local[active], here.cost
        step = solve_damped(here.V, here.gradient, mu)
        predicted = -(here.gradient * step).sum(-1) - 0.5 * (step * (here.V @ step[..., None])[..., 0]).sum(-1)
        trial = place + step
        there = Linearised.at(part, trial, shared)
        better = there.cost < cost_here
        mu = torch.where(better, mu * 0.2, mu * 5.0)
        done = (predicted <= termination.tolerance * cost_here + termination.floor) | (mu > 1e9)
        mu = mu.clamp_min(1e-9)
        local[active] = torch.where(better[:, None], trial, place)
        here = there.where(better, here)
        cost[active] = here.cost
        converged[active[done]] = True
        if done.any():
            left = (~done).nonzero()[:, 0]
            active, mu, here = active[left], mu[left], here.take(left)
            if len(active) == 0:
                break
            part = problem.take(active)
    return LocalSolution(local=local, cost=cost, converged=converged, iterations=iteration)
