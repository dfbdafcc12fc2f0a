"""What the pixels around say of a pixel's lobe.

The lobe's vector v = B m / 2 C_1 is (N.V)(N.L_k) on an ideal surface: a matter of shape alone, whatever the albedo, and
surfaces are smooth. What a pixel's own pictures say of v is a mean mu and a covariance Sigma (the block's Gauss-Newton
matrix; what the neighbours had said is taken off first). A neighbour's v is that of the pixel up to a spread t:

    Lambda_q = (Sigma_q + t^2)^-1,     v0 = (sum_q k Lambda_q)^-1 sum_q k Lambda_q mu_q,
    precision of v0 = ((sum_q k Lambda_q)^-1 + t^2)^-1

with k a Gaussian about the pixel without its centre. Pixels that see the highlight well inform those that do not. The
width of k and the spread t are those under which the neighbours foretell mu best.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as nnf

from reflectsep.fit.problem import UPPER, Neighbours, PixelProblem, globals_of, log_size
from reflectsep.room import empty
from reflectsep.solve.linear import factorise, solve

WIDTHS_PX = (1.0, 1.5, 2.5)
SPREADS = (0.01, 0.03, 0.1)
"""Of v, which is 1 where a surface faces the viewer and the light."""
FAINT = 1e-2
"""Precision, of a spread of 10, that every pixel has without neighbours."""
OUTLIER = 25.0
"""Squared distance, in standard deviations, beyond which a pixel no longer speaks against a smoothness."""


@dataclass(frozen=True)
class Messages:
    """What each pixel's own pictures say of its lobe's vector."""

    mean: Float[Tensor, "3 pixels"]
    covariance: Float[Tensor, "6 pixels"]
    """Upper triangle, row by row."""


def messages(problem: PixelProblem, local: Float[Tensor, "P pixels"], shared: Float[Tensor, "G"]) -> Messages:
    """What the pictures say of every pixel's lobe vector, without what the neighbours said before."""
    at = problem.normal(local, shared)
    d, B = problem.unpacked(local)
    g, obs = globals_of(shared, problem.obs), problem.obs
    per = 0.5 / log_size(shared, obs).exp()
    v = per * B * (d + (1.0 - g.f) * obs.s[:3]).mean(1)
    # dv = per (B / C sum_c dd_c + B m dlog B)
    slope = local.new_zeros(len(local), 3, len(B))
    own = slope[:-1].view(3, obs.channels, 3, -1)
    for k in range(3):
        own[k, :, k] = per * B / obs.channels
    slope[-1] = v
    V = at.V
    if problem.neighbours is not None:
        # Take their rows off again: R^T R in the space of v.
        precision = problem.neighbours.precision()
        pull = torch.einsum("ijn,pjn->pin", precision, slope)
        V = V - torch.einsum("pin,qin->pqn", slope, pull)
    scale = V.diagonal(dim1=0, dim2=1).mT
    firm = 1e-9 * scale.abs().amax(0) + torch.finfo(scale.dtype).tiny
    solved = solve(factorise(V, firm.expand_as(scale)), slope)
    S = torch.einsum("pin,pjn->ijn", slope, solved)
    covariance = torch.stack([S[i, j] for i, j in UPPER])
    mean = v
    if problem.neighbours is not None:
        off = torch.einsum("ijn,jn->in", problem.neighbours.precision(), v - problem.neighbours.vector)
        moved = v + symmetric_times(covariance, off)
        # The step is linear; where it leads far it means nothing.
        usable = moved.isfinite().all(0) & ((moved - v).norm(dim=0) < 0.5)
        mean = torch.where(usable, moved, v)
    unsure = ~covariance.isfinite().all(0) | (covariance[[0, 3, 5]] < 0).any(0)
    blank = torch.tensor([1e4, 0.0, 0.0, 1e4, 0.0, 1e4], dtype=mean.dtype, device=mean.device)
    return Messages(mean, torch.where(unsure, blank[:, None], covariance))


def symmetric_times(S: Float[Tensor, "6 *rest"], v: Float[Tensor, "3 *rest"]) -> Float[Tensor, "3 *rest"]:
    """S v of a symmetric S."""
    return torch.stack(
        [
            S[0] * v[0] + S[1] * v[1] + S[2] * v[2],
            S[1] * v[0] + S[3] * v[1] + S[4] * v[2],
            S[2] * v[0] + S[4] * v[1] + S[5] * v[2],
        ]
    )


def inverse(S: Float[Tensor, "6 *rest"]) -> Float[Tensor, "6 *rest"]:
    """Inverse of symmetric positive matrices, by cofactors."""
    a, b, c, d, e, f = S
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * A + b * B + c * C
    det = torch.where(det.abs() > 0, det, torch.finfo(S.dtype).tiny)
    return torch.stack([A, B, C, a * f - c * c, b * c - a * e, a * d - b * b]) / det


def upper_root(S: Float[Tensor, "6 *rest"]) -> Float[Tensor, "6 *rest"]:
    """Upper triangular R with R^T R = S."""
    least = torch.finfo(S.dtype).tiny
    r00 = S[0].clamp_min(least).sqrt()
    r01, r02 = S[1] / r00, S[2] / r00
    r11 = (S[3] - r01 * r01).clamp_min(1e-12 * S[3].abs() + least).sqrt()
    r12 = (S[4] - r01 * r02) / r11
    r22 = (S[5] - r02 * r02 - r12 * r12).clamp_min(1e-12 * S[5].abs() + least).sqrt()
    return torch.stack([r00, r01, r02, r11, r12, r22])


def plus_spread(S: Float[Tensor, "6 *rest"], spread: float) -> Float[Tensor, "6 *rest"]:
    """S with spread^2 on its diagonal."""
    result = S.clone()
    result[[0, 3, 5]] += spread**2
    return result


def gaussian_sum(
    values: Float[Tensor, "pixels"], mask: Bool[Tensor, "height width"], width_px: float, reach: int
) -> Float[Tensor, "pixels"]:
    """Sum of the values around every pixel, the pixel itself with weight 1; nothing counts outside the mask."""
    at = torch.arange(-reach, reach + 1, dtype=values.dtype)
    kernel = torch.exp(-0.5 * (at / width_px).square())
    picture = values.new_zeros(mask.shape)
    picture[mask] = values
    rows = nnf.conv2d(picture[None, None], kernel[None, None, :, None], padding=(reach, 0))
    return nnf.conv2d(rows, kernel[None, None, None], padding=(0, reach))[0, 0][mask]


def pooled(
    said: Messages, mask: Bool[Tensor, "height width"], width_px: float, spread: float
) -> tuple[Float[Tensor, "3 pixels"], Float[Tensor, "6 pixels"]]:
    """Mean of the neighbours of every pixel, and the covariance of the pixel's own v about it."""
    weight = inverse(plus_spread(said.covariance, spread))
    planes = torch.cat([weight, symmetric_times(weight, said.mean)])
    reach = max(1, math.ceil(2.5 * width_px))
    result = empty(9, planes.shape[1], dtype=planes.dtype)
    for values, out in zip(planes, result, strict=True):
        out[:] = gaussian_sum(values, mask, width_px, reach) - values
    result[[0, 3, 5]] += FAINT
    found = inverse(result[:6])
    return symmetric_times(found, result[6:]), plus_spread(found, spread)


def likelihood(said: Messages, mean: Tensor, covariance: Tensor) -> float:
    """Mean log likelihood of what the pictures say of every pixel, foretold from its neighbours."""
    whole = covariance + said.covariance
    off = said.mean - mean
    R = upper_root(whole)
    log_det = 2.0 * (R[0].log() + R[3].log() + R[5].log())
    distance = (off * symmetric_times(inverse(whole), off)).sum(0)
    return float((-0.5 * (distance.clamp_max(OUTLIER) + log_det)).mean())


@dataclass(frozen=True)
class Smoothness:
    """How alike the lobes of neighbours are."""

    width_px: float
    spread: float


def best_smoothness(said: Messages, mask: Bool[Tensor, "height width"]) -> Smoothness:
    """The width and the spread under which neighbours foretell each other best."""
    trials = [Smoothness(width, spread) for width in WIDTHS_PX for spread in SPREADS]
    return max(trials, key=lambda t: likelihood(said, *pooled(said, mask, t.width_px, t.spread)))


def neighbours(said: Messages, mask: Bool[Tensor, "height width"], smooth: Smoothness) -> Neighbours:
    """What is expected of every pixel's lobe by its neighbours."""
    mean, covariance = pooled(said, mask, smooth.width_px, smooth.spread)
    return Neighbours(vector=mean, R=upper_root(inverse(covariance)))
