"""The reflectance model: Eqs. 14, 17, 20 and 21 of Wu & Tang (ECCV 2004), and what is added to them. No solver.

    I_j = t_j [ (q T(x_j / q)) ^ n_d  +  F(u_j) ]        x = A (d + s),    u = A (a + B (d + (1 - f) s))

A is `alpha`, one row a light, for lights of unit intensity; its first three rows are the identity, so that Eqs. 20 and
21 are one formula. t_j is the light's intensity: light adds in radiance, so it scales the picture and stays outside the
powers. With f = 1, T(c) = max(c, 0) and F(u) = max(u, 0) ^ n_s this is the paper; with s = 0 it is Lin & Lee's model.

What is added, each a global that is fitted:

* f says how far scattered light has forgotten the normal. At f = 1 the lobe turns with d alone, at f = 0 with d + s.
* d is signed: negative where a patch faces away from a basis light. T clamps inside the formula, so that the other
  lights determine d there.
* T(c) = y (1 - k (1 - y)^5), y = (c + sqrt(c^2 + e^2)) / 2, with c the cosine between light and normal and
  q = |M (d + s)|. k is the share of Schlick's (1994) Fresnel term that the body obeys: what the boundary reflects at
  grazing angles does not enter. e is the softness of a shadow's edge, in units of the cosine: a translucent body is lit
  a little beyond its terminator.
* F is the distribution of GGX microfacets (Walter et al., EGSR 2007) about the mirror direction. With w = M (a + B m),
  m the mean of d + (1 - f) s over the channels, light at the angle t from the mirror direction has cos t = u / |w| and

      F = |w|^n_s [ (1 + n_s (1 - cos t) / 2)^-2 - (1 + n_s / 2)^-2 ]_+          n_s = 1 / roughness^2 - 1

  The paper's lobe is |w|^n_s cos^n_s t in the same terms: |w|^n_s is the height of the highlight, w / |w| its
  direction. B moves both, which the power alone hides: with n_s = 30 an error of 3 % in |w| is a factor of 2.4.

M is the inverse of the basis light directions, so that M x is a vector in space for x = (N.L_1, N.L_2, N.L_3). Where
the directions are unknown M is the identity, c is no cosine, k is 0 and the lobe is the paper's power.

Tensors are laid out with the basis light first, then the channel, then the pixels: d (3, channels, *pixels).
In colour the interface reflects white light, so the lobe is one for all channels.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

Roots = Float[Tensor, "3 channels *pixels"]

TINY = 1e-12
"""Keeps roots differentiable at zero."""


@dataclass(frozen=True, kw_only=True)
class Globals:
    """Parameters that all pixels share."""

    a: Float[Tensor, "3 *pixels"]
    """C_1 L_k . V of the basis lights, negative for a forward lobe; of each pixel where there are several materials."""
    n_s: Float[Tensor, "*pixels"]
    n_d: Float[Tensor, ""] | float
    """A plain number where it is not fitted."""
    f: Float[Tensor, ""]
    """Share of the scattered light that has forgotten the normal; 1 in the paper, 0 in Lin & Lee."""
    softness: Float[Tensor, ""]
    """e: softness of a shadow's edge, in units of the cosine."""
    fresnel: Float[Tensor, ""]
    """k: share of Schlick's Fresnel term that the body obeys, in [0, 1]."""
    ggx: bool
    """Whether the lobe is that of GGX microfacets; else the paper's power."""
    M: Float[Tensor, "3 3"]
    """Inverse of the directions of the basis lights; the identity where they are unknown."""


def positive_power(base: Tensor, exponent: Tensor | float) -> Tensor:
    """max(base, 0) ** exponent with zero value and zero derivatives where base <= 0; exponent > 0."""
    lit = base > 0
    # The untaken branch must be harmless: 0 * inf in its derivative would be NaN.
    return torch.where(lit, torch.where(lit, base, torch.ones_like(base)) ** exponent, torch.zeros_like(base))


def signed_root(values: Tensor, n_d: Tensor | float) -> Tensor:
    """sign(I) |I| ^ (1 / n_d), so that noise around zero stays unbiased in a sum of roots (Eq. 25)."""
    if isinstance(n_d, float) and n_d == 1.0:
        return values
    return values.sign() * values.abs() ** (1.0 / n_d)


def mixed(alpha: Float[Tensor, "lights 3"], x: Float[Tensor, "3 *rest"]) -> Float[Tensor, "lights *rest"]:
    """A x: what every light makes of the values of the basis lights."""
    return torch.tensordot(alpha, x, 1)


def length(M: Float[Tensor, "3 3"], x: Float[Tensor, "3 *rest"]) -> Float[Tensor, "*rest"]:
    """|M x|, never quite zero."""
    return (mixed(M, x).square().sum(0) + TINY).sqrt()


def transmitted(c: Tensor, softness: Tensor, fresnel: Tensor) -> Tensor:
    """T(c): light that enters the body at the cosine c, of that at perpendicular incidence."""
    y = 0.5 * (c + (c.square() + softness.square() + TINY).sqrt())
    return y * (1.0 - fresnel * (1.0 - y.clamp_max(1.0)) ** 5)


def transmitted_with_slope(c: Tensor, softness: Tensor, fresnel: Tensor) -> tuple[Tensor, Tensor]:
    """`transmitted` and its derivative by c."""
    root = (c.square() + softness.square() + TINY).sqrt()
    y = 0.5 * (c + root)
    rest = 1.0 - y.clamp_max(1.0)
    rest4 = rest.square().square()
    entered = 1.0 - fresnel * rest4 * rest
    return y * entered, (entered + 5.0 * fresnel * y * rest4) * (y / root)


def transmitted_by_globals(c: Tensor, softness: Tensor, fresnel: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of `transmitted` by the softness and by Fresnel's share."""
    root = (c.square() + softness.square() + TINY).sqrt()
    y = 0.5 * (c + root)
    rest = 1.0 - y.clamp_max(1.0)
    rest4 = rest.square().square()
    by_y = 1.0 - fresnel * rest4 * rest + 5.0 * fresnel * y * rest4
    return by_y * 0.5 * softness / root, -y * rest4 * rest


def diffuse(x: Float[Tensor, "lights *rest"], q: Float[Tensor, "*rest"], shared: Globals) -> Tensor:
    """Whole diffuse picture from the mixed root x = A (d + s) and q = |M (d + s)| (Eqs. 14 and 16)."""
    lit = q * transmitted(x / q, shared.softness, shared.fresnel)
    plain = isinstance(shared.n_d, float) and shared.n_d == 1.0
    return lit if plain else positive_power(lit, shared.n_d)


def lobe(u: Tensor, size: Tensor, n_s: Tensor, ggx: bool) -> Tensor:
    """Off-specular value F of the lobe's argument u, with `size` = |w| (Eq. 17, or GGX's distribution)."""
    if not ggx:
        return positive_power(u, n_s)
    c = (u / size).clamp_max(1.0)
    value = (1.0 + 0.5 * n_s * (1.0 - c)) ** -2 - (1.0 + 0.5 * n_s) ** -2
    return size**n_s * torch.where(c > 0, value, torch.zeros_like(value))


def lobe_with_slopes(u: Tensor, size: Tensor, n_s: Tensor, ggx: bool) -> tuple[Tensor, Tensor, Tensor]:
    """`lobe` and its derivatives by u and by `size`."""
    if not ggx:
        value = positive_power(u, n_s)
        return value, n_s * value / torch.where(u > 0, u, 1.0), torch.zeros_like(u)
    c = u / size
    inside = (c > 0) & (c < 1.0)
    base = 1.0 / (1.0 + 0.5 * n_s * (1.0 - c.clamp(0.0, 1.0)))
    height = size**n_s
    value = torch.where(c > 0, height * (base.square() - (1.0 + 0.5 * n_s) ** -2), 0.0)
    by_c = torch.where(inside, height * n_s * base.square() * base, 0.0)
    return value, by_c / size, (n_s * value - c * by_c) / size


def lobe_by_exponent(u: Tensor, size: Tensor, n_s: Tensor, ggx: bool) -> Tensor:
    """Derivative of `lobe` by n_s."""
    if not ggx:
        return positive_power(u, n_s) * torch.where(u > 0, u, 1.0).log()
    c = (u / size).clamp(0.0, 1.0)
    base, least = 1.0 / (1.0 + 0.5 * n_s * (1.0 - c)), 1.0 / (1.0 + 0.5 * n_s)
    slope = size.log() * (base.square() - least.square()) - (1.0 - c) * base**3 + least**3
    return torch.where(u > 0, size**n_s * slope, 0.0)


def lobe_vector(d: Roots, s: Roots, B: Float[Tensor, "*pixels"], shared: Globals) -> Float[Tensor, "3 *pixels"]:
    """A + B m, with m the mean of d + (1 - f) s over the channels (Eq. 18)."""
    m = (d + (1.0 - shared.f) * s).mean(1)
    a = shared.a if shared.a.ndim > 1 else shared.a.view(3, *[1] * B.ndim)
    return a + B * m


def lobe_of(
    v: Float[Tensor, "3 *pixels"],
    shared: Globals,
    alpha: Float[Tensor, "lights 3"],
    ceiling: Tensor | float | None = None,
) -> Float[Tensor, "lights *pixels"]:
    """Off-specular value of every light from the lobe's vector v = a + B m.

    `ceiling` is the largest |w|: where no picture saw the highlight nothing else bounds its height.
    """
    size, u = length(shared.M, v), mixed(alpha, v)
    if ceiling is not None:
        shrunk = (ceiling / size).clamp_max(1.0)
        u, size = u * shrunk, size * shrunk
    return lobe(u, size, shared.n_s, shared.ggx)


def reflectance(
    d: Roots,
    B: Float[Tensor, "*pixels"],
    shared: Globals,
    *,
    s: Roots,
    alpha: Float[Tensor, "lights 3"],
    s_lights: Float[Tensor, "lights channels *pixels"] | None = None,
    ceiling: Tensor | float | None = None,
) -> Float[Tensor, "lights channels *pixels"]:
    """Picture of every light of unit intensity (Eqs. 20 and 21).

    Args:
        d: local diffuse roots of the basis lights.
        B: factor of the lobe.
        shared: the globals.
        s: scattering roots of the basis lights.
        alpha: every light as a mix of the basis lights.
        s_lights: scattering roots of every light, where some have a sweep of their own; None: A s.
        ceiling: largest |w|; None: unbounded.
    """
    x = mixed(alpha, d + s) if s_lights is None else mixed(alpha, d) + s_lights
    body = diffuse(x, length(shared.M, d + s), shared)
    return body + lobe_of(lobe_vector(d, s, B, shared), shared, alpha, ceiling)[:, None]
