"""The reflectance model: Eqs. 14, 17, 20 and 21 of Wu & Tang (ECCV 2004). No solver and no files.

    I_j = t_j [ pos(A_j (d + s)) ^ n_d  +  (u_j)_+ ^ n_s  +  h (u_j)_+ ^ (n_s / 8) ],     u = A (a + B d)

A is `alpha`, one row a light, for lights of unit intensity; the identity rows are the basis lights, so that Eqs. 20
and 21 are one formula. t_j is the light's intensity: light adds in radiance, so it scales the picture and does not
enter the powers. With h = 0 and a hard clamp (softness 0) this is the paper's formula. The two extensions:

* d is signed, negative where a patch faces away from a basis light, and the clamp inside the formula lets the other
  lights determine it there. In a translucent body the shadow's edge is soft, over a width that grows with the
  scattering: pos(x) = (x + sqrt(x^2 + e^2)) / 2 with e = softness * mean_k s_k.
* Rough dielectrics have a haze around the highlight that one power cannot follow: the same lobe, at an eighth of
  the exponent and of height h. Against path-traced GGX (roughness 0.2) it halves the lobe's error, 20 % to 11 %.

In colour the interface reflects white light, so the lobe is one for all channels, driven by the mean of d over them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

HAZE_RATIO = 8.0
"""n_s over the exponent of the haze."""

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
    haze: Float[Tensor, ""]
    """Height h of the haze."""


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


def lobe(u: Tensor, n_s: Tensor, haze: Tensor) -> Tensor:
    """Off-specular value of the lobe argument u, haze included (Eq. 17)."""
    return positive_power(u, n_s) + haze * positive_power(u, n_s / HAZE_RATIO)


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
    return body + lobe(u if math.isinf(ceiling) else u.clamp(max=ceiling), shared.n_s, shared.haze)[..., None, :]
