"""A pixel's Gauss-Newton system entry by entry, for a compiler to make loops of.

The same cost, gradient and matrix as `fit/normal.py`'s, whose symbols these are, but the matrix is never put together.
A pixel's channels meet in z = B mean_c d alone, and in two rows of the priors, so that all is said by

    S_c, X_c, D_c   of s_c with s_c, of s_c with d_c, and of d_c with d_c, what goes not by way of z
    N_c, T          of d_c or s_c with z, and of z with z
    e, w            the slopes of the row shape by any d_c and by log B
    q               those of the row ratio

A line is a number of every pixel, (pixels,), or of its every channel,
(channels, pixels).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.fit.problem import GGX, LOG_C_2, SOFTNESS, Observations, Priors, alpha_of, refined, unpack_globals
from reflectsep.kernel.linear import places
from reflectsep.model import ggx_with_slope, power_with_slope

Line = Any
"""A tensor, or a plain number."""
Triple = Sequence[Line]
Square = Sequence[Line]
"""The upper triangle of a symmetric 3 x 3 matrix, row by row."""
AT = places(3)


@dataclass(frozen=True, kw_only=True)
class Form:
    """What the compiled code depends on; everything else is data."""

    lights: int
    channels: int
    s_free: bool
    power: bool
    """n_d differs from 1."""
    ggx: bool
    lights_known: bool

    @property
    def unknowns(self) -> int:
        """Of a pixel."""
        return 3 * self.channels * (2 if self.s_free else 1) + 1

    @property
    def system(self) -> int:
        """Rows of a packed `System`."""
        return (39 if self.s_free else 18) * self.channels + 14


@dataclass(frozen=True)
class Constants:
    """Numbers that all pixels share, each a tensor without dimensions."""

    A: Sequence[Triple]
    normal_map: Sequence[Triple]
    view: Triple
    a: Triple
    n_s: Tensor
    n_d: Tensor
    crest: Tensor
    log_C_2: Tensor  # noqa: N815
    softness: Tensor
    shape: Tensor
    robust: Tensor
    """Huber threshold of the pictures' rows; inf: none."""


@dataclass(frozen=True)
class Data:
    """What is known of single pixels, the priors by the names of `Priors`.

    A weight below 0 is that of a clipped value.
    """

    images: Sequence[Line]
    s: Sequence[Line]
    weight: Sequence[Line]
    """Of every light, all channels."""
    parallel: Line
    ratio: Line
    ratio_weight: Line
    lobe_weight: Line
    facing_weight: Line
    s_weight: Line
    lobe: Triple
    facing: Triple


@dataclass(frozen=True)
class Place:
    """A pixel's unknowns and what hangs on them alone."""

    d: Triple
    log_B: Line  # noqa: N815
    s: Triple
    mean: Triple
    """Of d over the channels."""
    z: Triple
    share: Line
    """B / C."""


@dataclass(frozen=True)
class System:
    """Gradient and matrix of every pixel, in the symbols of the module's head."""

    D: Square
    N: Square
    by_d: Triple
    """Gradient by d_c, but for what goes by way of z, of shape and of ratio."""
    tie_d: Triple
    """q by d_c."""
    S: Square
    X: Sequence[Triple]
    by_s: Triple
    tie_s: Triple
    T: Square
    by_z: Triple
    e: Triple
    shape: Line
    """The row shape."""
    ratio: Line
    """The row ratio."""


def form_of(obs: Observations, shared: Float[Tensor, "G"]) -> Form:
    """Of a problem whose shared unknowns are held."""
    return Form(
        lights=len(obs.alpha),
        channels=obs.channels,
        s_free=obs.s_unknown,
        power=obs.n_d != 1.0,
        ggx=bool(shared[GGX] > 0),
        lights_known=obs.lights_known,
    )


def pack_constants(
    obs: Observations, priors: Priors, shared: Float[Tensor, "G"], robust: float | None
) -> Float[Tensor, "constants"]:
    """As one tensor: few arguments make a cheap call."""
    g = unpack_globals(shared, obs.n_d)
    ours = [g.n_s, torch.as_tensor(g.n_d, dtype=shared.dtype), g.crest, shared[LOG_C_2], shared[SOFTNESS]]
    given = shared.new_tensor([priors.shape, math.inf if robust is None else robust])
    parts = [alpha_of(obs, shared).flatten(), obs.normal_map.flatten(), obs.view, g.a, torch.stack(ours), given]
    return torch.cat(parts)


def read_constants(packed: Tensor, form: Form) -> Constants:
    """`pack_constants` undone."""
    values, triples = packed.unbind(0), 3 * (form.lights + 5)
    A = [values[i : i + 3] for i in range(0, triples, 3)]
    return Constants(A[: form.lights], A[form.lights : -2], A[-2], A[-1], *values[triples:])


def pack_data(obs: Observations, priors: Priors, shared: Float[Tensor, "G"]) -> Float[Tensor, "rows pixels"]:
    """All that is known of the pixels, one row a number."""
    obs = refined(obs, shared)
    weight = torch.where(obs.clipped, -obs.weight, obs.weight)
    strengths = [priors.parallel, priors.ratio, priors.ratio_weight]
    strengths += [priors.lobe_weight, priors.facing_weight, priors.s_weight]
    parts = [obs.images.flatten(1), obs.s.flatten(1), weight.flatten(1), torch.stack(strengths, 1)]
    return torch.cat([part.T for part in (*parts, priors.lobe, priors.facing)])


def read_data(maps: Float[Tensor, "rows pixels"], form: Form) -> Data:
    """`pack_data` undone."""
    C, n = form.channels, form.lights
    images, s, weight = (maps[i * C * n : (i + 1) * C * n].unflatten(0, (C, n)).unbind(1) for i in range(3))
    rest = maps[3 * C * n :].unbind(0)
    return Data(images, s, weight, *rest[:6], lobe=rest[6:9], facing=rest[9:])


def read_place(rows: Float[Tensor, "P pixels"], data: Data, form: Form) -> Place:
    """Unknowns in the solver's order, by name."""
    C = form.channels
    split = lambda part: part.unflatten(0, (C, 3)).unbind(1)  # noqa: E731
    d, log_B = split(rows[: 3 * C]), rows[3 * C]
    B = log_B.exp()
    mean = [over_channels(k) / C for k in d]
    s = split(rows[3 * C + 1 :]) if form.s_free else data.s[:3]
    return Place(d, log_B, s, mean, [B * k for k in mean], B / C)


def pack_system(system: System, form: Form) -> Float[Tensor, "rows pixels"]:
    """As rows of the state."""
    channels = [*system.D, *system.N, *system.by_d, *system.tie_d]
    if form.s_free:
        channels += [*system.S, *(k for row in system.X for k in row), *system.by_s, *system.tie_s]
    single = [*system.T, *system.by_z, *system.e, system.shape, system.ratio]
    return torch.cat([torch.stack(channels).flatten(0, 1), torch.stack(single)])


def read_system(rows: Float[Tensor, "rows pixels"], form: Form) -> System:
    """`pack_system` undone."""
    of_channels = len(rows) - 14
    lines = iter(rows[:of_channels].unflatten(0, (-1, form.channels)).unbind(0))
    take = lambda number: [next(lines) for _ in range(number)]  # noqa: E731
    D, N, by_d, tie_d = take(6), take(6), take(3), take(3)
    S, X, by_s, tie_s = (take(6), [take(3) for _ in range(3)], take(3), take(3)) if form.s_free else ([], [], [], [])
    single = rows[of_channels:].unbind(0)
    return System(D, N, by_d, tie_d, S, X, by_s, tie_s, single[:6], single[6:9], single[9:12], *single[12:])


def over_channels(line: Float[Tensor, "channels pixels"]) -> Float[Tensor, "pixels"]:
    """Sum over the channels."""
    return added(line.unbind(0))


def added(terms: Sequence[Line]) -> Line:
    """Sum."""
    return sum(terms[1:], terms[0])


def dot(a: Sequence[Line], b: Sequence[Line]) -> Line:
    """Sum of products."""
    return added([x * y for x, y in zip(a, b, strict=True)])


def plus(*terms: Sequence[Line]) -> list[Line]:
    """Sum of triples or squares."""
    return [added(entries) for entries in zip(*terms, strict=True)]


def times(matrix: Square, v: Triple) -> list[Line]:
    """Product of a symmetric matrix and a vector."""
    return [dot([matrix[AT[i][k]] for k in range(3)], v) for i in range(3)]


def transposed_times(columns: Sequence[Triple], v: Triple) -> list[Line]:
    """Products of a matrix's columns, given as its rows' entries, with a vector."""
    return [dot([row[k] for row in columns], v) for k in range(3)]


def squares(rows: Sequence[Triple], weights: Sequence[Line]) -> list[Line]:
    """sum_j w_j A_j A_j^T."""
    return [dot([row[i] * row[k] for row in rows], weights) for i in range(3) for k in range(i, 3)]


def linearised(at: Place, data: Data, constants: Constants, form: Form) -> tuple[Line, System]:
    """Cost, gradient and matrix at some place."""
    A, measured = constants.A, data.s[:3]
    u = [dot(row, plus(constants.a, at.z)) for row in A]
    if form.ggx:
        lobes = [ggx_with_slope(u_j, constants.n_s, constants.crest) for u_j in u]
    else:
        lobes = [power_with_slope(u_j, constants.n_s) for u_j in u]
    width = constants.softness * (added(measured) / 3.0).clamp_min(0.0)
    moved = [d + (s - m) for d, s, m in zip(at.d, at.s, measured, strict=True)] if form.s_free else at.d
    costs, pull_d, square_d, cross, pull_z, square_z = [], [], [], [], [], []
    for j, (shine, by_u) in enumerate(lobes):
        root = data.s[j] + dot(A[j], moved)
        length = (root * root + width * width + torch.finfo(root.dtype).tiny).sqrt()
        body = 0.5 * (root + length)
        by_root = body / length
        if form.power:
            lit = body > 0
            body = torch.where(lit, torch.where(lit, body, 1.0) ** constants.n_d, 0.0)
            by_root = constants.n_d * body / length
        off = body + shine - data.images[j]
        # A clipped value that the model exceeds costs nothing and pulls nowhere.
        weight = torch.where((data.weight[j] < 0) & (off > 0), 0.0, data.weight[j].abs())
        r, p, f = weight * off, weight * by_root, weight * by_u
        w = (constants.robust / r.abs().clamp_min(torch.finfo(r.dtype).tiny)).clamp_max(1.0)
        wr, wp, wf = w * r, w * p, w * f
        costs.append(over_channels(wr * (r - 0.5 * wr)))
        pull_d.append(wr * p)
        square_d.append(wp * p)
        cross.append(wp * f)
        pull_z.append(over_channels(wr * f))
        square_z.append(over_channels(wf * f))
    M, by_root = squares(A, square_d), transposed_times(A, pull_d)
    lobe_cost, lobe_pull, lobe_square = lobe_rows(at.z, data, constants)
    shape, slope = shape_row(at, constants, form)
    shape, e = constants.shape * shape, [constants.shape / form.channels * k for k in slope]
    own_cost, ratio, own = scattering_rows(at, data, form)
    system = System(
        D=plus(M, own.D),
        N=squares(A, cross),
        by_d=plus(by_root, own.by_d),
        tie_d=own.tie_d,
        S=plus(M, own.S) if form.s_free else [],
        X=[plus([M[AT[i][k]] for k in range(3)], own.X[i]) for i in range(3)] if form.s_free else [],
        by_s=plus(by_root, own.by_s) if form.s_free else [],
        tie_s=own.tie_s,
        T=plus(squares(A, square_z), lobe_square),
        by_z=plus(transposed_times(A, pull_z), lobe_pull),
        e=e,
        shape=shape,
        ratio=ratio,
    )
    return added(costs) + lobe_cost + own_cost + 0.5 * shape * shape, system


def lobe_rows(z: Triple, data: Data, constants: Constants) -> tuple[Line, Triple, Square]:
    """The rows lobe and facing: cost, gradient and matrix of z."""
    C_2, direction = constants.log_C_2.exp(), data.facing
    v = [k / C_2 for k in z]
    lobe = [data.lobe_weight * (v[k] - data.lobe[k]) for k in range(3)]
    on = dot(v, direction)
    facing = [data.facing_weight * (v[k] - on * direction[k]) for k in range(3)]
    left = dot(facing, direction)
    near, turned = data.lobe_weight / C_2, data.facing_weight / C_2
    # The square of the projection, whose direction is of unit length, or none.
    once = turned * turned * (2.0 - dot(direction, direction))
    both = near * near + turned * turned
    pull = [near * lobe[k] + turned * (facing[k] - left * direction[k]) for k in range(3)]
    square = [(both if i == k else 0.0) - once * direction[i] * direction[k] for i in range(3) for k in range(i, 3)]
    return 0.5 * (dot(lobe, lobe) + dot(facing, facing)), pull, square


def shape_row(at: Place, constants: Constants, form: Form) -> tuple[Line, Triple]:
    """The row shape without its weight, and its slope by mean_c d (`log_shape` and `shape_slope`)."""
    if not form.lights_known:
        middle = added(at.mean) / 3.0
        length = (middle * middle + 1e-8).sqrt()
        slope = 1.0 / (3.0 * length)
        return at.log_B + (0.5 * (middle + length)).log() - constants.log_C_2, [slope] * 3
    M, view = constants.normal_map, constants.view
    g = [dot(row, at.mean) for row in M]
    size, facing = dot(g, g) + 1e-6, dot(view, g)
    length = (facing * facing + 1e-6).sqrt()
    row = at.log_B + size.log() - (0.5 * (facing + length)).log() - constants.log_C_2
    return row, transposed_times(M, [2.0 * g[k] / size - view[k] / length for k in range(3)])


@dataclass(frozen=True)
class OfScattering:
    """What the rows parallel, ratio and measured say, by the names of `System`."""

    D: Square
    by_d: Triple
    tie_d: Triple
    S: Square
    X: Sequence[Triple]
    by_s: Triple
    tie_s: Triple


def scattering_rows(at: Place, data: Data, form: Form) -> tuple[Line, Line, OfScattering]:
    """Cost of the rows parallel, ratio and measured; the row ratio; and the others' gradient and matrix."""
    d, s, measured = at.d, at.s, data.s[:3]
    firm, known, tie = data.parallel * data.parallel, data.s_weight * data.s_weight, data.ratio_weight / form.channels
    whole, size = plus(d, s), dot(s, s)
    power = size + 1e-9
    along = dot(whole, s) / power
    rest, less = [whole[k] - along * s[k] for k in range(3)], 1.0 - along
    left, kept = dot(rest, s), size / power
    on_d, on_s = [k / power for k in s], [(rest[k] + less * s[k]) / power for k in range(3)]
    ratio = data.ratio_weight * (over_channels(along) / form.channels - data.ratio)
    cost = 0.5 * firm * over_channels(dot(rest, rest)) + 0.5 * ratio * ratio
    upper = [(i, k) for i in range(3) for k in range(i, 3)]
    D = [(firm if i == k else 0.0) - firm * (2.0 - kept) * on_d[i] * s[k] for i, k in upper]
    by_d = [firm * (rest[k] - left * on_d[k]) for k in range(3)]
    tie_d, tie_s = [tie * k for k in on_d], [tie * k for k in on_s]
    if not form.s_free:
        return cost, ratio, OfScattering(D, by_d, tie_d, [], [], [], [])
    away = [s[k] - measured[k] for k in range(3)]
    ss = lambda i, k: size * on_s[i] * on_s[k] - less * (s[i] * on_s[k] + s[k] * on_s[i])  # noqa: E731
    sd = lambda i, k: -(s[i] * less * on_d[k]) - (1.0 - kept) * on_s[i] * s[k]  # noqa: E731
    S = [firm * (ss(i, k) + less * less) + known if i == k else firm * ss(i, k) for i, k in upper]
    X = [[firm * (sd(i, k) + less) if i == k else firm * sd(i, k) for k in range(3)] for i in range(3)]
    by_s = [firm * (less * rest[k] - left * on_s[k]) + known * away[k] for k in range(3)]
    cost = cost + 0.5 * known * over_channels(dot(away, away))
    return cost, ratio, OfScattering(D, by_d, tie_d, S, X, by_s, tie_s)
