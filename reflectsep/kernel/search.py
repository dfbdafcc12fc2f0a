"""The whole job of a pixel without a start: the one-dimensional search over B, then its best minima polished.

Given B, each basis equation (x_k)_+^n_d + (c_k + B x_k)_+^n_s = I_k with x = d + s and c = a - B s has one root; the
other pictures score B. The scan walks up in log B. What makes it cheap:

* the last value's roots, moved along d' = -f d / (q + f) per log B, start the next, so that a few steps of Halley's
  method do (they share the power with the value and the slope; for n_d = 1 the body needs none);
* the cost's slope along the roots shows a minimum between two values, and a cubic places it: two dozen values do, close
  together where a mirror lobe is to be expected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.kernel.compiling import Speed, accelerated, side_by_side
from reflectsep.kernel.local import BLOCK, PixelSolution, solve_pixels
from reflectsep.kernel.problem import (
    LEAST,
    Constants,
    Data,
    Form,
    Lobe,
    PixelProblem,
    mixed,
    pack_constants,
    read_constants,
    read_data,
    value_of,
    weight_of,
)
from reflectsep.kernel.step import Stop

HALLEY_STEPS = {False: 3, True: 4}
LEAST_TARGET = 1e-5
"""Pictures below it count as this: a root needs something to stand on."""
ROOTS, ALONG, COST, SLOPE, CENTRE, TOPS = slice(0, 3), slice(3, 6), 6, 7, 8, slice(9, 12)
MINIMA = 12
"""First of the rows that hold the best minima so far, five each: cost, log B, d."""
AS_IT_PAYS = Speed()
AT_ONCE = 1 << 18
"""Pixels whose minima are kept at a time."""


OFFSETS = (-1.2, -0.8, -0.55, *(-0.4 + 1.1 * i / 17 for i in range(18)), 0.9, 1.2, 1.6)


@dataclass(frozen=True, kw_only=True)
class Scan:
    """The values of B that are tried."""

    offsets: tuple[float, ...] = OFFSETS
    """Of log B about log(-2 C_1 / mean_k d), where a mirror lobe without noise would have it; ascending.
    Close where it is: 99.1 % of the pixels at the best known cost; 40 even ones 98.9 %, 80 over a wider span 99.2 %."""
    polish: int = 3
    """Local minima that are polished, at most."""
    stop: Stop = Stop()  # noqa: RUF009  (frozen)


def open_scan(maps: Tensor, packed: Tensor, form: Form, keep: int) -> Tensor:
    """(rows, block) to the state before the first value: the centre of B, and the roots without a lobe."""
    data, c = read_data(maps.unbind(0), form), read_constants(packed, form)
    zero, inf = torch.zeros_like(data.images[0]), torch.full_like(data.images[0], torch.inf)
    target = [image.clamp_min(LEAST_TARGET) for image in data.images[:3]]
    body = [(t.log() / c.n_d).exp() for t in target] if form.power else target
    alone = [b - s for b, s in zip(body, data.s, strict=False)]
    mean = (alone[0] + alone[1] + alone[2]) * (1.0 / 3.0)
    peak = (c.a[0] + c.a[1] + c.a[2]) * (-2.0 / 3.0)
    centre = (peak.clamp_min(1e-3) / mean.clamp_min(1e-4)).log()
    tops = [(t.log() / c.n_s).exp() for t in target]
    nothing = [inf, centre, *alone]
    return torch.stack([*alone, zero, zero, zero, inf, zero - 1.0, centre, *tops, *(nothing * keep)])


def basis_root(
    k: int, d: Tensor, B: Tensor, top: Tensor, data: Data, c: Constants, form: Form
) -> tuple[Tensor, Tensor]:
    """D_k and f_k / q_k' at it: Halley's method from a near start, held below the roots that one term alone has."""
    image, s = data.images[k].clamp_min(LEAST_TARGET), data.s[k]
    above = ((image.log() / c.n_d).exp() if form.power else image) - s
    limit = torch.minimum(above, (top - c.a[k]) / B)
    d = torch.minimum(d, limit)
    f, slope = torch.zeros_like(d), torch.ones_like(d)
    for _ in range(HALLEY_STEPS[form.power]):
        u = (c.a[k] + B * d).clamp_min(LEAST)
        power = ((c.n_s - 1.0) * u.log()).exp()
        f = c.n_s * power * B
        x = (d + s).clamp_min(1e-6)
        if form.power:
            narrow = ((c.n_d - 1.0) * x.log()).exp()
            body, q, bend = narrow * x, c.n_d * narrow, c.n_d * (c.n_d - 1.0) * narrow / x
        else:
            body, q, bend = d + s, torch.ones_like(d), 0.0
        h, slope = body + power * u - image, q + f
        curve = bend + (c.n_s - 1.0) * f * B / u
        ratio = h / slope
        d = torch.minimum(d - ratio / (1.0 - 0.5 * ratio * curve / slope).clamp(0.5, 2.0), limit)
    return d, f / slope


def scan_value(state: Tensor, maps: Tensor, packed: Tensor, offsets: Tensor, form: Form) -> Tensor:
    """The state after one more value; `offsets`: its log B about the centre, the step from the last, 1 to close."""
    data, c = read_data(maps.unbind(0), form), read_constants(packed, form)
    rows = state.unbind(0)
    before, moved, tops = rows[ROOTS], rows[ALONG], rows[TOPS]
    old, slope, centre = rows[COST], rows[SLOPE], rows[CENTRE]
    step = offsets[1]
    log_B = centre + offsets[0]
    B = log_B.exp()
    found = [basis_root(k, before[k] + step * moved[k], B, tops[k], data, c, form) for k in range(3)]
    d = [root for root, _ in found]
    along = [-root * lean for root, lean in found]
    cost, rise = score(d, along, log_B, B, data, c, form)
    closing = offsets[2] > 0.0
    cost, rise = torch.where(closing, torch.inf, cost), torch.where(closing, 1.0, rise)
    dip = (slope < 0) & (rise >= 0)
    at, lowest = cubic_minimum(old, slope * step, cost, rise * step)
    place = [lowest, log_B + (at - 1.0) * step]
    place += [hermite(at, a, da * step, b, db * step) for a, da, b, db in zip(before, moved, d, along, strict=True)]
    minima = []
    for first in range(MINIMA, len(rows), 5):
        kept = rows[first : first + 5]
        # Whichever is higher is offered to the next place.
        lower = dip & (place[0] < kept[0])
        minima += [torch.where(lower, n, o) for n, o in zip(place, kept, strict=True)]
        place = [torch.where(lower, o, n) for n, o in zip(place, kept, strict=True)]
    return torch.stack([*d, *along, cost, rise, centre, *tops, *minima])


def hermite(t: Tensor, a: Tensor, da: Tensor, b: Tensor, db: Tensor) -> Tensor:
    """The cubic with values a, b and slopes da, db at 0 and 1, at t."""
    away = b - a
    return a + t * (da + t * (3.0 * away - 2.0 * da - db + t * (da + db - 2.0 * away)))


def cubic_minimum(a: Tensor, da: Tensor, b: Tensor, db: Tensor) -> tuple[Tensor, Tensor]:
    """Where in [0, 1] that cubic is lowest, and how low; the one end that is finite where the other is not."""
    theta = da + db - 3.0 * (b - a)
    root = (theta * theta - da * db).clamp_min(0.0).sqrt()
    t = (1.0 - (db + root - theta) / (db - da + 2.0 * root).clamp_min(LEAST)).clamp(0.0, 1.0)
    value = torch.minimum(torch.minimum(a, b), hermite(t, a, da, b, db).clamp_min(0.0))
    opening, closing = a == torch.inf, b == torch.inf
    t = torch.where(opening, 1.0, torch.where(closing, 0.0, t))
    return t, torch.where(opening, b, torch.where(closing, a, value))


def score(
    d: Sequence[Tensor], along: Sequence[Tensor], log_B: Tensor, B: Tensor, data: Data, c: Constants, form: Form
) -> tuple[Tensor, Tensor]:
    """Cost at the roots, of the other pictures and of the priors, and its slope by log B."""
    cost, rise = torch.zeros_like(B), torch.zeros_like(B)
    for j in range(3, form.lights):
        v = value_of(j, d, B, data, c, form)
        wr = weight_of(j, data, c) * v.r
        cost = cost + wr * v.r
        rise = rise + wr * (v.q * mixed(c.alpha[j - 3], along) + v.f * v.y)
    if form.priors:
        for k, (value, slope) in enumerate(zip((*d, log_B), (*along, torch.ones_like(B)), strict=True)):
            pull = data.prior[k] * (value - data.centre[k])
            cost, rise = cost + pull * (value - data.centre[k]), rise + pull * slope
    return 0.5 * cost, rise


def scan_pixels(
    problem: PixelProblem, lobe: Lobe, scan: Scan = Scan(), *, speed: Speed = AS_IT_PAYS
) -> Float[Tensor, "minima 5 pixels"]:
    """The best minima of every pixel over B: cost (infinite where there is none), log B, d_1, d_2, d_3."""
    pixels, form, packed = len(problem), problem.form(lobe.n_d), pack_constants(problem, lobe)
    begin = accelerated(open_scan, (form, scan.polish), pixels, speed, problem.images)
    advance = accelerated(scan_value, (form,), pixels, speed, problem.images)
    result = problem.images.new_empty(scan.polish, 5, pixels)
    steps = [0.0, *(b - a for a, b in pairwise(scan.offsets)), 1.0]
    places = zip((*scan.offsets, scan.offsets[-1] + 1.0), steps, [*(0.0 for _ in scan.offsets), 1.0], strict=True)
    offsets = [problem.images.new_tensor(place) for place in places]

    def work(part: slice) -> None:
        size = speed.block(pixels, BLOCK, problem.images)
        maps = problem.images.new_zeros(form.rows, size)
        for start in range(part.start, part.stop, size):
            count, at = min(size, part.stop - start), 0
            for values in problem.maps:
                maps[at : at + len(values), :count] = values[:, start : start + count]
                at += len(values)
            state = begin(maps, packed)
            for offset in offsets:
                state = advance(state, maps, packed, offset)
            result[:, :, start : start + count] = state[MINIMA:, :count].unflatten(0, (scan.polish, 5))

    side_by_side(work, speed.parts(pixels))
    return result


def search_pixels(
    problem: PixelProblem, lobe: Lobe, scan: Scan = Scan(), *, speed: Speed = AS_IT_PAYS
) -> PixelSolution:
    """Minimise every pixel's cost without a start: scan B, polish the best minima, keep the cheaper.

    Args:
        problem: as for `solve_pixels`.
        lobe: the globals, held; n_s > 1 and negative a.
        scan: which values of B, and how many minima are polished.
        speed: whether to compile.
    """
    result = PixelSolution(
        local=problem.images.new_empty(4, len(problem)),
        cost=problem.images.new_empty(len(problem)),
        status=torch.empty(len(problem), dtype=torch.int8, device=problem.images.device),
        iterations=0,
    )
    own = speed.of_a_part(len(problem), problem.images)

    def work(part: slice) -> int:
        # From the scan to the choice on one core: the cores meet only at the end.
        found, room = _search(problem.take(part), lobe, scan, own), result.at(part)
        room.local.copy_(found.local)
        room.cost.copy_(found.cost)
        room.status.copy_(found.status)
        return found.iterations

    total = sum(side_by_side(work, speed.parts(len(problem), AT_ONCE), speed.workers))
    return replace(result, iterations=total)


def _search(problem: PixelProblem, lobe: Lobe, scan: Scan, speed: Speed) -> PixelSolution:
    pixels, minima = len(problem), scan_pixels(problem, lobe, scan, speed=speed)
    starts = minima[:, [2, 3, 4, 1]]
    which = [torch.arange(pixels, device=minima.device)]
    which += [(further < torch.inf).nonzero()[:, 0] for further in minima[1:, 0]]
    start = torch.cat([values[:, at] for values, at in zip(starts, which, strict=True)], 1)
    found = solve_pixels(problem, start, lobe, scan.stop, speed=speed, which=torch.cat(which))
    local, cost, status = (values[..., :pixels].clone() for values in (found.local, found.cost, found.status))
    after = pixels
    for entries in which[1:]:
        cut = slice(after, after + len(entries))
        better = found.cost[cut] < cost[entries]
        at, of = entries[better], after + better.nonzero()[:, 0]
        local[:, at], cost[at], status[at] = found.local[:, of], found.cost[of], found.status[of]
        after += len(entries)
    return PixelSolution(local=local, cost=cost, status=status, iterations=found.iterations)
