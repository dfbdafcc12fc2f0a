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
    cost = problem.costs(local, shared)
    converged = torch.zeros_like(cost, dtype=torch.bool)
    mu = torch.full_like(cost, damping)
    active = torch.arange(len(local), device=local.device)
    part = problem
    iteration = 0
    for iteration in range(1, termination.max_iterations + 1):  # noqa: B007  (reported at the end)
        here, mu_here, cost_here = local[active], mu[active], cost[active]
        r, J = part.linearise_local(here, shared)
        V, gradient = normal_equations(r, J, robust_weight(r, part.threshold))
        step = solve_damped(V, gradient, mu_here)
        predicted = -(gradient * step).sum(-1) - 0.5 * (step * (V @ step[..., None])[..., 0]).sum(-1)
        trial = here + step
        trial_cost = robust_cost(part.residuals(trial, shared), part.threshold).nan_to_num(nan=torch.inf)
        better = trial_cost < cost_here
        local[active] = torch.where(better[:, None], trial, here)
        cost[active] = torch.where(better, trial_cost, cost_here)
        mu_here = torch.where(better, mu_here * 0.2, mu_here * 5.0)
        mu[active] = mu_here.clamp_min(1e-9)
        done = (predicted <= termination.tolerance * cost_here + termination.floor) | (mu_here > 1e9)
        converged[active[done]] = True
        if done.any():
            active = active[~done]
            if len(active) == 0:
                break
            part = problem.take(active)
    return LocalSolution(local=local, cost=cost, converged=converged, iterations=iteration)
