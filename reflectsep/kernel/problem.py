"""Eqs. 20 to 22 for many pixels, channel first: one map a picture, a root or an unknown.

    x_j = A_j (d + s),   u_j = A_j (a + B d),   r_j = (x_j)_+^n_d + (u_j)_+^n_s - I_j       l = (d_1, d_2, d_3, log B)

    cost = 1/2 sum_j lambda_j w_j^2 r_j^2  +  1/2 sum_k p_k (l_k - c_k)^2

    dr_j/dd_k = A_jk q_j,   q_j = n_d (x_j)_+^(n_d - 1) + f_j,   f_j = B n_s (u_j)_+^(n_s - 1)
    dr_j/dlog B = f_j y_j,  y_j = A_j d            dr_j/da_k = A_jk f_j / B        dr_j/dn_s = (u_j)_+^n_s log u_j

Everything is pointwise, so that a compiler makes one loop of it and neither r nor its derivatives are ever stored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

UNKNOWNS = ("d_1", "d_2", "d_3", "log_B")
SHARED = ("a_1", "a_2", "a_3", "n_s")
INFINITE = float("inf")
LEAST = 1e-30
"""Stands for 0 under a logarithm."""


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """Ends of the four unknowns; infinite where there is none."""

    lower: tuple[float, float, float, float] = (-INFINITE, -INFINITE, -INFINITE, -7.0)
    upper: tuple[float, float, float, float] = (INFINITE, INFINITE, INFINITE, 7.0)


@dataclass(frozen=True, kw_only=True)
class Form:
    """What the compiled code depends on; everything else is data."""

    lights: int
    own_s: bool
    """Every light has a root of its own; else the basis lights' are mixed."""
    power: bool
    """n_d differs from 1."""
    weighted: bool
    priors: bool
    bounds: Bounds

    @property
    def rows(self) -> int:
        """Maps of data a pixel."""
        return self.lights * (2 if self.weighted else 1) + (self.lights if self.own_s else 3) + 8 * self.priors


@dataclass(frozen=True, kw_only=True)
class Lobe:
    """The globals of Eqs. 20 and 21."""

    a: Float[Tensor, "3"]
    """C_1 L_k . V of the basis lights; negative for a forward lobe."""
    n_s: float
    n_d: float = 1.0

    @property
    def shared(self) -> Float[Tensor, "4"]:
        """(a_1, a_2, a_3, n_s)."""
        return torch.cat([self.a, self.a.new_tensor([self.n_s])])

    def moved(self, shared: Float[Tensor, "4"]) -> Lobe:
        """With other shared unknowns."""
        return replace(self, a=shared[:3], n_s=float(shared[3]))


@dataclass(frozen=True, kw_only=True)
class PixelPrior:
    """Diagonal Gaussian terms."""

    centre: Float[Tensor, "4 pixels"]
    weight: Float[Tensor, "4 pixels"]
    """p_k: inverse variance; 0 for none."""


@dataclass(frozen=True, kw_only=True)
class PixelProblem:
    """The pictures of many pixels and what is known of them."""

    images: Float[Tensor, "lights pixels"]
    s: Float[Tensor, "roots pixels"]
    """Scattering roots of the three basis lights, or of every light."""
    alpha: Float[Tensor, "lights 3"]
    """A; its first three rows are the identity."""
    light_weight: Float[Tensor, "lights"]
    """lambda_j of Eq. 22."""
    weight: Float[Tensor, "lights pixels"] | None = None
    """w_j of single values, e.g. 0 where masked; None: all 1."""
    prior: PixelPrior | None = None
    bounds: Bounds = Bounds()

    def __len__(self) -> int:
        """Number of pixels."""
        return self.images.shape[1]

    def take(self, index: slice | Int[Tensor, "some"]) -> PixelProblem:
        """Some of the pixels."""
        prior = self.prior
        if prior is not None:
            prior = PixelPrior(centre=prior.centre[:, index], weight=prior.weight[:, index])
        weight = None if self.weight is None else self.weight[:, index]
        return replace(self, images=self.images[:, index], s=self.s[:, index], weight=weight, prior=prior)

    def form(self, n_d: float) -> Form:
        """What the code for this problem depends on."""
        return Form(
            lights=len(self.images),
            own_s=len(self.s) != 3,
            power=n_d != 1.0,
            weighted=self.weight is not None,
            priors=self.prior is not None,
            bounds=self.bounds,
        )

    @property
    def maps(self) -> list[Float[Tensor, "rows pixels"]]:
        """All data of a pixel, in the order of `read_data`."""
        maps = [self.images, self.s]
        if self.weight is not None:
            maps.append(self.weight)
        if self.prior is not None:
            maps += [self.prior.centre, self.prior.weight]
        return maps


@dataclass(frozen=True)
class Data:
    """Maps of single pixels by name."""

    images: Sequence[Tensor]
    s: Sequence[Tensor]
    weight: Sequence[Tensor] | None
    centre: Sequence[Tensor]
    prior: Sequence[Tensor]


@dataclass(frozen=True)
class Constants:
    """Numbers that all pixels share, each a tensor without dimensions."""

    alpha: Sequence[Sequence[Tensor]]
    """Rows of the lights beyond the basis."""
    a: Sequence[Tensor]
    """A a, of every light."""
    light_weight: Sequence[Tensor]
    n_s: Tensor
    n_d: Tensor


@dataclass(frozen=True)
class Quadratic:
    """Cost, gradient and Gauss-Newton matrix of every pixel at some l."""

    cost: Tensor
    gradient: list[Tensor]
    V: list[Tensor]


def pack_constants(problem: PixelProblem, lobe: Lobe) -> Float[Tensor, "constants"]:
    """As one tensor: few arguments make a cheap call."""
    alpha = problem.alpha.to(problem.images)
    ends = problem.images.new_tensor([lobe.n_s, lobe.n_d])
    return torch.cat([alpha[3:].flatten(), alpha @ lobe.a.to(alpha), problem.light_weight.to(alpha), ends])


def read_constants(packed: Tensor, form: Form) -> Constants:
    """`pack_constants` undone."""
    n, values = form.lights, packed.unbind(0)
    mixed = 3 * (n - 3)
    alpha = [values[3 * j : 3 * j + 3] for j in range(n - 3)]
    return Constants(alpha, values[mixed : mixed + n], values[mixed + n : mixed + 2 * n], *values[mixed + 2 * n :])


def read_data(maps: Sequence[Tensor], form: Form) -> Data:
    """Maps in the order of `PixelProblem.maps`, by name."""
    n, roots = form.lights, form.lights if form.own_s else 3
    rest = maps[n + roots :]
    weight = rest[:n] if form.weighted else None
    rest = rest[n:] if form.weighted else rest
    return Data(maps[:n], maps[n : n + roots], weight, rest[:4], rest[4:])


def mixed(row: Sequence[Tensor], maps: Sequence[Tensor]) -> Tensor:
    """A_j1 m_1 + A_j2 m_2 + A_j3 m_3."""
    return row[0] * maps[0] + row[1] * maps[1] + row[2] * maps[2]


@dataclass(frozen=True)
class Value:
    """One picture of every pixel, with its slopes."""

    r: Tensor
    q: Tensor
    f: Tensor
    y: Tensor
    shine: Tensor
    log_u: Tensor


def value_of(j: int, d: Sequence[Tensor], B: Tensor, data: Data, constants: Constants, form: Form) -> Value:
    """R_j, q_j, f_j and y_j of the module's head."""
    y = d[j] if j < 3 else mixed(constants.alpha[j - 3], d)
    root = y + (data.s[j] if j < 3 or form.own_s else mixed(constants.alpha[j - 3], data.s))
    u = constants.a[j] + B * y
    log_u = u.clamp_min(LEAST).log()
    power = ((constants.n_s - 1.0) * log_u).exp()
    shine = power * u.clamp_min(0.0)
    f = constants.n_s * power * B
    lit = root.clamp_min(0.0)
    if form.power:
        narrow = torch.where(root > 0, ((constants.n_d - 1.0) * root.clamp_min(LEAST).log()).exp(), 0.0)
        body, slope = narrow * lit, constants.n_d * narrow
    else:
        body, slope = lit, torch.where(root > 0, 1.0, 0.0)
    return Value(body + shine - data.images[j], slope + f, f, y, shine, log_u)


def weight_of(j: int, data: Data, constants: Constants) -> Tensor:
    """lambda_j w_j^2."""
    weight = constants.light_weight[j]
    return weight if data.weight is None else weight * data.weight[j] * data.weight[j]


def quadratic(x: Sequence[Tensor], data: Data, constants: Constants, form: Form) -> Quadratic:
    """Cost, J^T w r and J^T w J at x: one and four and ten maps."""
    zero = torch.zeros_like(x[0])
    cost, g, V = zero, [zero] * 4, [zero] * 10
    if form.priors:
        for k, at in enumerate((0, 4, 7, 9)):
            away = x[k] - data.centre[k]
            g[k], V[at] = data.prior[k] * away, data.prior[k]
            cost = cost + g[k] * away
    B = x[3].exp()
    for j in range(form.lights):
        v = value_of(j, x[:3], B, data, constants, form)
        w = weight_of(j, data, constants)
        wr, wq, fy = w * v.r, w * v.q, v.f * v.y
        square, cross, pull = wq * v.q, wq * fy, v.q * wr
        cost = cost + wr * v.r
        g[3] = g[3] + fy * wr
        V[9] = V[9] + w * fy * fy
        if j < 3:
            g[j], V[(0, 4, 7)[j]], V[(3, 6, 8)[j]] = g[j] + pull, V[(0, 4, 7)[j]] + square, V[(3, 6, 8)[j]] + cross
            continue
        row = constants.alpha[j - 3]
        for k, (at, border) in enumerate(((0, 3), (4, 6), (7, 8))):
            g[k] = g[k] + row[k] * pull
            V[at] = V[at] + row[k] * row[k] * square
            V[border] = V[border] + row[k] * cross
        for at, i, k in ((1, 0, 1), (2, 0, 2), (5, 1, 2)):
            V[at] = V[at] + row[i] * row[k] * square
    return Quadratic(0.5 * cost, g, V)
