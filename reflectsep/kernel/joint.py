"""Globals and all pixels together: every block of pixels reduces to a 4 x 4 system, and these add.

    S dg = -(gg - W^T V^-1 gl),   S = H - W^T V^-1 W,   dl = -V^-1 (gl + W dg)                (see solve/joint.py)

One pass over the pixels for every shared step: follow the step along dl, two local iterations at the new globals,
the new place's system. Nothing but the places is kept between passes, so memory does not grow with what is derived.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.kernel.compiling import Speed, accelerated, side_by_side
from reflectsep.kernel.linear import PACKED, factorise, scales, solve
from reflectsep.kernel.local import BLOCK
from reflectsep.kernel.problem import (
    Constants,
    Data,
    Form,
    Lobe,
    PixelProblem,
    Quadratic,
    pack_constants,
    quadratic,
    read_constants,
    read_data,
    value_of,
    weight_of,
)
from reflectsep.kernel.step import ACTIVE, FIRST_DAMPING, FOUR, Stop, pinned, two_iterations
from reflectsep.solve.joint import ReducedSystem, shared_step

INNER = Stop()
REDUCED_ROWS = 15
"""Cost, S (ten), reduced gradient (four): what a pixel adds to the sums."""


@dataclass(frozen=True, kw_only=True)
class JointStop:
    """When the globals are done."""

    tolerance: float = 1e-6
    """Of the relative decrease of the whole cost, twice in a row."""
    max_iterations: int = 40
    damping: float = 1e-4


@dataclass(frozen=True, kw_only=True)
class JointFit:
    """Where pixels and globals ended."""

    local: Float[Tensor, "4 pixels"]
    lobe: Lobe
    cost: float
    information: Float[Tensor, "4 4"]
    """S: inverse covariance of (a_1, a_2, a_3, n_s), the pixels marginalised, in units of the weights."""
    iterations: int
    converged: bool
    history: tuple[float, ...]


@dataclass(frozen=True)
class Coupled:
    """`Quadratic` with the derivatives by the shared unknowns."""

    local: Quadratic
    W: list[list[Tensor]]
    """Row k: d_1, d_2, d_3, log B; column m: a_1, a_2, a_3, n_s."""
    H: list[Tensor]
    gradient: list[Tensor]


def coupled(x: Sequence[Tensor], data: Data, c: Constants, form: Form) -> Coupled:
    """Cost, gradients and all blocks of the Gauss-Newton matrix at x."""
    zero, B = torch.zeros_like(x[0]), x[3].exp()
    W, H, g = [[zero] * 4 for _ in range(4)], [zero] * 10, [zero] * 4
    for j in range(form.lights):
        v, w = value_of(j, x[:3], B, data, c, form), weight_of(j, data, c)
        by_a, by_n = v.f / B, v.shine * v.log_u
        fy, wr, wa, wn = v.f * v.y, w * v.r, w * by_a, w * by_n
        qa, qn, fa, aa, an, pull = v.q * wa, v.q * wn, fy * wa, by_a * wa, by_a * wn, by_a * wr
        g[3], W[3][3], H[9] = g[3] + by_n * wr, W[3][3] + fy * wn, H[9] + by_n * wn
        mix = [(j, None)] if j < 3 else list(enumerate(c.alpha[j - 3]))
        for k, A in mix:
            g[k], W[3][k] = g[k] + scaled(A, pull), W[3][k] + scaled(A, fa)
            W[k][3], H[PACKED[k][3]] = W[k][3] + scaled(A, qn), H[PACKED[k][3]] + scaled(A, an)
            for m, other in mix:
                W[k][m] = W[k][m] + scaled(A, scaled(other, qa))
                if m >= k:
                    H[PACKED[k][m]] = H[PACKED[k][m]] + scaled(A, scaled(other, aa))
    return Coupled(quadratic(x, data, c, form), W, H, g)


def scaled(factor: Tensor | None, value: Tensor) -> Tensor:
    """Times an entry of A, None for the identity's."""
    return value if factor is None else factor * value


def follow(x: Tensor, maps: Tensor, old: Tensor, new: Tensor, step: Tensor, form: Form) -> Tensor:
    """State of `kernel.step` at the new globals: pixels moved along with the step where that pays."""
    data, places = read_data(maps.unbind(0), form), list(x.unbind(0))
    before, after = read_constants(old, form), read_constants(new, form)
    here = coupled(places, data, before, form)
    dg = step.unbind(0)
    g, V = pinned(places, here.local.gradient, here.local.V, form.bounds)
    pull = [g[k] + sum_of(here.W[k], dg) for k in range(4)]
    least = 20.0 * torch.finfo(x.dtype).eps
    shift = solve(factorise(V, [least * s for s in scales(V)]), pull)
    ends = zip(form.bounds.lower, form.bounds.upper, strict=True)
    moved = [(p - s).clamp(low, high) for p, s, (low, high) in zip(places, shift, ends, strict=True)]
    stay, go = quadratic(places, data, after, form), quadratic(moved, data, after, form)
    better = go.cost < stay.cost
    choose = lambda a, b: torch.where(better, a, b)  # noqa: E731
    zero = torch.zeros_like(places[0])
    return torch.stack(
        [
            *(choose(m, p) for m, p in zip(moved, places, strict=True)),
            choose(go.cost, stay.cost),
            zero + FIRST_DAMPING,
            zero,
            zero + float(ACTIVE),
            *(choose(a, b) for a, b in zip(go.V, stay.V, strict=True)),
            *(choose(a, b) for a, b in zip(go.gradient, stay.gradient, strict=True)),
        ]
    )


def sum_of(row: Sequence[Tensor], factors: Sequence[Tensor]) -> Tensor:
    """Sum of products."""
    return row[0] * factors[0] + row[1] * factors[1] + row[2] * factors[2] + row[3] * factors[3]


def reduce_pixels(x: Tensor, maps: Tensor, packed: Tensor, form: Form) -> Tensor:
    """Cost, S (packed) and reduced gradient of every pixel, (REDUCED_ROWS, block)."""
    places = list(x.unbind(0))
    here = coupled(places, read_data(maps.unbind(0), form), read_constants(packed, form), form)
    g, V = pinned(places, here.local.gradient, here.local.V, form.bounds)
    least = 20.0 * torch.finfo(x.dtype).eps
    factor = factorise(V, [least * s for s in scales(V)])
    columns = [[here.W[k][m] for k in range(4)] for m in range(4)]
    solved = [solve(factor, column) for column in columns]
    own = solve(factor, g)
    S = [here.H[PACKED[i][m]] - sum_of(columns[i], solved[m]) for i in range(4) for m in range(i, 4)]
    gradient = [here.gradient[m] - sum_of(columns[m], own) for m in range(4)]
    return torch.stack([here.local.cost, *S, *gradient])


class Passes:
    """The three kernels, and how the pixels are shared out."""

    def __init__(self, problem: PixelProblem, lobe: Lobe, speed: Speed, block: int) -> None:
        form, pixels, like = problem.form(lobe.n_d), len(problem), problem.images
        self.problem, self.rows, self.parts = problem, form.rows, speed.parts(pixels)
        self.size = speed.block(pixels, block, like)
        self.follow: Callable[..., Tensor] = accelerated(follow, (form,), pixels, speed, like)
        self.iterate: Callable[..., Tensor] = accelerated(two_iterations, (form, INNER), pixels, speed, like)
        self.reduce: Callable[..., Tensor] = accelerated(reduce_pixels, (form,), pixels, speed, like)

    def run(self, local: Tensor, result: Tensor, old: Lobe, new: Lobe) -> tuple[float, ReducedSystem]:
        """One pass at the globals `new` from places that were found at `old`; places go to `result`."""
        constants = pack_constants(self.problem, old), pack_constants(self.problem, new), new.shared - old.shared
        totals = side_by_side(lambda part: self.part(part, local, result, constants), self.parts)
        total = torch.stack(totals).sum(0)
        S = torch.stack([torch.stack([total[1 + PACKED[i][m]] for m in range(4)]) for i in range(4)])
        return float(total[0]), ReducedSystem(S, total[11:])

    def part(self, part: slice, local: Tensor, result: Tensor, constants: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        """`run` on the pixels of one core: its share of the sums."""
        before, after, step = constants
        maps, places = local.new_zeros(self.rows, self.size), local.new_zeros(4, self.size)
        size = self.size
        total = torch.zeros(REDUCED_ROWS, dtype=torch.float64, device=local.device)
        for start in range(part.start, part.stop, size):
            count = min(size, part.stop - start)
            cut, at = slice(start, start + count), 0
            for values in self.problem.maps:
                maps[at : at + len(values), :count] = values[:, cut]
                at += len(values)
            places[:, :count] = local[:, cut]
            state = self.iterate(self.follow(places, maps, before, after, step), maps, after)
            place = state[FOUR.place].contiguous()
            total += self.reduce(place, maps, after)[:, :count].sum(1, dtype=torch.float64)
            result[:, cut] = place[:, :count]
        return total


def solve_jointly(
    problem: PixelProblem,
    local: Float[Tensor, "4 pixels"],
    lobe: Lobe,
    stop: JointStop = JointStop(),
    *,
    speed: Speed = Speed(),  # noqa: B008  (frozen)
    block: int = BLOCK,
) -> JointFit:
    """Minimise the whole cost over every pixel's unknowns and (a_1, a_2, a_3, n_s), from near a minimum.

    Args:
        problem: as for `solve_pixels`; every pixel's cost must be finite.
        local: where the pixels start, e.g. from `search_pixels`.
        lobe: where the globals start.
        stop: when they are done.
        speed: whether to compile.
        block: pixels at once.
    """
    passes = Passes(problem, lobe, speed, block)
    here, spare = local.clone(), torch.empty_like(local)
    cost, system = passes.run(here, spare, lobe, lobe)
    here, spare = spare, here
    history, mu, quiet, converged, iteration = [cost], stop.damping, 0, False, 0
    for iteration in range(1, stop.max_iterations + 1):  # noqa: B007  (reported at the end)
        while mu < 1e8:
            step = shared_step(system, mu, None)
            moved = lobe.moved(lobe.shared + step.to(lobe.a))
            trial, found = passes.run(here, spare, lobe, moved) if moved.n_s > 1.0 else (float("inf"), system)
            if trial < cost:
                break
            mu *= 8.0
        else:
            converged = True
            break
        quiet = quiet + 1 if cost - trial <= stop.tolerance * cost else 0
        here, spare, lobe, cost, system = spare, here, moved, trial, found
        mu = max(mu * 0.2, 1e-9)
        history.append(cost)
        if quiet >= 2:
            converged = True
            break
    return JointFit(
        local=here,
        lobe=lobe,
        cost=cost,
        information=system.S,
        iterations=iteration,
        converged=converged,
        history=tuple(history),
    )
