"""Cost, gradient and Gauss-Newton matrix of every pixel, put together from their parts: its Jacobian is never formed.

In the symbols of `fit/derivatives.py`, with z = B mean_c d, of which alone the lobe is a function, and with the
pictures' weights in P' and F' and Huber's in w:

    M_c = sum_j w P'_cj^2   A_j A_j^T       of d_c or s_c with d_c or s_c
    N_c = sum_j w P'_cj F'_j A_j A_j^T      of d_c or s_c with z
    T   = sum_cj w F'_j^2   A_j A_j^T       of z with z, to which the lobe's and the facing row add
    dz  = B / C sum_c dd_c + z dlog B

A_j A_j^T are those of all pixels, so that M, N and T are products with one small matrix. In colour a pixel has 44 rows
and 19 unknowns; what is saved is most of the time of a fit. Here pixels come last: every entry of a matrix is a line
of pixels, which the processor takes many at a time.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.fit.derivatives import shape_slope
from reflectsep.fit.problem import (
    LOG_C_2,
    SOFTNESS,
    Observations,
    Priors,
    refined,
    shape_row,
    unpack_globals,
)
from reflectsep.model import diffuse_with_slope, lobe_with_slope
from reflectsep.solve.local import total

Normal = tuple[Float[Tensor, "pixels"], Float[Tensor, "P pixels"], Float[Tensor, "P P pixels"]]


@dataclass(frozen=True)
class Unknowns:
    """A pixel's unknowns, and what was measured of s, pixels last."""

    d: Float[Tensor, "channels 3 pixels"]
    log_B: Float[Tensor, "pixels"]  # noqa: N815
    s: Float[Tensor, "channels 3 pixels"]
    s_measured: Float[Tensor, "channels 3 pixels"]
    s_free: bool
    B: Float[Tensor, "pixels"]
    mean: Float[Tensor, "3 pixels"]
    """Of d over the channels."""

    @property
    def z(self) -> Float[Tensor, "3 pixels"]:
        """B mean_c d."""
        return self.B * self.mean


@dataclass(frozen=True)
class Rows:
    """The pictures' rows and their slopes."""

    r: Float[Tensor, "channels lights pixels"]
    w: Float[Tensor, "channels lights pixels"] | float
    """Huber's weight."""
    pull: Float[Tensor, "channels lights pixels"]
    """The picture's own weight; 0 where a value neither costs nor pulls."""
    p: Float[Tensor, "channels lights pixels"]
    f: Float[Tensor, "channels lights pixels"]
    """P' and F', weighted by `pull`."""
    root: Float[Tensor, "channels lights pixels"]
    width: Float[Tensor, "channels 1 pixels"]
    u: Float[Tensor, "lights pixels"]


@dataclass(frozen=True)
class OfPictures:
    """What the pictures say."""

    cost: Float[Tensor, "pixels"]
    by_root: Float[Tensor, "channels 3 pixels"]
    """Gradient by d_c or s_c, but for the lobe's part."""
    by_z: Float[Tensor, "3 pixels"]
    M: Float[Tensor, "channels 3 3 pixels"]
    N: Float[Tensor, "channels 3 3 pixels"]
    T: Float[Tensor, "3 3 pixels"]


@dataclass(frozen=True)
class OfLobe:
    """What the rows say that compare z / C_2 with the neighbourhood."""

    cost: Float[Tensor, "pixels"]
    by_z: Float[Tensor, "3 pixels"]
    T: Float[Tensor, "3 3 pixels"]
    by_crest: Float[Tensor, "pixels"]
    """As log C_2, and the crest with it, moves z / C_2: the gradient, its product with itself, and with z."""
    of_crest_twice: Float[Tensor, "pixels"]
    z_with_crest: Float[Tensor, "3 pixels"]


@dataclass(frozen=True)
class OfShape:
    """The row that compares B with its value by the lobe's geometry."""

    row: Float[Tensor, "pixels"]
    by_d: Float[Tensor, "3 pixels"]
    """By any d_c."""
    weight: float
    """Its slope by log B, and less that by log C_2."""


@dataclass(frozen=True)
class OfScattering:
    """What the rows say that compare d and s, channel by channel."""

    cost: Float[Tensor, "pixels"]
    by_d: Float[Tensor, "channels 3 pixels"]
    by_s: Float[Tensor, "channels 3 pixels"]
    dd: Float[Tensor, "channels 3 3 pixels"]
    sd: Float[Tensor, "channels 3 3 pixels"]
    ss: Float[Tensor, "channels 3 3 pixels"]
    ratio_d: Float[Tensor, "channels 3 pixels"]
    """Of the row that alone ties channels together, by d."""
    ratio_s: Float[Tensor, "channels 3 pixels"]


def normal_equations(local: Tensor, shared: Tensor, obs: Observations, priors: Priors, robust: float | None) -> Normal:
    """Cost, J^T w r and J^T w J of every pixel; of the matrix only the lower triangle is filled in.

    `robust` is the Huber threshold of the pictures' rows in standard deviations.
    """
    obs = refined(obs, shared)
    x = unknowns(local, obs)
    rows = rows_of(x, shared, obs, robust)
    return put_together(
        x, rows, obs.alpha, priors, (lobe_rows(x, shared, priors), shape_row_of(x, shared, obs, priors))
    )


def put_together(
    x: Unknowns, rows: Rows, A: Float[Tensor, "lights 3"], priors: Priors, known: tuple[OfLobe, OfShape]
) -> Normal:
    """The same, from rows."""
    lobe, shape = known
    seen, own = of_pictures(rows, A), of_scattering(x, priors)
    by_z = seen.by_z + lobe.by_z
    share, three = x.B / len(x.d), 3 * len(x.d)
    P = three * (2 if x.s_free else 1) + 1
    gradient = x.d.new_empty(P, x.d.shape[-1])
    by_d = own.by_d + seen.by_root + share * by_z + shape.row * shape.by_d
    gradient[:three] = by_d.flatten(0, 1)
    gradient[three] = total(by_z * x.z) + shape.row * shape.weight
    if x.s_free:
        gradient[three + 1 :] = (own.by_s + seen.by_root).flatten(0, 1)
    cost = seen.cost + own.cost + lobe.cost + 0.5 * shape.row.square()
    return cost, gradient, matrix(x, seen, own, seen.T + lobe.T, shape)


def unknowns(local: Tensor, obs: Observations) -> Unknowns:
    """Of rows of unknowns, one a pixel."""
    rows, three = local.T.contiguous(), 3 * obs.channels
    split = lambda part: part.unflatten(0, (obs.channels, 3))  # noqa: E731
    d, measured, s_free = split(rows[:three]), last(obs.s_basis), len(rows) > three + 1
    s = split(rows[three + 1 :]) if s_free else measured
    return Unknowns(d, rows[three], s, measured, s_free, rows[three].exp(), total(d) / len(d))


def last(values: Float[Tensor, "pixels ..."]) -> Float[Tensor, "... pixels"]:
    """The same, pixels last in memory too."""
    return values.movedim(0, -1).contiguous()


def rows_of(x: Unknowns, shared: Tensor, obs: Observations, robust: float | None) -> Rows:
    """The pictures, weighted."""
    g, A = unpack_globals(shared, obs.n_d), obs.alpha
    width = shared[SOFTNESS] * (total(x.s_measured, 1) / 3.0).clamp_min(0.0)[:, None]
    root = last(obs.s) + mixed(A, x.d + (x.s - x.s_measured) if x.s_free else x.d)
    u = mixed(A, g.a[:, None] + x.z)
    body, by_root = diffuse_with_slope(root, width, g.n_d)
    shine, by_u = lobe_with_slope(u, g.n_s, g.crest)
    pull = last(obs.weight)
    r, w = (body + shine - last(obs.images)) * pull, 1.0
    if bool(obs.clipped.any()):
        # A clipped value that the model exceeds costs nothing and pulls nowhere.
        exceeds = last(obs.clipped) & (r > 0)
        r, pull = torch.where(exceeds, 0.0, r), torch.where(exceeds, 0.0, pull)
    if robust is not None:
        w = (robust / r.abs().clamp_min(torch.finfo(r.dtype).tiny)).clamp_max(1.0)
    return Rows(r=r, w=w, pull=pull, p=pull * by_root, f=pull * by_u, root=root, width=width, u=u)


def of_pictures(rows: Rows, A: Float[Tensor, "lights 3"]) -> OfPictures:
    """The pictures alone."""
    wr, wp, wf = rows.w * rows.r, rows.w * rows.p, rows.w * rows.f
    squares = (A[:, :, None] * A[:, None]).flatten(1)
    square = lambda values: summed(squares, values).unflatten(-2, (3, 3))  # noqa: E731
    return OfPictures(
        cost=total((wr * (rows.r - 0.5 * wr)).flatten(0, 1)),
        by_root=summed(A, wr * rows.p),
        by_z=summed(A, total(wr * rows.f)),
        M=square(wp * rows.p),
        N=square(wp * rows.f),
        T=square(total(wf * rows.f)),
    )


def mixed(A: Float[Tensor, "lights 3"], x: Float[Tensor, "*channels 3 pixels"]) -> Tensor:
    """A x. No product of matrices, whose rounding goes by the number of pixels: a pixel's result is its own."""
    k = [x[..., i, None, :] * A[:, i, None] for i in range(3)]
    return k[0] + k[1] + k[2]


def summed(factors: Float[Tensor, "lights n"], values: Float[Tensor, "*channels lights pixels"]) -> Tensor:
    """Sum over the lights of a light's factors times its values, (..., n, pixels), likewise."""
    total = factors[0, :, None] * values[..., :1, :]
    for j in range(1, len(factors)):
        total.addcmul_(factors[j, :, None], values[..., j : j + 1, :])
    return total


def outer(a: Float[Tensor, "*channels 3 pixels"], b: Float[Tensor, "*channels 3 pixels"]) -> Tensor:
    """A b^T."""
    return a[..., :, None, :] * b[..., None, :, :]


def add_to_diagonal(matrix: Float[Tensor, "*channels n n pixels"], values: Tensor) -> None:
    """Add `values` to all entries of the diagonal."""
    matrix.diagonal(dim1=-3, dim2=-2).add_(values[..., None])


def lobe_rows(x: Unknowns, shared: Tensor, priors: Priors) -> OfLobe:
    """The rows lobe and facing."""
    C_2, direction = shared[LOG_C_2].exp(), last(priors.facing)
    v = x.z / C_2
    across = lambda v: v - total(v * direction) * direction  # noqa: E731
    lobe = priors.lobe_weight * (v - last(priors.lobe))
    off = across(v)
    facing = priors.facing_weight * off
    near, turned = priors.lobe_weight / C_2, priors.facing_weight / C_2
    # The square of the projection, whose direction is of unit length, or none.
    once = turned.square() * (2.0 - total(direction.square())) * direction
    T = -outer(once, direction)
    add_to_diagonal(T, near.square() + turned.square())
    moved = priors.lobe_weight * v
    return OfLobe(
        cost=0.5 * total(lobe.square() + facing.square()),
        by_z=near * lobe + turned * across(facing),
        T=T,
        by_crest=-total(moved * lobe + facing.square()),
        of_crest_twice=total(moved.square() + facing.square()),
        z_with_crest=-near * moved - turned * across(facing),
    )


def shape_row_of(x: Unknowns, shared: Tensor, obs: Observations, priors: Priors) -> OfShape:
    """The row shape."""
    row = priors.shape * shape_row(x.log_B, x.mean.T, shared, obs)
    return OfShape(row, priors.shape / obs.channels * shape_slope(x.mean.T, obs).T, priors.shape)


def of_scattering(x: Unknowns, priors: Priors) -> OfScattering:
    """The rows parallel, ratio and measured."""
    s, whole = x.s, x.d + x.s
    square = total(s.square(), 1)[:, None]
    power = square + 1e-9
    along = total(whole * s, 1)[:, None] / power
    rest, less = whole - along * s, 1.0 - along
    left = total(rest * s, 1)[:, None]
    # Slopes of `along`; those of `rest` are I - s by_d^T and (1 - along) I - s by_s^T.
    by_d, by_s = s / power, (rest + less * s) / power
    firm, tie = priors.parallel.square(), priors.ratio_weight / len(s)
    off = priors.ratio_weight * (total(along[:, 0]) / len(s) - priors.ratio)
    cost = 0.5 * firm * total(rest.square().flatten(0, 1)) + 0.5 * off.square()
    ratio_d, ratio_s = tie * by_d, tie * by_s
    pulled = firm * (rest - left * by_d) + off * ratio_d
    dd = -outer(firm * (2.0 - square / power) * by_d, s)
    add_to_diagonal(dd, firm.expand_as(along[:, 0]))
    if not x.s_free:
        return OfScattering(cost, pulled, pulled, dd, dd, dd, ratio_d, ratio_s)
    known, moved = priors.s_weight.square(), s - x.s_measured
    sd = -outer(firm * s, less * by_d) - outer(firm * (1.0 - square / power) * by_s, s)
    add_to_diagonal(sd, firm * less[:, 0])
    turned = outer(firm * less * s, by_s)
    ss = outer(firm * square * by_s, by_s) - turned - turned.transpose(1, 2)
    add_to_diagonal(ss, firm * less[:, 0].square() + known)
    return OfScattering(
        cost=cost + 0.5 * known * total(moved.square().flatten(0, 1)),
        by_d=pulled,
        by_s=firm * (less * rest - left * by_s) + off * ratio_s + known * moved,
        dd=dd,
        sd=sd,
        ss=ss,
        ratio_d=ratio_d,
        ratio_s=ratio_s,
    )


def matrix(
    x: Unknowns, seen: OfPictures, own: OfScattering, T: Float[Tensor, "3 3 pixels"], shape: OfShape
) -> Float[Tensor, "P P pixels"]:
    """The lower triangle of J^T w J, with all that falls on z in T."""
    channels = len(x.d)
    three, P = 3 * channels, 3 * channels * (2 if x.s_free else 1) + 1
    V = x.d.new_zeros(P, P, x.d.shape[-1])
    d, s = slice(0, three), slice(three + 1, None)
    blocks = lambda rows, columns: V[rows, columns].unflatten(1, (channels, 3)).unflatten(0, (channels, 3))  # noqa: E731
    share = x.B / channels
    moved, turned = share * seen.N, total(T * x.z, 1)
    lobe = total(seen.N * x.z, 2)
    # Every d moves z and the shape, so that any two channels meet there: N of the one and of the other, and T.
    half = moved + 0.5 * (share.square() * T + outer(shape.by_d, shape.by_d))
    tie_d, tie_s = own.ratio_d.flatten(0, 1), own.ratio_s.flatten(0, 1)
    torch.mul(tie_d[:, None], tie_d, out=V[d, d])
    dd = blocks(d, d)
    dd += half[:, :, None]
    dd += half.transpose(0, 1)
    for c in range(channels):
        dd[c, :, c] += seen.M[c] + own.dd[c]
    V[three, d] = (lobe + share * turned + shape.weight * shape.by_d).flatten(0, 1)
    V[three, three] = total(turned * x.z) + shape.weight**2
    if x.s_free:
        V[s, three] = lobe.flatten(0, 1)
        torch.mul(tie_s[:, None], tie_d, out=V[s, d])
        torch.mul(tie_s[:, None], tie_s, out=V[s, s])
        sd, ss = blocks(s, d), blocks(s, s)
        sd += moved[:, :, None]
        for c in range(channels):
            sd[c, :, c] += seen.M[c] + own.sd[c]
            ss[c, :, c] += seen.M[c] + own.ss[c]
    return V
