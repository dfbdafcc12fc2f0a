"""The observations and priors of `fit/problem.py` as the solver's problem of blocks, one block a pixel."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from reflectsep.fit.coupling import coupled_equations
from reflectsep.fit.derivatives import jacobians
from reflectsep.fit.fused import solve_fused
from reflectsep.fit.normal import normal_equations
from reflectsep.fit.problem import Observations, Priors, pixel_residual, shared_residual
from reflectsep.solve.local import LocalSolution, Termination
from reflectsep.solve.problem import BlockProblem, Coupled


def build_problem(obs: Observations, priors: Priors, *, robust: float | None) -> BlockProblem:
    """The whole problem; `robust` is the Huber threshold of the pictures' residuals in standard deviations."""

    def residual(local: Tensor, shared: Tensor, *data: Tensor) -> Tensor:
        return pixel_residual(local, shared, *regroup(data, obs, priors))

    def closed_form(
        local: Tensor, shared: Tensor, *data: Tensor, with_shared: bool
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        return jacobians(local, shared, *regroup(data, obs, priors), with_shared=with_shared)

    def normal(local: Tensor, shared: Tensor, *data: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return normal_equations(local, shared, *regroup(data, obs, priors), robust)

    def coupled(local: Tensor, shared: Tensor, *data: Tensor) -> Coupled:
        return coupled_equations(local, shared, *regroup(data, obs, priors), robust)

    def held(local: Tensor, shared: Tensor, termination: Termination, *data: Tensor) -> LocalSolution:
        assert obs.fused is not None  # else it is not offered
        return solve_fused(local, shared, *regroup(data, obs, priors), robust, termination, obs.fused)

    prior_rows = 1 + 3 * obs.channels * (2 if obs.s_unknown else 1) + 1 + 3 + 3
    threshold = None
    if robust is not None:
        picture = obs.images.new_full((obs.images[0].numel(),), robust)
        threshold = torch.cat([picture, picture.new_full((prior_rows,), torch.inf)])
    return BlockProblem(
        residual=residual,
        jacobian=closed_form,
        normal=normal,
        coupled=coupled,
        data=(
            obs.images,
            obs.s,
            obs.weight,
            obs.clipped,
            priors.parallel,
            priors.ratio,
            priors.ratio_weight,
            priors.lobe,
            priors.lobe_weight,
            priors.facing,
            priors.facing_weight,
            priors.s_weight,
        ),
        threshold=threshold,
        held=None if obs.fused is None else held,
        device=obs.device,
        shared_residual=lambda shared: shared_residual(shared, obs.cosine, priors),
    )


def regroup(data: tuple[Tensor, ...], obs: Observations, priors: Priors) -> tuple[Observations, Priors]:
    """The solver's per-block tensors, back in their named places."""
    images, s, weight, clipped, parallel, ratio, ratio_weight, lobe, lobe_weight, facing, facing_weight, s_weight = data
    return (
        replace(
            obs,
            images=images,
            s=s,
            weight=weight,
            clipped=clipped,
            alpha=obs.alpha.to(images.device),
            normal_map=obs.normal_map.to(images.device),
            view=obs.view.to(images.device),
        ),
        replace(
            priors,
            parallel=parallel,
            ratio=ratio,
            ratio_weight=ratio_weight,
            lobe=lobe,
            lobe_weight=lobe_weight,
            facing=facing,
            facing_weight=facing_weight,
            s_weight=s_weight,
        ),
    )
