"""Priors whose strength comes from the data: noise, and the scatter of what should be constant.

Noise goes into the split of a pixel, not into its residual, so something must be expected of the split. What holds
for surfaces in general enters as rows of `fit/problem.py`; how firmly it holds on this object is measured here.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.fit.blocks import build_problem
from reflectsep.fit.chunks import in_chunks
from reflectsep.fit.neighbours import MAD_TO_SD, smooth
from reflectsep.fit.problem import (
    GGX,
    Locals,
    Observations,
    Priors,
    across,
    log_shape,
    no_priors,
    normalised_lobe,
    shape_row,
    unpack,
)
from reflectsep.solve.joint import inverse
from reflectsep.solve.problem import normal_equations

SHAPE_SD = ((0.1, 0.02), (0.03, 0.005))
"""Scatter of log B about its geometric value: before anything is known of it (twice that where the lights are unknown),
and at least. The lobe's peak goes with the power 2 n_s of B, so that 0.005 is a third of the peak at n_s 30. A power of
a cosine, fitted to a rough surface, is off by more (first); the lobe of GGX is not (second)."""
PARALLEL_SD_LEAST, RATIO_SD_LEAST = 0.015, 0.01
"""No prior is taken to be firmer than this: what lies below is the accuracy of the model itself."""
PARALLEL_SD_MOST = 0.06
"""Beyond this scatter the direction of s says nothing of that of d."""
RATIO_SIGMA_PX = 3.0
RATIO_ROUNDS = 4
"""Smoothings, each with less say for what the last one did not explain."""
RATIO_BREAK = 4.0
"""From about this many standard deviations off its neighbourhood on a pixel is of another material."""
HEIGHT_FACTOR = 2.0
"""Peak of the lobe that is believed, over the largest value above the robust body, which takes some of it."""
FACING_SD = ((0.1, 0.03), (0.03, 0.01))
"""Scatter of the direction of d about that of d + s, in radians: where it cannot be learnt, and at least; of a power
and of GGX's lobe."""
FACING_SIGMA_PX = 3.0
"""Over such a distance scattering mixes normals: where they turn within it, d + s says less of d."""
RAYLEIGH = 1.18
"""Median of a Rayleigh variable in standard deviations."""
LEAST_SEEN = 30
"""Pixels with a clear lobe that it takes to learn a scatter."""
VISIBLE = 3.0
"""A lobe counts as seen where it exceeds this many standard deviations of the noise."""


def quantile(values: Float[Tensor, "pixels"], share: float) -> float:
    """The value that `share` of the others stay below, interpolated; torch's own takes 16 million values at most."""
    rank = share * (len(values) - 1)
    low = int(rank)
    below = values.kthvalue(low + 1).values
    if low == rank:
        return float(below)
    return float(torch.lerp(below, values.kthvalue(low + 2).values, rank - low))


def near_maximum(values: Float[Tensor, "pixels"]) -> float:
    """The 99.9 % quantile, of some hundred thousand of the pixels at most."""
    return float(torch.quantile(values[:: max(1, len(values) // 100_000)], 0.999))


def noise_level(
    images: Float[Tensor, "pixels channels lights"],
    residual: Float[Tensor, "pixels channels lights"],
    unknowns: float,
) -> float:
    """Standard deviation of a picture's value, from what a fit of `unknowns` a pixel and channel leaves.

    The median over pixels, so that highlights and shadows have no say; never below 0.03 % of the peak.
    """
    return noise_of(images, residual.square().mean((1, 2)).sqrt(), unknowns)


def noise_of(images: Float[Tensor, "pixels channels lights"], rms: Float[Tensor, "pixels"], unknowns: float) -> float:
    """`noise_level` from the root mean square of every pixel's residuals."""
    lights = images.shape[-1]
    freedom = max(lights - unknowns, 0.5) / lights
    return max(float(rms.median()) / freedom**0.5, 3e-4 * near_maximum(images.amax((1, 2))))


def unknowns_in_effect(obs: Observations, priors: Priors, local: Tensor, shared: Tensor) -> float:
    """How many numbers a pixel and channel the pictures determine: the trace of the hat matrix over their rows.

    Priors hold part of a pixel's unknowns, so that counting these would make the noise too large, or, where there are
    more unknowns than pictures, endless.
    """
    index = torch.arange(0, len(obs), max(1, len(obs) // 2000))
    problem = build_problem(obs.take(index), priors.take(index), robust=None)
    r, J = problem.linearise_local(local[index], shared)
    V, _ = normal_equations(r, J, torch.ones_like(r))
    picture = J[:, : obs.images[0].numel()]
    trace = torch.einsum("nmp,npq,nmq->n", picture, inverse(V), picture)
    return float(trace.median()) / obs.channels


def first_priors(
    obs: Observations, body: Float[Tensor, "pixels channels 3"], sigma: float, shared: Float[Tensor, "G"]
) -> Priors:
    """What can be expected before any lobe is fitted."""
    top = lambda cut: (obs.images[cut] - (body[cut] @ obs.alpha.mT).clamp_min(0.0)).mean(1).amax(-1)  # noqa: E731
    above = in_chunks(len(obs), top)
    highest = near_maximum(above)
    priors = replace(
        no_priors(len(obs), obs.images),
        shape=1.0 / shape_scatter(obs, shared)[0],
        height=HEIGHT_FACTOR * max(highest, 5.0 * sigma),
    )
    power = in_chunks(len(obs), lambda cut: obs.s_basis[cut].square().sum((1, 2)))
    if not bool((power > 0).any()):
        return priors
    return replace(priors, parallel=parallel_weight(obs, parallel_spread(obs, body), sigma))


def parallel_spread(obs: Observations, body: Float[Tensor, "pixels channels 3"]) -> float:
    """How far the whole diffuse root is from parallel to s, relative to |s|: median standard deviation of a light."""

    def off_and_size(cut: slice) -> Tensor:
        s = obs.s_basis[cut]
        size = s.square().sum(-1, keepdim=True).sqrt()
        along = (body[cut] * s).sum(-1, keepdim=True) / size.square().clamp_min(1e-12)
        off = (body[cut] - along * s).square().sum(-1).sqrt().mean(-1)
        return torch.stack([off, size[..., 0].mean(-1)], -1)

    off, size = in_chunks(len(obs), off_and_size).unbind(-1)
    lit = size > 0.1 * size.max()
    return float((off[lit] / size[lit]).median()) / RAYLEIGH


def parallel_weight(obs: Observations, spread: float, sigma: float) -> Float[Tensor, "pixels"]:
    """Weight of `d + s parallel to s` for a scatter of `spread`; 0 where that is no rule of this object."""
    size = in_chunks(len(obs), lambda cut: obs.s_basis[cut].square().sum(-1).sqrt().mean(-1))
    if spread > PARALLEL_SD_MOST:
        return torch.zeros_like(size)
    return 1.0 / (max(spread, PARALLEL_SD_LEAST) * size + 0.1 * sigma)


def with_ratio(
    priors: Priors,
    obs: Observations,
    whole: Float[Tensor, "pixels channels 3"],
    body: Float[Tensor, "pixels channels 3"],
    mask: Bool[Tensor, "height width"],
) -> Priors:
    """`priors` with the ratio row from the present whole diffuse root and its neighbourhood.

    A label on a translucent body has another ratio, and its neighbours have no say in it. Borders are found on the
    robust body: in the present fit, patches in a wrong minimum would pass for another material and never be mended.
    """
    s = obs.s_basis
    power = in_chunks(len(s), lambda cut: s[cut].square().sum(-1).mean(-1))
    bright = power > 0.01 * power.max()
    if not bool(bright.any()):
        return priors
    alike = one_material(ratio_to(body, s), power, bright, mask)
    ratio = ratio_to(whole, s)
    calm = smooth(ratio[:, None], alike * power, mask, RATIO_SIGMA_PX)[:, 0]
    counts = bright & (alike > 0.5)
    if not bool(counts.any()):
        return priors
    spread = MAD_TO_SD * float((ratio - calm)[counts].abs().median())
    weight = torch.where(counts, 1.0 / max(spread, RATIO_SD_LEAST), 0.0)
    return replace(priors, ratio=calm, ratio_weight=weight.to(ratio.dtype))


def ratio_to(whole: Float[Tensor, "pixels channels 3"], s: Float[Tensor, "pixels channels 3"]) -> Tensor:
    """(d + s) . s / s . s, mean over channels."""

    def ratio(cut: slice) -> Tensor:
        part = s[cut]
        return ((whole[cut] * part).sum(-1) / part.square().sum(-1).clamp_min(1e-9)).mean(-1)

    return in_chunks(len(s), ratio)


def one_material(
    ratio: Float[Tensor, "pixels"], power: Tensor, bright: Tensor, mask: Bool[Tensor, "height width"]
) -> Float[Tensor, "pixels"]:
    """1 where a ratio is that of its neighbourhood, 0 where it is another material's, in between where unsure."""
    trust = torch.ones_like(ratio)
    for _ in range(RATIO_ROUNDS):
        calm = smooth(ratio[:, None], trust * power, mask, RATIO_SIGMA_PX)[:, 0]
        off = (ratio - calm).abs()
        spread = max(MAD_TO_SD * float(off[bright].median()), RATIO_SD_LEAST)
        trust = (1.0 + (off / (RATIO_BREAK * spread)).square()).square().reciprocal()
    return trust


def with_facing(
    priors: Priors,
    obs: Observations,
    x: Locals,
    shared: Tensor,
    shine: Float[Tensor, "pixels lights"],
    sigma: float,
    mask: Bool[Tensor, "height width"],
) -> Priors:
    """`priors` with the facing row from the present whole diffuse root; as firm as where the lobe is well seen.

    Where scattering is nearly all of a pixel's light, d = whole - s has the direction of its error, and a lobe that no
    picture of the basis sees shines in the pictures of other lights.
    """
    body = obs.s_basis if x.s is None else x.s
    whole = in_chunks(len(obs), lambda cut: (x.d[cut] + body[cut]).mean(1))
    size = in_chunks(len(obs), lambda cut: whole[cut].norm(dim=-1).clamp_min(1e-9))
    facing = in_chunks(len(obs), lambda cut: whole[cut] / size[cut, None])

    def off(cut: slice) -> Tensor:
        v = normalised_lobe(x.take(cut), shared)
        return across(v, facing[cut]).norm(dim=-1) / v.norm(dim=-1).clamp_min(1e-9)

    seen = (shine > 2.0 * VISIBLE * sigma).sum(-1) >= 2
    spread, least = FACING_SD[int(shared[GGX] > 0)]
    if int(seen.sum()) >= LEAST_SEEN:
        spread = min(max(float(in_chunks(len(obs), off)[seen].median()) / RAYLEIGH, least), spread)
    calm = smooth(facing, size, mask, FACING_SIGMA_PX)

    def weight(cut: slice) -> Tensor:
        # The length of the lobe by its geometry, from the same normal.
        length = size[cut] * (-log_shape(whole[cut], obs.normal_map, obs.view, obs.lights_known)).exp()
        # One coordinate after the other, as maps are: sums in another order round otherwise.
        around = torch.nn.functional.normalize(calm[cut].T.contiguous().T, dim=-1)
        bent = (facing[cut] - around).square().sum(-1) / 2.0
        firm = 1.0 / (length * (spread**2 + bent + (sigma / size[cut]).square()).sqrt()).clamp_min(1e-3)
        return torch.where(whole[cut].mean(-1) > 2.0 * sigma, firm, 0.0)

    return replace(priors, facing=facing, facing_weight=in_chunks(len(obs), weight))


def shape_scatter(obs: Observations, shared: Float[Tensor, "G"]) -> tuple[float, float]:
    """`SHAPE_SD` of this lobe and these lights: at first, and at least."""
    first, least = SHAPE_SD[int(shared[GGX] > 0)]
    return (first if obs.lights_known else 2.0 * first), least


def shape_spread(
    obs: Observations, local: Tensor, shared: Tensor, shine: Float[Tensor, "pixels lights"], sigma: float
) -> float:
    """Scatter of log B about its geometric value over the pixels whose lobe is well seen."""

    def rows(cut: slice) -> Tensor:
        x = unpack(local[cut], obs.channels)
        return shape_row(x.log_B, x.d.mean(-2), shared, obs)

    # Well seen: in two pictures or more, and well above the noise.
    seen = (shine > 2.0 * VISIBLE * sigma).sum(-1) >= 2
    first, least = shape_scatter(obs, shared)
    if int(seen.sum()) < LEAST_SEEN:
        return first
    values = in_chunks(len(local), rows)[seen]
    spread = MAD_TO_SD * float((values - values.median()).abs().median())
    return min(max(spread, least), first)
