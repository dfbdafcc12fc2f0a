"""Levenberg-Marquardt on many independent blocks at once, the shared parameters held fixed.

    (V + mu diag V) dl = -gl,    V = J^T w J,    gl = J^T w r          one small system a block

Every block has its own damping mu, its own acceptance and its own end; nothing is summed over the batch, so that a
block's result depends neither on its neighbours nor on how the batch was cut. Finished blocks make room for others.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from reflectsep.solve.problem import BlockProblem

AT_ONCE = 1 << 10
"""Blocks under way: enough for the calls to be cheap beside the arithmetic, few enough to stay in the cache."""
LANES = 64
"""Blocks under way are a multiple of this: the library rounds what is left over beside whole vectors differently."""
WORSE = 4.0
"""Factor of the damping after a step that was none."""


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


def total(values: Tensor, dim: int = 0) -> Tensor:
    """Sum over a dimension by halves: unlike the library's, with the same rounding however many blocks there are."""
    while (count := values.shape[dim]) > 1:
        half = count // 2
        folded = values.narrow(dim, 0, half) + values.narrow(dim, half, half)
        if count % 2:
            folded.narrow(dim, 0, 1).add_(values.narrow(dim, count - 1, 1))
        values = folded
    return values.squeeze(dim)


def scale_of(V: Float[Tensor, "P P blocks"]) -> Float[Tensor, "P blocks"]:
    """Diagonals, with a floor: a parameter that no residual feels must not make the system singular, in any unit."""
    diagonal = V.diagonal().T
    return diagonal.clamp_min(1e-12 * diagonal.amax(0)).clamp_min(torch.finfo(V.dtype).tiny * 1e6)


def solve_positive(
    V: Float[Tensor, "P P blocks"], diagonal: Float[Tensor, "P blocks"], right: Float[Tensor, "sides P blocks"]
) -> Float[Tensor, "sides P blocks"]:
    """V^-1 right of every block, of whose V the lower triangle is read and the diagonal is to be `diagonal`.

    By L D L^T, an entry of all blocks at a time, hence with the same rounding however many there are. 0 where V is not
    positive definite.
    """
    P = len(V)
    # The right sides go along as further rows, and are eliminated with the others.
    system = torch.cat([V, right])
    system[:P].diagonal().T.copy_(diagonal)
    inverse = torch.empty_like(diagonal)
    for k in range(P):
        torch.reciprocal(system[k, k], out=inverse[k])
        below = system[k + 1 :, k]
        system[k + 1 :, k + 1 :].addcmul_((below * inverse[k])[:, None], below[None, : P - k - 1], value=-1.0)
    solution = system[P:]
    for k in reversed(range(P)):
        solution[:, k] *= inverse[k]
        solution[:, :k].addcmul_(system[k, :k], solution[:, k, None], value=-1.0)
    sound = (inverse > 0).all(0) & solution.isfinite().all(0).all(0)
    return torch.where(sound, solution, 0.0)


def solve_damped(
    V: Float[Tensor, "P P blocks"], gradient: Float[Tensor, "P blocks"], mu: Float[Tensor, "blocks"]
) -> tuple[Float[Tensor, "P blocks"], Float[Tensor, "blocks"]]:
    """-(V + mu diag V)^-1 gradient of every block, and by how much the undamped model says that lowers the cost."""
    scale = scale_of(V)
    step = solve_positive(V, torch.maximum(V.diagonal().T, scale) + mu * scale, -gradient[None])[0]
    # (V + mu diag V) step = -gradient, so that step^T V step needs no product with V.
    predicted = 0.5 * total(step * (mu * scale * step - gradient))
    # No step where V is not positive is no sign of an end: more damping may make it so.
    stuck = (step == 0).all(0) & (gradient != 0).any(0)
    return step, torch.where(stuck, torch.inf, predicted)


@dataclass(frozen=True)
class Linearised:
    """Cost, gradient and Gauss-Newton matrix of every block at some place, blocks last."""

    cost: Float[Tensor, "blocks"]
    gradient: Float[Tensor, "P blocks"]
    V: Float[Tensor, "P P blocks"]

    @classmethod
    def at(cls, problem: BlockProblem, local: Float[Tensor, "blocks P"], shared: Tensor) -> Linearised:
        """At `local`; a cost that is no number counts as infinite."""
        cost, gradient, V = problem.normal_equations(local, shared)
        return cls(cost.nan_to_num(nan=torch.inf, posinf=torch.inf), gradient, V)

    @classmethod
    def nowhere(cls, local: Float[Tensor, "blocks P"]) -> Linearised:
        """Where any place is better than this, and no step leads away."""
        blocks, P = local.shape
        here = cls(local.new_empty(blocks), local.new_empty(P, blocks), local.new_empty(P, P, blocks))
        here.restart(torch.arange(blocks, device=local.device))
        return here

    def take(self, index: Int[Tensor, "some"]) -> Linearised:
        """Some of the blocks."""
        return Linearised(self.cost[index], self.gradient[:, index], self.V[:, :, index])

    def restart(self, which: Int[Tensor, "some"]) -> None:
        """Put the blocks `which` back to `nowhere`."""
        self.cost[which], self.gradient[:, which] = torch.inf, 0.0
        self.V[:, :, which] = torch.eye(len(self.V), dtype=self.V.dtype, device=self.V.device)[..., None]

    def unless(self, worse: Int[Tensor, "some"], before: Linearised) -> Linearised:
        """This, but at the blocks `worse` what was before."""
        if len(worse):
            self.cost[worse] = before.cost[worse]
            self.gradient[:, worse] = before.gradient[:, worse]
            self.V[:, :, worse] = before.V[:, :, worse]
        return self


def relaxed(gain: Float[Tensor, "blocks"]) -> Float[Tensor, "blocks"]:
    """Factor of the damping after a step that lowered the cost by `gain` times what was predicted.

    In a curved valley a step that barely helps must not be followed by a longer one (Nielsen 1999, report
    IMM-REP-1999-05). Against a fixed factor a tenth to a fifth of the iterations is saved, and of the blocks that did
    not come to an end, three quarters do.
    """
    return (1.0 - (2.0 * gain.clamp(0.0, 2.0) - 1.0) ** 3).clamp(0.1, 2.0)


def filled_up(index: Int[Tensor, "some"]) -> Int[Tensor, "more"]:
    """`index` with its first entry again and again, up to whole `LANES`."""
    return torch.cat([index, index[:1].expand(-len(index) % LANES)])


def solve_local(
    problem: BlockProblem,
    local: Float[Tensor, "blocks P"],
    shared: Float[Tensor, "G"],
    termination: Termination = Termination(),
    *,
    damping: float = 1e-4,
    at_once: int = AT_ONCE,
) -> LocalSolution:
    """Minimise every block's cost over its own unknowns from `local`.

    A block ends converged when its predicted relative decrease falls below the tolerance, or when damping has grown
    so far that no step can decrease its cost. `at_once` blocks, in whole `LANES`, are under way; the next one takes the
    place of one that is finished, for a few that take many iterations cost as much time alone as in company.
    """
    if problem.held is not None:
        return problem.held(local, shared, termination, *problem.data)
    local, waiting = local.clone(), min(-(-at_once // LANES) * LANES, len(local))
    cost = local.new_full((len(local),), torch.inf)
    converged, longest = torch.zeros(len(local), dtype=torch.bool, device=local.device), 0
    active = filled_up(torch.arange(waiting, device=local.device))
    part, place, under_way = problem.take(active), local[active], waiting
    here, mu = Linearised.nowhere(place), torch.full_like(place[:, 0], damping)
    age = torch.zeros_like(active)
    while under_way:
        # Cost, gradient and matrix at the present place are kept: an iteration evaluates once, at the trial place. The
        # first of a block is at its start.
        step, predicted = solve_damped(here.V, here.gradient, mu)
        trial, begun = place + step.T, age > 0
        there = Linearised.at(part, trial, shared)
        better = there.cost < here.cost
        gain = (here.cost - there.cost) / predicted.clamp_min(torch.finfo(predicted.dtype).tiny)
        mu = torch.where(begun, mu * torch.where(better, relaxed(gain), WORSE), mu)
        end = begun & ((predicted <= termination.tolerance * here.cost + termination.floor) | (mu > 1e9))
        done = end | (age >= termination.max_iterations)
        sound = end & here.cost.isfinite()
        mu = mu.clamp_min(1e-9)
        worse = (~better).nonzero()[:, 0]
        trial[worse] = place[worse]
        place, here, age = trial, there.unless(worse, here), age + 1
        if not bool(done.any()):
            continue
        finished = done.nonzero()[:, 0]
        which = active[finished]
        local[which], cost[which], converged[which] = place[finished], here.cost[finished], sound[finished]
        longest = max(longest, int(age[finished].max()) - 1)
        filled = min(len(finished), len(local) - waiting)
        if filled:
            slots, new = finished[:filled], torch.arange(waiting, waiting + filled, device=local.device)
            for mine, of_all in zip(part.data, problem.data, strict=True):
                mine[slots] = of_all[new]
            active[slots], place[slots], mu[slots], age[slots] = new, local[new], damping, 0
            here.restart(slots)
            waiting += filled
        if filled < len(finished):
            done[finished[:filled]] = False
            left = (~done[:under_way]).nonzero()[:, 0]
            under_way, left = len(left), filled_up(left)
            part, here = part.take(left), here.take(left)
            active, place, mu, age = active[left], place[left], mu[left], age[left]
    return LocalSolution(local=local, cost=cost, converged=converged, iterations=longest)
