"""Alphas of the lights beside the basis as shared unknowns: three numbers a light, held to what was stated.

    beta_j = alpha_j + delta_j,    t_j = |sum_i beta_ji L_i|,    I_j = t_j I(beta_j / t_j)

alpha_j is what was stated of a light of unit intensity, delta_j is fitted. The length of the mixed vector is the
light's intensity, which scales the picture and stays out of the powers, for light adds in radiance; a direction and an
intensity are thus refined, and no length can hide in the lobe. The basis lights' own rows stay the identity: they set
the scale of d and s, so that nothing is left to choose. Where the directions are unknown t_j = 1 and beta_j enters
Eq. 21 as it stands.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Mixing:
    """Every light as a mix of the basis lights, all of unit intensity, and what its picture is multiplied by."""

    alpha: Float[Tensor, "lights 3"]
    intensity: Float[Tensor, "lights"]
    slope: Float[Tensor, "others 3"]
    """Of the intensity of every light beside the basis by its beta."""


def mixing(
    stated: Float[Tensor, "lights 3"], delta: Float[Tensor, "others*3"], basis: Float[Tensor, "3 3"] | None
) -> Mixing:
    """The refined alphas.

    Args:
        stated: alpha of every light; the first three rows are the identity.
        delta: what is added to the other rows, a light after the other.
        basis: unit vectors of the basis lights as rows; None where unknown.
    """
    beta = stated[3:] + delta.view(-1, 3)
    if basis is None:
        return Mixing(torch.cat([stated[:3], beta]), torch.ones_like(stated[:, 0]), torch.zeros_like(beta))
    gram = basis @ basis.mT
    length = (beta * (beta @ gram)).sum(-1, keepdim=True).clamp_min(1e-12).sqrt()
    intensity = torch.cat([torch.ones_like(stated[:3, 0]), length[:, 0]])
    return Mixing(torch.cat([stated[:3], beta / length]), intensity, beta @ gram / length)


def by_beta(
    mixed: Mixing,
    model: Float[Tensor, "pixels channels lights"],
    by_alpha: Float[Tensor, "pixels channels others 3"],
) -> Float[Tensor, "pixels channels others 3"]:
    """Derivative of t_j I(beta_j / t_j) by beta_j, for the lights beside the basis.

    d/dbeta_k = g_k I + D_k - g_k sum_i D_i alpha_i,    D = dI/dalpha, g = dt/dbeta

    Args:
        mixed: the refined alphas.
        model: I of every light, unit intensity.
        by_alpha: D of the lights beside the basis.
    """
    along = (by_alpha * mixed.alpha[3:]).sum(-1)
    return by_alpha + (model[..., 3:] - along)[..., None] * mixed.slope
