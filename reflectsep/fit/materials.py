"""Several materials in one object: which pixel is of which, and whether the pictures want another one.

Every pixel is solved under every material's height and exponent. Its costs, averaged over a few pixels around, choose:
materials cover areas, and a single pixel's few pictures cannot tell. A further material starts from one that is
glossier or rougher than the first, at a height that keeps its energy, wherever that lowers the cost; then globals and
areas are fitted in turn. It stays only where it lowers the whole cost by a share that no wrong model of one gloss
reaches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.fit.neighbours import gaussian_sum
from reflectsep.fit.problem import LOG_N_S, PixelProblem, log_size
from reflectsep.solve.joint import JointSolution
from reflectsep.solve.levenberg import Solution

RATIOS = (0.1, 0.3, 3.0, 10.0)
"""Exponents that a further material starts with, over that of the first."""
AREA_PX = 2.0
"""Standard deviation of the window over which costs are averaged."""
WORST = 50.0
"""Cost of a pixel beyond which it says no more about its material."""
GAIN = 0.2
"""Share of the whole cost that a further material must save."""
LEAST_AREA = 0.02
"""Share of the object that it must cover."""
MOST = 3
ROUNDS = 5

Solve = Callable[[PixelProblem, Tensor, Tensor], Solution]
"""(problem, start, shared) to a solution, the globals held."""
Joint = Callable[[PixelProblem, Tensor, Tensor, Tensor], JointSolution]
"""(problem, start, shared, free) to a solution."""


@dataclass(frozen=True, kw_only=True)
class Materials:
    """A fit with some number of materials."""

    problem: PixelProblem
    local: Float[Tensor, "P pixels"]
    cost: Float[Tensor, "pixels"]
    shared: Float[Tensor, "G"]
    free: Bool[Tensor, "G"]

    @property
    def whole(self) -> float:
        """Cost of all pixels, outliers bounded."""
        return float(self.cost.clamp_max(WORST).nan_to_num(nan=WORST).sum())


def averaged(cost: Float[Tensor, "pixels"], mask: Bool[Tensor, "height width"]) -> Float[Tensor, "pixels"]:
    """Mean of the costs around every pixel, over the object alone."""
    reach = int(3 * AREA_PX)
    bounded = cost.clamp_max(WORST).nan_to_num(nan=WORST)
    return gaussian_sum(bounded, mask, AREA_PX, reach) / gaussian_sum(torch.ones_like(cost), mask, AREA_PX, reach)


def assigned(
    problem: PixelProblem, local: Tensor, shared: Tensor, mask: Bool[Tensor, "height width"], solve: Solve
) -> tuple[Solution, PixelProblem]:
    """Every pixel solved under each material, and the problem that says which it is of."""
    if problem.obs.kinds == 1:
        return solve(problem, local, shared), problem
    best: Solution | None = None
    least, material = None, torch.zeros(len(problem), dtype=torch.long)
    for kind in range(problem.obs.kinds):
        every = torch.full((len(problem),), kind)
        found = solve(replace(problem, obs=replace(problem.obs, material=every)), local, shared)
        around = averaged(found.cost, mask)
        if best is None or least is None:
            best, least = found, around
            continue
        here = around < least
        least = torch.where(here, around, least)
        material[here] = kind
        best = Solution(
            torch.where(here, found.local, best.local),
            torch.where(here, found.cost, best.cost),
            torch.where(here, found.status, best.status),
        )
    assert best is not None
    return best, replace(problem, obs=replace(problem.obs, material=material))


def with_another(now: Materials, ratio: float) -> tuple[PixelProblem, Tensor, Tensor]:
    """Problem, globals and free globals with one more material, of `ratio` times the exponent of the first."""
    obs, shared = now.problem.obs, now.shared
    n_s = shared[LOG_N_S].exp()
    size = log_size(shared, replace(obs, material=None))
    scale = (n_s * size + torch.log(shared.new_tensor(ratio))) / (n_s * ratio) - size
    more = torch.stack([scale, shared[LOG_N_S] + torch.log(shared.new_tensor(ratio))])
    problem = replace(now.problem, obs=replace(obs, kinds=obs.kinds + 1))
    return problem, torch.cat([shared, more]), torch.cat([now.free, torch.ones(2, dtype=torch.bool)])


def split(
    now: Materials, mask: Bool[Tensor, "height width"], solve: Solve, joint: Joint, *, sure: bool = False
) -> Materials | None:
    """The same with one more material; None where the pictures do not want it, unless that is `sure`."""

    def sorted_out(problem: PixelProblem, local: Tensor, shared: Tensor, free: Tensor) -> Materials:
        found, labelled = assigned(problem, local, shared, mask, solve)
        return Materials(problem=labelled, local=found.local, cost=found.cost, shared=shared, free=free)

    trials = []
    for ratio in RATIOS:
        problem, shared, free = with_another(now, ratio)
        trials.append(sorted_out(problem, now.local, shared, free))
    best = min(trials, key=lambda trial: trial.whole)
    for _ in range(ROUNDS):
        found = joint(best.problem, best.local, best.shared, best.free)
        best = sorted_out(best.problem, found.local, found.shared, best.free)
    assert best.problem.obs.material is not None
    shares = torch.bincount(best.problem.obs.material, minlength=best.problem.obs.kinds) / len(best.cost)
    wanted = best.whole < (1.0 - GAIN) * now.whole and float(shares.min()) >= LEAST_AREA
    return best if wanted or sure else None
