"""Start values that do not end in wrong minima.

Given the globals and B, each basis equation pos(d_k + s_k)^n_d + (a_k + B d_k)_+^n_s = I_k is monotone in d_k and
has one root; the other pictures then score B. A pixel is a one-dimensional search over B, and the same search over a
grid of (n_s, peak height) scores the globals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.fit.chunks import in_chunks
from reflectsep.fit.problem import (
    LOG_C_2,
    LOG_N_S,
    SOFTNESS,
    Observations,
    Priors,
    log_shape,
    refined,
    shape_row,
    unpack_globals,
)
from reflectsep.model import (
    Globals,
    diffuse,
    edge_width,
    lobe,
    lobe_reaches,
    lobe_slope,
    reflectance,
    signed_root,
)

GRID_N_S = (3.0, 4.5, 6.5, 9.0, 13.0, 19.0, 28.0, 42.0, 65.0, 100.0)
GRID_HEIGHT = (0.3, 0.55, 1.0, 1.8, 3.2)
"""Peak of the lobe |C_1|^n_s in units of the largest specular value seen."""


def grey(obs: Observations) -> Observations:
    """The channel mean, which alone drives the lobe."""
    if obs.channels == 1:
        return obs
    mean = lambda x: x.mean(1, keepdim=True)  # noqa: E731
    return replace(
        obs,
        images=mean(obs.images),
        s=mean(obs.s),
        weight=mean(obs.weight) * obs.channels**0.5,
        clipped=obs.clipped.any(1, keepdim=True),
    )


def basis_roots(
    target: Float[Tensor, "*pixels 3"],
    s: Float[Tensor, "*pixels 3"],
    B: Float[Tensor, "*pixels 1"],
    shared: Globals,
    width: Float[Tensor, "*pixels 1"],
    *,
    iterations: int = 16,
) -> Float[Tensor, "*pixels 3"]:
    """d_k of pos(d_k + s_k)^n_d + lobe(a_k + B d_k) = I_k, by Newton from above, halving where that leaves the bracket.

    The left side rises with d_k, and is convex.
    """
    target = target.clamp_min(1e-5)
    root = target ** (1.0 / float(shared.n_d))
    alone = root - width.square() / (4.0 * root)  # the root if there were no lobe
    high = torch.minimum(alone - s, (lobe_reaches(target, shared.n_s, shared.crest) - shared.a) / B)
    low = torch.minimum(high, -shared.a / B)  # no lobe here, and no more light of the body than there is in all
    d = high
    n_d = float(shared.n_d)
    for _ in range(iterations):
        x = d + s
        length = (x.square() + width.square() + 1e-20).sqrt()
        lit = 0.5 * (x + length)
        u = (shared.a + B * d).clamp_min(0.0)
        value = lit**n_d + lobe(u, shared.n_s, shared.crest) - target
        slope = n_d * lit.clamp_min(1e-12) ** (n_d - 1.0) * 0.5 * (1.0 + x / length)
        slope = slope + B * lobe_slope(u, shared.n_s, shared.crest)
        low, high = torch.where(value < 0, d, low), torch.where(value < 0, high, d)
        step = d - value / slope.clamp_min(1e-4)
        d = torch.where((step < low) | (step > high), 0.5 * (low + high), step)
    return d


@dataclass(frozen=True)
class Candidates:
    """Solutions of the scan of every pixel, best first."""

    d: Float[Tensor, "pixels candidates channels 3"]
    log_B: Float[Tensor, "pixels candidates"]  # noqa: N815
    cost: Float[Tensor, "pixels candidates"]
    """inf where a pixel has fewer minima."""


def joined(parts: Sequence[Candidates]) -> Candidates:
    """Those of several runs of pixels, one after the other."""
    return Candidates(*(torch.cat([getattr(part, name) for part in parts]) for name in ("d", "log_B", "cost")))


def scan(
    obs: Observations,
    priors: Priors,
    shared: Float[Tensor, "G"],
    *,
    keep: int,
    values: int = 32,
    span: tuple[float, float] = (-1.2, 1.6),
    robust: float = 20.0,
) -> Candidates:
    """Local minima of the cost over B of every pixel; B geometric about what the shape prior expects."""
    obs = refined(obs, shared)
    mean = grey(obs)
    globals_ = unpack_globals(shared, obs.n_d)
    target, s = mean.images[:, 0], mean.s[:, 0]
    width = edge_width(mean.s_basis, shared[SOFTNESS])[:, 0]
    first = (signed_root(target[:, :3], float(globals_.n_d)) - s[:, :3]).clamp_min(1e-4)
    centre = shared[LOG_C_2] - log_shape(first, obs.normal_map, obs.view, obs.lights_known)
    log_B = centre[:, None] + torch.linspace(*span, values, dtype=target.dtype, device=target.device)
    B = log_B.exp()
    d = basis_roots(target[:, None, :3], s[:, None, :3], B[..., None], globals_, width[:, None])
    model = reflectance(
        d[..., None, :], B, globals_, s=s[:, None, None], alpha=obs.alpha, width=width[:, None, :, None]
    )[:, :, 0]
    misfit = model - target[:, None]
    misfit = torch.where(mean.clipped[:, 0, None], misfit.clamp_max(0.0), misfit)
    scaled = (misfit * mean.weight[:, 0, None]).abs()
    cost = torch.where(scaled < robust, 0.5 * scaled.square(), robust * (scaled - 0.5 * robust)).sum(-1)
    cost = cost + 0.5 * (priors.shape * shape_row(log_B, d, shared, obs)).square()
    ends = torch.nn.functional.pad(cost, (1, 1), value=torch.inf)
    minimum = (cost <= ends[:, :-2]) & (cost <= ends[:, 2:])
    best, index = torch.where(minimum, cost, torch.inf).topk(keep, largest=False, dim=1)
    row = torch.arange(len(obs), device=target.device)[:, None]
    return Candidates(
        d=colour_roots(obs, d[row, index], log_B[row, index].exp(), globals_),
        log_B=log_B[row, index],
        cost=best,
    )


def colour_roots(
    obs: Observations, d_mean: Tensor, B: Tensor, globals_: Globals
) -> Float[Tensor, "pixels candidates channels 3"]:
    """Roots of every channel once the lobe is known from the mean: what the lobe leaves of the picture is diffuse."""
    if obs.channels == 1:
        return d_mean[..., None, :]
    shine = lobe(globals_.a + B[..., None] * d_mean, globals_.n_s, globals_.crest)
    rest = obs.images[:, None, :, :3] - shine[..., None, :]
    return signed_root(rest, float(globals_.n_d)) - obs.s_basis[:, None]


def informative_pixels(
    obs: Observations, body: Float[Tensor, "pixels channels 3"], count: int
) -> Float[Tensor, "some"]:
    """Pixels that carry the globals: those whose pictures stand highest above their diffuse part, thinned out.

    Every second of the most telling 2 x count, so that not only the cores of a few highlights speak.
    """
    n_d = obs.n_d_swept

    def score(cut: slice) -> Tensor:
        plain = diffuse(body[cut] @ obs.alpha.mT, body.new_zeros(()), n_d)
        above = (obs.images[cut] - plain).mean(1) * obs.weight[cut].mean(1)
        return above.clamp_min(0.0).clamp_max(50.0).square().sum(-1)

    order = in_chunks(len(obs), score).argsort(descending=True)
    return order[: 2 * count : 2] if len(order) >= 2 * count else order[:count]


def globals_grid(
    obs: Observations,
    priors: Priors,
    start: Float[Tensor, "G"],
    exponents: Sequence[float] = GRID_N_S,
    *,
    trim: float,
    best: int,
) -> list[Float[Tensor, "G"]]:
    """The best starts of the globals: mirror lobes a_k = C_1 L_k.V, C_2 = -2 C_1 over a grid of (n_s, height).

    Scored by the cheapest `trim` share of the pixels, so that those in wrong minima have no vote.
    """
    scored = []
    number = max(1, int(trim * len(obs)))
    for n_s in exponents:
        for factor in GRID_HEIGHT:
            C_1 = -((factor * priors.height) ** (1.0 / n_s))
            trial = start.clone()
            trial[:3] = C_1 * obs.cosine
            trial[LOG_N_S] = torch.log(start.new_tensor(n_s))
            trial[LOG_C_2] = torch.log(start.new_tensor(-2.0 * C_1))
            cost = scan(obs, priors, trial, keep=1).cost[:, 0]
            scored.append((float(cost.sort().values[:number].sum()), len(scored), trial))
    scored.sort(key=lambda entry: entry[:2])
    return [trial for _, _, trial in scored[:best]]
