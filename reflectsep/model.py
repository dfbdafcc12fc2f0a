"""The reflectance model: Eqs. 14, 17, 20 and 21 of Wu & Tang (ECCV 2004). No solver and no files.

    I_j = t_j [ pos(A_j (d + s)) ^ n_d  +  F(u_j) ],     F(u) = u_+ ^ n_s,     u = A (a + B d)

A is `alpha`, one row a light, for lights of unit intensity; the identity rows are the basis lights, so that Eqs. 20
and 21 are one formula. t_j is the light's intensity: light adds in radiance, so it scales the picture and does not
enter the powers. With a hard clamp (softness 0) this is the paper's formula. The two extensions:

* d is signed, negative where a patch faces away from a basis light, and the clamp inside the formula lets the other
  lights determine it there. In a translucent body the shadow's edge is soft, over a width that grows with the
  scattering: pos(x) = (x + sqrt(x^2 + e^2)) / 2 with e = softness * mean_k s_k.
* The highlight of a rough surface has a core and long tails that no power follows: F may be the distribution of
  GGX microfacets (Walter et al., EGSR 2007) about the same mirror direction. For light at an angle t from it, GGX of
  roughness r is proportional to (1 + n (1 - cos t) / 2)^-2 with n = 1 / r^2 - 1, and u / C is that cosine, C the
  crest: the lobe's argument in the mirror direction. So with the same parameters

      F(u) = C^n_s ((1 + n_s (1 - u / C) / 2)^-2 - (1 + n_s / 2)^-2),   0 < u < C,

  which leaves the crest as u^n_s does, of the same height C^n_s and the same slope; beyond C it goes on as u^n_s.
  Crest 0 stands for the paper's power. No parameter is added.

In colour the interface reflects white light, so the lobe is one for all channels, driven by the mean of d over them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

Roots = Float[Tensor, "*pixels channels 3"]


@dataclass(frozen=True, kw_only=True)
class Globals:
    """Parameters that all pixels share."""

    a: Float[Tensor, "3"]
    """C_1 L_k . V of the basis lights; negative for a forward lobe."""
    n_s: Float[Tensor, ""]
    n_d: Float[Tensor, ""] | float
    """A plain number where it is not fitted."""
    softness: Float[Tensor, ""]
    """Width of the shadow's edge, as a fraction of the mean scattering root."""
    crest: Float[Tensor, ""]
    """C of a GGX lobe; 0: the paper's power."""


def positive_power(base: Tensor, exponent: Tensor | float) -> Tensor:
    """max(base, 0) ** exponent with zero value and zero derivatives where base <= 0; exponent > 0."""
    lit = base > 0
    # The untaken branch must be harmless: 0 * inf in its derivative would be NaN.
    return torch.where(lit, torch.where(lit, base, torch.ones_like(base)) ** exponent, torch.zeros_like(base))


def signed_root(values: Tensor, n_d: Tensor | float) -> Tensor:
    """sign(I) |I| ^ (1 / n_d), so that noise around zero stays unbiased in a sum of roots (Eq. 25)."""
    return values.sign() * values.abs() ** (1.0 / n_d)


def soft_positive(x: Tensor, width: Tensor) -> Tensor:
    """(x + sqrt(x^2 + width^2)) / 2: max(x, 0) with an edge of that width; max(x, 0) itself for width 0."""
    # The tiny term keeps the derivative finite at x = width = 0.
    return 0.5 * (x + (x.square() + width.square() + torch.finfo(x.dtype).tiny).sqrt())


def edge_width(s_basis: Roots, softness: Tensor) -> Float[Tensor, "*pixels channels 1"]:
    """Width of the shadow's edge: softness times the mean scattering root of the basis lights."""
    return softness * s_basis.mean(-1, keepdim=True).clamp_min(0.0)


def diffuse(root: Tensor, width: Tensor, n_d: Tensor | float) -> Tensor:
    """Whole diffuse picture from the mixed root A (d + s) (Eqs. 14 and 16); the number 1.0 saves the power."""
    lit = soft_positive(root, width)
    return lit if isinstance(n_d, float) and n_d == 1.0 else positive_power(lit, n_d)


def diffuse_with_slope(root: Tensor, width: Tensor, n_d: Tensor | float) -> tuple[Tensor, Tensor]:
    """`diffuse` and its derivative by the root."""
    length = (root.square() + width.square() + torch.finfo(root.dtype).tiny).sqrt()
    lit = 0.5 * (root + length)
    if isinstance(n_d, float) and n_d == 1.0:
        return lit, lit / length
    value = positive_power(lit, n_d)
    return value, torch.where(lit > 0, n_d * value / length, 0.0)


def lobe(u: Tensor, n_s: Tensor, crest: Tensor) -> Tensor:
    """Off-specular value of the lobe argument u: Eq. 17, or GGX's where there is a crest."""
    return ggx(u, n_s, crest) if bool(crest > 0) else positive_power(u, n_s)


def ggx(u: Tensor, n_s: Tensor, crest: Tensor) -> Tensor:
    """The lobe of GGX microfacets."""
    v = u / crest
    tail = (1.0 + n_s * (1.0 - v.clamp(0.0, 1.0)) / 2.0) ** -2
    value = torch.where(v > 1, positive_power(v.clamp_min(1.0), n_s), tail) - (1.0 + n_s / 2.0) ** -2
    return crest**n_s * torch.where(v > 0, value, torch.zeros_like(value))


def lobe_with_slope(u: Tensor, n_s: Tensor, crest: Tensor) -> tuple[Tensor, Tensor]:
    """`lobe` and its derivative by u, which have their power in common."""
    return ggx_with_slope(u, n_s, crest) if bool(crest > 0) else power_with_slope(u, n_s)


def lobe_slope(u: Tensor, n_s: Tensor, crest: Tensor) -> Tensor:
    """Derivative of `lobe` by u."""
    return lobe_with_slope(u, n_s, crest)[1]


def ggx_with_slope(u: Tensor, n_s: Tensor, crest: Tensor) -> tuple[Tensor, Tensor]:
    """The lobe of GGX microfacets and its derivative by u."""
    v = u / crest
    tail = (1.0 + n_s * (1.0 - v.clamp(0.0, 1.0)) / 2.0) ** -3
    slope = torch.where(v > 1, v.clamp_min(1.0) ** (n_s - 1.0), tail)
    return ggx(u, n_s, crest), torch.where(u > 0, n_s * crest ** (n_s - 1.0) * slope, torch.zeros_like(u))


def power_with_slope(u: Tensor, n_s: Tensor) -> tuple[Tensor, Tensor]:
    """The paper's lobe and its derivative by u."""
    value = positive_power(u, n_s)
    return value, n_s * value / torch.where(u > 0, u, 1.0)


def lobe_reaches(value: Tensor, n_s: Tensor, crest: Tensor) -> Tensor:
    """The argument at which the lobe has a value > 0: the inverse of `lobe`."""
    if not bool(crest > 0):
        return value ** (1.0 / n_s)
    share = value / crest**n_s + (1.0 + n_s / 2.0) ** -2
    below = 1.0 - 2.0 * (share.clamp_max(1.0) ** -0.5 - 1.0) / n_s
    return crest * torch.where(share > 1, share.clamp_min(1.0) ** (1.0 / n_s), below)


def lobe_argument(
    d: Roots, B: Float[Tensor, "*pixels"], a: Float[Tensor, "3"], alpha: Float[Tensor, "lights 3"]
) -> Float[Tensor, "*pixels lights"]:
    """A (a + B mean_c d): the n_s-th root of the off-specular component, signed (Eqs. 17 and 18)."""
    return (a + B[..., None] * d.mean(-2)) @ alpha.mT


def reflectance(
    d: Roots,
    B: Float[Tensor, "*pixels"],
    shared: Globals,
    *,
    s: Float[Tensor, "*pixels channels lights"],
    alpha: Float[Tensor, "lights 3"],
    width: Float[Tensor, "*pixels channels 1"],
    ceiling: float = math.inf,
) -> Float[Tensor, "*pixels channels lights"]:
    """Picture of every light of unit intensity (Eqs. 20 and 21).

    `s` is the scattering root of every light: measured where it has a sweep, A s_basis where not. `ceiling` is the
    largest argument of the lobe: with an exponent of 100 an argument 5 % too large is a highlight 130 times too bright.
    """
    body = diffuse(d @ alpha.mT + s, width, shared.n_d)
    u = lobe_argument(d, B, shared.a, alpha)
    return body + lobe(u if math.isinf(ceiling) else u.clamp(max=ceiling), shared.n_s, shared.crest)[..., None, :]
