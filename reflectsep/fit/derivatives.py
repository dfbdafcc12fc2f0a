"""Closed-form derivatives of `fit/problem.py`'s residuals: the same numbers as forward mode, several times sooner.

With x_cj = sum_k A_jk (d_ck + s_ck), u_j = sum_k A_jk (a_k + B mean_c d_ck), P' and F' the slopes of the diffuse part
and of the lobe:

    dI_cj / dd_c'k = A_jk (P'_cj [c = c'] + F'_j B / C)        dI_cj / dlog B = F'_j B sum_k A_jk mean_c d_ck
    dI_cj / ds_ck  = A_jk P'_cj                                dI_cj / da_k   = F'_j A_jk

Forward mode costs one evaluation for every unknown; here all columns share what is expensive, the powers.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.fit.mixing import by_beta
from reflectsep.fit.problem import (
    ALPHA,
    GGX,
    LOG_C_2,
    LOG_N_D,
    LOG_N_S,
    SOFTNESS,
    Locals,
    Observations,
    Priors,
    across,
    linear,
    mixing_of,
    normalised_lobe,
    pixel_residual,
    refined,
    s_of_lights,
    unpack,
    unpack_globals,
)
from reflectsep.model import Globals, diffuse, edge_width, lobe, lobe_argument, lobe_slope


@dataclass(frozen=True)
class LobeSlopes:
    """Derivatives of the off-specular picture."""

    by_u: Float[Tensor, "pixels lights"]
    by_log_n_s: Float[Tensor, "pixels lights"]
    by_log_crest: Float[Tensor, "pixels lights"]


@dataclass(frozen=True)
class BodySlopes:
    """Derivatives of the whole diffuse picture."""

    by_root: Float[Tensor, "pixels channels lights"]
    by_width: Float[Tensor, "pixels channels lights"]
    by_log_n_d: Float[Tensor, "pixels channels lights"]


def lobe_slopes(u: Float[Tensor, "pixels lights"], shared: Globals) -> LobeSlopes:
    """Of u^n_s or GGX's lobe, zero where u <= 0."""
    n, lit = shared.n_s, u > 0
    zero = torch.zeros_like(u)
    if not bool(shared.crest > 0):
        safe = torch.where(lit, u, torch.ones_like(u))
        log = safe.log()
        power = torch.where(lit, (n * log).exp(), zero)
        return LobeSlopes(n * power / safe, n * power * log, zero)
    v = u / shared.crest
    value, by_u = lobe(u, n, shared.crest), lobe_slope(u, n, shared.crest)
    w, least = 1.0 + n * (1.0 - v.clamp(0.0, 1.0)) / 2.0, 1.0 + n / 2.0
    # w rises with n by (1 - v) / 2 and `least` by 1 / 2, hence by log n by w - 1 and by least - 1.
    core = torch.where(v > 1, n * v.clamp_min(1.0) ** n * v.clamp_min(1.0).log(), -2.0 * (w - 1.0) * w**-3)
    by_log_n = n * shared.crest.log() * value + shared.crest**n * (core + 2.0 * (least - 1.0) * least**-3)
    by_log_crest = n * value - by_u * u
    return LobeSlopes(*(torch.where(lit, slope, zero) for slope in (by_u, by_log_n, by_log_crest)))


def body_slopes(root: Float[Tensor, "pixels channels lights"], width: Tensor, n_d: Tensor | float) -> BodySlopes:
    """Of pos(x)^n_d, pos(x) = (x + sqrt(x^2 + e^2)) / 2."""
    length = (root.square() + width.square() + torch.finfo(root.dtype).tiny).sqrt()
    by_root, by_width = 0.5 + 0.5 * root / length, 0.5 * width / length
    if isinstance(n_d, float) and n_d == 1.0:
        return BodySlopes(by_root, by_width, torch.zeros_like(root))
    positive = 0.5 * (root + length)
    lit = positive > 0
    safe = torch.where(lit, positive, torch.ones_like(positive))
    power = torch.where(lit, safe**n_d, 0.0)
    slope = n_d * power / safe
    return BodySlopes(slope * by_root, slope * by_width, n_d * power * safe.log())


def shape_slope(d_mean: Float[Tensor, "pixels 3"], obs: Observations) -> Float[Tensor, "pixels 3"]:
    """Of `log_shape` by mean_c d."""
    if not obs.lights_known:
        mean = d_mean.mean(-1, keepdim=True)
        # log((m + sqrt(m^2 + e)) / 2) has the slope 1 / sqrt(m^2 + e).
        return ((mean.square() + 1e-8).rsqrt() / 3.0).expand_as(d_mean)
    g = linear(d_mean, obs.normal_map)
    facing = linear(g, obs.view[None])
    by_g = 2.0 * g / (g.square().sum(-1, keepdim=True) + 1e-6) - (facing.square() + 1e-6).rsqrt() * obs.view
    return linear(by_g, obs.normal_map.mT)


def jacobians(
    local: Tensor, shared: Tensor, obs: Observations, priors: Priors, *, with_shared: bool
) -> tuple[
    Float[Tensor, "pixels residuals"],
    Float[Tensor, "pixels residuals P"],
    Float[Tensor, "pixels residuals G"] | None,
]:
    """`pixel_residual` and its derivatives by a pixel's own unknowns and by the shared ones (None unless asked for)."""
    r = pixel_residual(local, shared, obs, priors)
    stated, obs = obs, refined(obs, shared)
    x = unpack(local, obs.channels)
    g = unpack_globals(shared, obs.n_d)
    pixels, channels, lights = obs.images.shape
    root = x.d @ obs.alpha.mT + s_of_lights(x, obs)
    body = body_slopes(root, edge_width(obs.s_basis, shared[SOFTNESS]), g.n_d)
    shine = lobe_slopes(lobe_argument(x.d, x.B, g.a, obs.alpha), g)
    # A clipped value that the model exceeds costs nothing, so it pulls nowhere: its residual is exactly 0.
    pull = obs.weight
    if bool(obs.clipped.any()):
        pull = torch.where(obs.clipped & (r[:, : channels * lights].view_as(obs.clipped) == 0), 0.0, obs.weight)
    J = r.new_zeros(*r.shape, local.shape[1])
    pictures, expectations = J[:, : channels * lights], J[:, channels * lights :]
    fill_pictures(pictures.view(pixels, channels, lights, -1), x, pull, body, shine, obs.alpha)
    fill_priors(expectations, x, shared, obs, priors)
    if not with_shared:
        return r, J, None
    K = r.new_zeros(pixels, r.shape[1], len(shared))
    pictures = K[:, : channels * lights].view(pixels, channels, lights, -1)
    pictures[..., :3] = (pull * shine.by_u[:, None])[..., None] * obs.alpha
    pictures[..., LOG_N_S] = pull * shine.by_log_n_s[:, None]
    if bool(shared[GGX] > 0):
        pictures[..., LOG_C_2] = pull * shine.by_log_crest[:, None]
    pictures[..., SOFTNESS] = pull * body.by_width * edge_width(obs.s_basis, shared.new_ones(()))
    if obs.n_d is None:
        pictures[..., LOG_N_D] = pull * body.by_log_n_d
    if len(shared) > ALPHA:
        alpha_columns(pictures, x, shared, stated, obs, (pull, root, body, shine))
    first = channels * lights
    K[:, first, LOG_C_2] = -priors.shape
    lobe = first + 2 + 3 * channels
    v = normalised_lobe(x, shared)
    K[:, lobe : lobe + 3, LOG_C_2] = -priors.lobe_weight[:, None] * v
    K[:, lobe + 3 : lobe + 6, LOG_C_2] = -priors.facing_weight[:, None] * across(v, priors.facing)
    return r, J, K


def alpha_columns(
    pictures: Float[Tensor, "pixels channels lights G"],
    x: Locals,
    shared: Tensor,
    stated: Observations,
    obs: Observations,
    known: tuple[Tensor, Tensor, BodySlopes, LobeSlopes],
) -> None:
    """Fill in the derivatives of the weighted pictures by what is added to the stated alphas.

        dI_cj / dalpha_ji = P'_cj (d_ci + s_ci) + F'_j (a_i + B mean_c d_ci)

    s_ci is only what the fit changed of it where light j has a sweep of its own. `obs` are those of the refined
    alphas, `known` their weights, roots and slopes.
    """
    pull, root, body, shine = known
    g = unpack_globals(shared, obs.n_d)
    own = torch.tensor(obs.swept or [False] * len(obs.alpha), device=obs.images.device)[3:, None]
    s = obs.s_basis if x.s is None else x.s
    mixed_root = (x.d + s)[:, :, None] - torch.where(own, obs.s_basis[:, :, None], 0.0)
    lobe_root = g.a + x.B[:, None] * x.d.mean(1)
    by_alpha = body.by_root[..., 3:, None] * mixed_root + (shine.by_u[:, 3:, None] * lobe_root[:, None])[:, None]
    u = lobe_root @ obs.alpha.mT
    model = diffuse(root, edge_width(obs.s_basis, shared[SOFTNESS]), g.n_d) + lobe(u, g.n_s, g.crest)[:, None]
    mixed = mixing_of(stated, shared)
    slopes = (pull / mixed.intensity)[..., 3:, None] * by_beta(mixed, model, by_alpha)
    for j in range(slopes.shape[2]):
        at = ALPHA + 3 * j
        pictures[:, :, 3 + j, at : at + 3] = slopes[:, :, j]


def fill_pictures(
    J: Float[Tensor, "pixels channels lights P"],
    x: Locals,
    pull: Tensor,
    body: BodySlopes,
    shine: LobeSlopes,
    alpha: Tensor,
) -> None:
    """Derivatives of the weighted pictures by a pixel's unknowns, into the zeros of J."""
    channels = pull.shape[1]
    by_lobe = pull * (shine.by_u * x.B[:, None])[:, None]
    by_body = (pull * body.by_root)[..., None] * alpha
    J[..., : 3 * channels].unflatten(-1, (channels, 3)).copy_(((by_lobe / channels)[..., None] * alpha)[..., None, :])
    J[..., 3 * channels] = by_lobe * (x.d.mean(1) @ alpha.mT)[:, None]
    for c in range(channels):
        J[:, c, :, 3 * c : 3 * c + 3] += by_body[:, c]
        if x.s is not None:
            at = 3 * channels + 1 + 3 * c
            J[:, c, :, at : at + 3] = by_body[:, c]


def fill_priors(
    J: Float[Tensor, "pixels rows P"], x: Locals, shared: Tensor, obs: Observations, priors: Priors
) -> None:
    """Derivatives of the priors' rows by a pixel's unknowns, in the order of `pixel_residual`, into the zeros of J."""
    channels = x.d.shape[1]
    three, log_B = 3 * channels, 3 * channels
    mean = x.d.mean(1)
    J[:, 0, :three] = (priors.shape / channels * shape_slope(mean, obs)).repeat(1, channels)
    J[:, 0, log_B] = priors.shape

    s = obs.s_basis if x.s is None else x.s
    whole, power = x.d + s, s.square().sum(-1, keepdim=True) + 1e-9
    along = (whole * s).sum(-1, keepdim=True) / power
    by_d = s / power
    by_s = (whole + s - 2.0 * along * s) / power
    eye = torch.eye(3, dtype=s.dtype, device=s.device)
    off_d = eye - s[..., :, None] * by_d[..., None, :]
    off_s = off_d if x.s is None else (1.0 - along[..., None]) * eye - s[..., :, None] * by_s[..., None, :]
    weight, mean_weight = priors.parallel[:, None, None], (priors.ratio_weight / channels)[:, None]
    for c in range(channels):
        rows = slice(1 + 3 * c, 4 + 3 * c)
        J[:, rows, 3 * c : 3 * c + 3] = weight * off_d[:, c]
        J[:, 1 + three, 3 * c : 3 * c + 3] = mean_weight * by_d[:, c]
        if x.s is not None:
            at = three + 1 + 3 * c
            J[:, rows, at : at + 3] = weight * off_s[:, c]
            J[:, 1 + three, at : at + 3] = mean_weight * by_s[:, c]

    lobe = 2 + three
    strength = priors.lobe_weight[:, None]
    v, share = normalised_lobe(x, shared), x.B / shared[LOG_C_2].exp() / channels
    J[:, lobe : lobe + 3, log_B] = strength * v
    for k in range(3):
        J[:, lobe + k, k:three:3] = strength * share[:, None]
    facing = lobe + 3
    strength = priors.facing_weight[:, None]
    J[:, facing : facing + 3, log_B] = strength * across(v, priors.facing)
    off = eye - priors.facing[:, :, None] * priors.facing[:, None, :]
    J[:, facing : facing + 3, :three] = ((strength * share[:, None])[..., None] * off).repeat(1, 1, channels)
    if x.s is not None:
        J[:, facing + 3 :, three + 1 :].diagonal(dim1=1, dim2=2).copy_(priors.s_weight[:, None].expand(-1, three))
