"""The lobe as a pixel's neighbours have it: a smooth surface has a smooth lobe, whatever its albedo.

B d_k / C_2 = (N.V)(N.L_k) is a matter of shape alone (Eqs. 6, 7 and 18). Pixel by pixel, a faint highlight and a
little more diffuse light look the same; whole patches end in the same wrong split. From the pixels around it a
quadratic surface predicts a pixel's lobe, and how well it predicts those whose lobe is well seen says how firmly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.fit.blocks import build_problem
from reflectsep.fit.chunks import in_chunks
from reflectsep.fit.expectations import VISIBLE
from reflectsep.fit.neighbours import local_quadratic
from reflectsep.fit.problem import LOG_C_2, Priors, normalised_lobe, unpack
from reflectsep.fit.solution import lobe_pictures
from reflectsep.fit.state import State
from reflectsep.solve.joint import solve_firm
from reflectsep.solve.sharing import by_chunks

SCALES_PX = (3.0, 2.0, 1.5, 1.0)
"""Widths of the windows, the widest first: patches in a wrong minimum are overruled from outside."""
WORTH = 1.5
"""Neighbours have a say where they predict a clear lobe to within this many of its own standard deviations: where the
pictures say more, as without noise, they would only blur it."""
REPEATS = 2
"""Further rounds at the scale that predicts best."""
LEAST_SD = 0.003
"""No neighbourhood is believed more closely than this, in units of (N.V)(N.L)."""
LEAST_SEEN = 100
"""Pixels with a clear lobe that it takes to learn how smooth the surface is."""
MEDIAN_OF_CHI_SQUARED = 0.789
"""Of a mean of three squares of unit normal variables."""


@dataclass(frozen=True)
class Prediction:
    """What the neighbours say of every pixel."""

    lobe: Float[Tensor, "pixels 3"]
    variance: Float[Tensor, "pixels"]
    """Of the prediction itself, by the neighbours' own uncertainty."""
    spread: float
    """Standard deviation of a true lobe about such a prediction."""
    error: float
    """Root mean square error of predicting a lobe that is well seen, `spread` and `variance` together."""
    own: float
    """Standard deviation of such a lobe by its own pictures."""


def lobe_variance(state: State) -> Float[Tensor, "pixels"]:
    """Variance of the normalised lobe by each pixel's own pictures, the mean over its three components."""
    obs = state.obs
    priors = replace(state.priors, lobe_weight=torch.zeros_like(state.priors.lobe_weight))

    def variance(cut: slice) -> tuple[Tensor]:
        index = torch.arange(cut.start, cut.stop)
        problem = build_problem(obs.take(index), priors.take(index), robust=state.robust)
        local = state.found.local[index]
        _, _, V = problem.normal_equations(local, state.shared)
        x, channels = unpack(local, obs.channels), obs.channels
        slope = local.new_zeros(3, *local.T.shape)
        for k in range(3):
            slope[k, k : 3 * channels : 3] = x.B / channels
            slope[k, 3 * channels] = x.B * x.d.mean(1)[:, k]
        slope = slope / state.shared[LOG_C_2].exp()
        return ((slope * solve_firm(V, slope)).sum((0, 1)) / 3.0,)

    return by_chunks(len(obs), state.effort.chunk, variance)[0]


def clearly_seen(state: State, variance: Tensor) -> Bool[Tensor, "pixels"]:
    """Pixels whose lobe is well above the noise in two pictures, and well determined."""

    def in_two(cut: slice) -> Tensor:
        shine = lobe_pictures(state.obs, state.found.local[cut], state.shared)
        return (shine > 2.0 * VISIBLE * state.sigma).sum(-1) >= 2

    seen = in_chunks(len(state.obs), in_two)
    if not bool(seen.any()):
        return seen
    return seen & (variance < 4.0 * variance[seen].median())


@dataclass(frozen=True)
class Lobes:
    """Every pixel's lobe as it is, before its neighbours are heard."""

    lobe: Float[Tensor, "pixels 3"]
    variance: Float[Tensor, "pixels"]
    """By the pixel's own pictures."""
    seen: Bool[Tensor, "pixels"]
    """Clearly."""

    @classmethod
    def of(cls, state: State) -> Lobes:
        """The lobes that the fit has found so far."""
        x = unpack(state.found.local, state.obs.channels)
        lobe = in_chunks(len(state.obs), lambda cut: normalised_lobe(x.take(cut), state.shared))
        variance = lobe_variance(state)
        return cls(lobe, variance, clearly_seen(state, variance))


def predict(state: State, scale_px: float, spread: float | None = None) -> Prediction | None:
    """Every pixel's lobe from its neighbours; None where too few lobes are seen to learn `spread`.

    Neighbours count by their certainty, and less the farther they are from what their own neighbours say.
    """
    return _predicted(Lobes.of(state), state.mask, scale_px, spread)


def _predicted(lobes: Lobes, mask: Tensor, scale_px: float, spread: float | None) -> Prediction | None:
    lobe, own, seen = lobes.lobe, lobes.variance, lobes.seen
    if spread is None and int(seen.sum()) < LEAST_SEEN:
        return None
    square = 1e-4 if spread is None else spread**2
    trust = torch.ones_like(own)
    predicted, variance = lobe, own
    for _ in range(4):
        predicted, variance = local_quadratic(lobe, trust / (own + square), mask, scale_px)
        error = in_chunks(len(lobe), lambda cut, p=predicted: (lobe[cut] - p[cut]).square().mean(-1))
        if spread is None:
            total = float(error[seen].median()) / MEDIAN_OF_CHI_SQUARED
            square = max(total - float(own[seen].median()), LEAST_SD**2)
        trust = (1.0 + error / (4.0 * (own + square + variance))).square().reciprocal()
    clear = seen if bool(seen.any()) else torch.ones_like(seen)
    error, alone = (square + float(variance[clear].median())) ** 0.5, float(own[clear].median()) ** 0.5
    return Prediction(predicted, variance, square**0.5, error, alone)


def scales_of(state: State) -> list[tuple[float, float]]:
    """Scales to go through with the spread of each: down to the one that predicts best, and some more rounds there.

    On a rough surface or in noise a narrow window follows its few neighbours' errors; on a finely curved one a wide
    window is no surface at all.
    """
    lobes = Lobes.of(state)
    tried = [(scale, _predicted(lobes, state.mask, scale, None)) for scale in SCALES_PX]
    known = [(scale, found) for scale, found in tried if found is not None]
    if not known:
        return []
    best = min(range(len(known)), key=lambda i: known[i][1].error)
    if known[best][1].error > WORTH * known[best][1].own:
        return []
    order = [*range(best + 1), *[best] * REPEATS]
    return [(known[i][0], known[i][1].spread) for i in order]


def with_lobe(priors: Priors, prediction: Prediction) -> Priors:
    """`priors` with the lobe row."""
    weight = (prediction.spread**2 + prediction.variance).rsqrt()
    told = in_chunks(len(weight), lambda cut: prediction.lobe[cut].isfinite().all(-1))
    sound = weight.isfinite() & told
    return replace(
        priors,
        lobe=in_chunks(len(weight), lambda cut: torch.where(sound[cut, None], prediction.lobe[cut], 0.0)),
        lobe_weight=torch.where(sound, weight, 0.0),
    )
