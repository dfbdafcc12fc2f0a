"""From start values to the joint optimum of all pixels: the paper's two steps, and everything together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from reflectsep.fit.blocks import build_problem
from reflectsep.fit.chunks import cuts, in_chunks, taken
from reflectsep.fit.neighbours import local_median
from reflectsep.fit.problem import (
    LOG_N_D,
    LOG_N_S,
    Locals,
    Observations,
    Priors,
    alpha_of,
    moved,
    refined,
    unpack,
    unpack_globals,
)
from reflectsep.fit.search import joined, scan
from reflectsep.model import lobe, lobe_argument, signed_root
from reflectsep.room import copied
from reflectsep.solve.joint import COMPANY, JointOptions, JointSolution, local_in_chunks, solve_joint
from reflectsep.solve.local import Termination
from reflectsep.solve.sharing import SHARES, by_chunks

Report = Callable[[int, int], None]

SAME_LOBE = 0.02
"""Lobes that differ by less, relatively, are one start."""
SAME_WAY = 0.02
"""Globals this close (none differs by more) end in the same place."""
UNSEEN = 0.1
"""Highlights below this many standard deviations of the noise do not lead a pixel anywhere."""


@dataclass(frozen=True, kw_only=True)
class Effort:
    """How hard to try."""

    minima: int = 4
    """Minima of every pixel that are polished."""
    polish: Termination = field(default_factory=lambda: Termination(max_iterations=60))
    joint: JointOptions = field(default_factory=lambda: JointOptions(max_iterations=20))
    trim: float = 0.8
    """Share of the chosen pixels that has a vote on the globals: those that the model explains best."""
    trim_all: float = 0.97
    """The same when all pixels are fitted."""
    voters: int = 30_000
    """Pixels that vote at most: the globals of more are known no better, and the others follow them."""
    patience: int = 20
    """Iterations of a pixel at most while the globals are sought: those that need more are not worth the wait there."""
    rounds: int = 4
    starts: int = 3
    chunk: int = 1 << 12


@dataclass(frozen=True)
class LocalFit:
    """Best local solutions, and how clearly they are best."""

    local: Float[Tensor, "pixels P"]
    cost: Float[Tensor, "pixels"]
    runner_up: Float[Tensor, "pixels"]
    """Cost of the best solution that is another one; inf if there is none."""
    converged: Bool[Tensor, "pixels"]


def fit_locals(
    obs: Observations, priors: Priors, shared: Float[Tensor, "G"], effort: Effort, robust: float | None
) -> LocalFit:
    """Search over B, then LM from the best minima of every pixel, the globals held (the paper's second step)."""

    def fitted(cut: slice) -> tuple[Tensor, ...]:
        index = torch.arange(cut.start, cut.stop)
        there = obs.take(index).there(), moved(priors.take(index), obs.device), shared.to(obs.device)
        part = fit_chunk(*there, effort, robust)
        found = part.local, part.cost, part.runner_up, part.converged
        return tuple(each.to(shared.device) for each in found)

    # Each pixel has several starts, which share a chunk's last iterations.
    together = max(effort.chunk, min(COMPANY // effort.minima * effort.chunk, len(obs) // SHARES))
    return LocalFit(*by_chunks(len(obs), together, fitted))


def fit_chunk(obs: Observations, priors: Priors, shared: Tensor, effort: Effort, robust: float | None) -> LocalFit:
    """`fit_locals` on the pixels of some chunks."""
    at_once = [slice(i, i + effort.chunk) for i in range(0, len(obs), effort.chunk)]
    candidates = joined([scan(obs.take(i), priors.take(i), shared, keep=effort.minima) for i in at_once])
    problem = build_problem(obs, priors, robust=robust)
    # All minima in one batch: of few pixels the calls take longer than the arithmetic.
    k, pixel = candidates.cost.T.isfinite().nonzero(as_tuple=True)
    start = pack_start(obs.take(pixel), candidates.d[pixel, k], candidates.log_B[pixel, k])
    ends = local_in_chunks(problem.take(pixel), start, shared, effort.polish, effort.chunk)
    best: LocalFit | None = None
    for i in range(effort.minima):
        which = k == i
        if bool(which.any()):
            end = ends.local[which], ends.cost[which], ends.converged[which]
            best = merge(best, pixel[which], *end, len(obs))
    assert best is not None  # every scan has a minimum
    return best


def pack_start(obs: Observations, d: Tensor, log_B: Tensor) -> Tensor:
    """A start as the solver's row; s joins the unknowns where it is one."""
    return Locals(d, log_B, obs.s_basis if obs.s_unknown else None).pack()


def merge(
    best: LocalFit | None, which: Tensor, local: Tensor, cost: Tensor, converged: Tensor, pixels: int
) -> LocalFit:
    """The better of what was and what has been found at the pixels `which`."""
    if best is None:
        empty = local.new_full((pixels,), torch.inf)
        best = LocalFit(local.new_zeros(pixels, local.shape[1]), empty, empty.clone(), empty.isnan())
    result = LocalFit(copied(best.local), best.cost.clone(), best.runner_up.clone(), best.converged.clone())
    for cut in cuts(len(which)):
        _merge_some(result, best, which[cut], local[cut], cost[cut], converged[cut])
    return result


def _merge_some(
    result: LocalFit, best: LocalFit, which: Tensor, local: Tensor, cost: Tensor, converged: Tensor
) -> None:
    """`merge` at some of the pixels."""
    old, new_cost, before = best.cost[which], cost.nan_to_num(nan=torch.inf), best.local[which]
    better = new_cost < old
    other = (local - before).abs().amax(-1) > 0.02 * local.abs().amax(-1)
    loser = torch.where(better, old, new_cost)
    result.local[which] = torch.where(better[:, None], local, before)
    result.cost[which] = torch.where(better, new_cost, old)
    runner_up = best.runner_up[which]
    result.runner_up[which] = torch.where(other, torch.minimum(runner_up, loser), runner_up)
    result.converged[which] = torch.where(better, converged, best.converged[which])


def fit_globals(
    obs: Observations,
    priors: Priors,
    starts: Sequence[Float[Tensor, "G"]],
    free: Bool[Tensor, "G"],
    effort: Effort,
    robust: float | None,
    report: Report,
) -> Float[Tensor, "G"]:
    """The globals from chosen pixels (the paper's first step): from each start, search and joint fit in turn.

    Only the `trim` share of the pixels that the model explains best takes part in a joint fit: one pixel in a wrong
    minimum outweighs a hundred good ones.
    """
    number = max(4, int(effort.trim * len(obs)))
    brief = lambda end: replace(end, max_iterations=min(effort.patience, end.max_iterations))  # noqa: E731
    joint = replace(effort.joint, inner=brief(effort.joint.inner))
    effort = replace(effort, polish=brief(effort.polish), joint=joint)
    results, passed = [], []
    for i, trial in enumerate(starts):
        shared, way = trial, []
        for _ in range(effort.rounds):
            found = fit_locals(obs, priors, shared, effort, robust)
            keep = found.cost.argsort()[:number]
            problem = build_problem(obs.take(keep), priors.take(keep), robust=robust)
            end = solve_joint(problem, found.local[keep], shared, effort.joint, free=free)
            step = float((end.shared - shared).abs().max())
            shared = end.shared
            way.append(shared)
            if step < 1e-3 or met(shared, passed):
                break
        if not met(shared, passed):
            found = fit_locals(obs, priors, shared, effort, robust)
            results.append((float(found.cost.sort().values[:number].sum()), i, shared))
        passed += way
        report(i + 1, len(starts))
    return min(results, key=lambda entry: entry[:2])[2]


def met(shared: Float[Tensor, "G"], passed: Sequence[Float[Tensor, "G"]]) -> bool:
    """Whether an earlier start came by here, and so leads where this one would."""
    return any(float((shared - place).abs().max()) < SAME_WAY for place in passed)


def fit_everything(
    obs: Observations,
    priors: Priors,
    found: LocalFit,
    shared: Float[Tensor, "G"],
    free: Bool[Tensor, "G"],
    effort: Effort,
    robust: float | None,
    report: Report,
) -> JointSolution:
    """Globals and all pixels jointly; pixels that the model cannot explain follow without a vote."""
    if not bool(free.any()):
        return follow_the_globals(obs, priors, found, shared, effort, robust)
    number = max(4, int(effort.trim_all * len(obs)))
    vote = found.cost.argsort()[:number].sort().values
    vote = vote[:: max(1, -(-len(vote) // effort.voters))]
    problem = build_problem(obs, priors, robust=robust)
    total = effort.joint.max_iterations
    joint = solve_joint(
        problem.take(vote), found.local[vote], shared, effort.joint, free=free, watch=lambda i, _: report(i, total)
    )
    local, settled = copied(found.local), found.converged.clone()
    local[vote], settled[vote] = joint.local, joint.settled
    rest = torch.ones(len(obs), dtype=torch.bool)
    rest[vote] = False
    index = rest.nonzero()[:, 0]
    if len(index):
        others = local_in_chunks(problem, taken(local, index), joint.shared, effort.polish, effort.chunk, index)
        local[index], settled[index] = others.local, others.converged
    return replace(joint, local=local, settled=settled)


def follow_the_globals(
    obs: Observations,
    priors: Priors,
    found: LocalFit,
    shared: Float[Tensor, "G"],
    effort: Effort,
    robust: float | None,
) -> JointSolution:
    """All pixels under globals that are held."""
    problem = build_problem(obs, priors, robust=robust)
    ends = local_in_chunks(problem, found.local, shared, effort.polish, effort.chunk)
    cost = float(ends.cost.sum())
    return JointSolution(
        local=ends.local,
        shared=shared,
        cost=cost,
        information=shared.new_zeros(len(shared), len(shared)),
        iterations=0,
        converged=True,
        settled=ends.converged,
        history=(cost,),
    )


def hand_on_lobes(
    obs: Observations,
    priors: Priors,
    found: LocalFit,
    shared: Float[Tensor, "G"],
    mask: Bool[Tensor, "height width"],
    effort: Effort,
    robust: float | None,
    *,
    radius: int,
) -> LocalFit:
    """Offer every pixel the median lobe of its neighbours as a start; it keeps the cheaper solution.

    A lobe B d is a matter of shape alone, so neighbours share it whatever their albedo.
    """
    x = unpack(found.local, obs.channels)
    own = in_chunks(len(obs), lambda cut: x.B[cut, None] * x.d[cut].mean(1))
    lobe_vector = local_median(own, mask, radius)
    return offer_lobes(obs, priors, found, shared, lobe_vector, effort, robust)


def offer_lobes(
    obs: Observations,
    priors: Priors,
    found: LocalFit,
    shared: Float[Tensor, "G"],
    lobe_vector: Float[Tensor, "pixels 3"],
    effort: Effort,
    robust: float | None,
) -> LocalFit:
    """Every pixel from the start whose lobe B d is `lobe_vector`, where that ends cheaper than what was found."""
    which = worth_trying(obs, found.local, shared, lobe_vector)
    if len(which) == 0:
        return found
    start = in_chunks(
        len(which), lambda cut: with_that_lobe(obs, found.local, shared, lobe_vector[which[cut]], which[cut])
    )
    problem = build_problem(obs, priors, robust=robust)
    tried = local_in_chunks(problem, start, shared, effort.polish, effort.chunk, which)
    return merge(found, which, tried.local, tried.cost, tried.converged, len(obs))


def with_that_lobe(
    obs: Observations, local: Tensor, shared: Tensor, lobe_vector: Float[Tensor, "some 3"], which: Int[Tensor, "some"]
) -> Float[Tensor, "some P"]:
    """Starts of the pixels `which` whose lobes are `lobe_vector`: what these leave of the pictures is diffuse."""
    obs = obs.take(which)
    x = unpack(local[which], obs.channels)
    globals_ = unpack_globals(shared, obs.n_d)
    shine = lobe(globals_.a + lobe_vector, globals_.n_s, globals_.crest)
    s = obs.s_basis if x.s is None else x.s
    d = signed_root(obs.images[..., :3] - shine[:, None], float(globals_.n_d)) - s
    # Where a basis light leaves the patch dark the root says nothing; keep the pixel's own.
    d = torch.where(d + s > 0, d, x.d)
    mean = d.mean((1, 2))
    usable = (mean > 1e-6) & (lobe_vector.mean(-1) > 1e-6)
    log_B = torch.where(usable, (lobe_vector.mean(-1) / mean.clamp_min(1e-9)).clamp_min(1e-9).log(), x.log_B)
    return Locals(d, log_B, x.s).pack()


def worth_trying(
    obs: Observations, local: Tensor, shared: Float[Tensor, "G"], lobe_vector: Float[Tensor, "pixels 3"]
) -> Int[Tensor, "some"]:
    """Pixels that another lobe could lead elsewhere: not where it is the present one, nor where neither is seen."""

    def worth(cut: slice) -> Tensor:
        part, other = refined(obs.take(cut), shared), lobe_vector[cut]
        x, g = unpack(local[cut], obs.channels), unpack_globals(shared, obs.n_d)
        own = x.B[:, None] * x.d.mean(1)
        same = (other - own).norm(dim=-1) <= SAME_LOBE * own.norm(dim=-1)
        peak = lambda v: (lobe((g.a + v) @ part.alpha.mT, g.n_s, g.crest) * part.weight.mean(1)).amax(-1)  # noqa: E731
        return ~same & ((peak(own) > UNSEEN) | (peak(other) > UNSEEN))

    return in_chunks(len(local), worth).nonzero()[:, 0]


def initial_shared(like: Tensor, cosine: Tensor, n_d: float, n_s: float | None) -> Float[Tensor, "8"]:
    """Shared unknowns before any search: hard shadows, the paper's lobe."""
    shared = like.new_zeros(8)
    shared[:3] = -0.9 * cosine
    shared[LOG_N_S] = torch.log(like.new_tensor(12.0 if n_s is None else n_s))
    shared[LOG_N_D] = torch.log(like.new_tensor(n_d))
    return shared


def lobe_pictures(obs: Observations, local: Tensor, shared: Tensor) -> Float[Tensor, "pixels lights"]:
    """Off-specular value of every pixel and light."""
    x, g = unpack(local, obs.channels), unpack_globals(shared, obs.n_d)
    return lobe(lobe_argument(x.d, x.B, g.a, alpha_of(obs, shared)), g.n_s, g.crest)
