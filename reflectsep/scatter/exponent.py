"""Eq. 25: the exponent n_d, one for all sweeps, and the gain C of each.

    C I^(1/n_d) = sum_i I_seq,i^(1/n_d)

Both sides are noisy, and a plain fit puts the full picture's noise into n_d (method of errors in variables). Here
pixels are put into bins by an instrument, the full picture blurred over their neighbours without themselves, whose
noise has nothing to do with theirs. The mean over a bin of either side is then free of selection, and at the true
exponent the equation holds between the means, whatever the spread in the bin. What is left is the curvature of the
root under noise, E[(I+e)^(1/n)] = I^(1/n) (1 + (1/n)(1/n-1) var/2 I^2), which is taken off.

Light adds in radiance, so 1 is what a linear camera gives. An estimate within three standard deviations of 1 is 1: C
goes with n_d, and the noise of n_d would cost it a percent on a small picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from torch import Tensor

from reflectsep.scatter.frames import signed_root
from reflectsep.scatter.local import quantile

GRID = tuple(2.0 ** (i / 4) for i in range(-6, 7))
"""Exponents for which the roots are summed; between them logarithms are interpolated."""
BINS = 12
FLOOR = 5e-4
"""Relative error of a bin that is always allowed for: camera and stage are no better."""
IDENTIFIABLE_SD = 0.02
UNKNOWN_SD = GRID[-1] - GRID[0]
"""Standard deviation of an exponent that the data say nothing of: the range that was searched."""


@dataclass(frozen=True, kw_only=True)
class Samples:
    """Values of one sweep that enter Eq. 25; N of them, over pixels and channels."""

    full: Float[Tensor, "N"]
    instrument: Float[Tensor, "N"]
    sums: Float[Tensor, "exponents N"]
    noise: float
    """Upper bound of the full picture's standard deviation."""


@dataclass(frozen=True, kw_only=True)
class Exponent:
    """What Eq. 25 gave."""

    n_d: float
    n_d_sd: float
    identifiable: bool
    gains: tuple[float, ...]
    gains_sd: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class _Bins:
    """Logarithm of sum over root, by exponent and bin, with its relative variance."""

    log_ratio: np.ndarray
    variance: np.ndarray


def solve_exponent(samples: list[Samples], exponents: tuple[float, ...]) -> Exponent:
    """Solve Eq. 25 over all sweeps.

    Args:
        samples: one item a sweep.
        exponents: rows of their sums; a single one holds n_d fixed.

    Returns:
        n_d with its standard deviation, and the gains at it. Where n_d cannot be told, or from 1, it is 1.
    """
    n_d, sd, identifiable = exponents[0], 0.0, True
    if len(exponents) > 1:
        n_d, sd = 1.0, float("inf")
        for _ in range(2):
            bins = [_binned(s, exponents, n_d) for s in samples]
            n_d, sd = _minimum(bins, np.log(np.asarray(exponents)))
        identifiable = sd <= IDENTIFIABLE_SD
        if not identifiable or abs(n_d - 1.0) < 3.0 * sd:
            n_d = 1.0
    bins = [_binned(s, exponents, n_d) for s in samples]
    gains = [_gain(b, np.log(np.asarray(exponents)), np.log(n_d)) for b in bins]
    return Exponent(
        n_d=float(n_d),
        n_d_sd=float(min(sd, UNKNOWN_SD)),
        identifiable=identifiable,
        gains=tuple(float(g) for g, _ in gains),
        gains_sd=tuple(float(s) for _, s in gains),
    )


def complete(total: Tensor, full: Tensor, part: float = 0.75) -> Tensor:
    """Whether a sweep's sum holds all the light of the full picture: the slab reached all that feeds a pixel.

    A shadowed pixel passes too: the light in it came through the body, from where the slab did pass.
    """
    ratio = total / full
    return ratio > 0.7 * quantile(ratio, part)


def _binned(samples: Samples, exponents: tuple[float, ...], n_d: float) -> _Bins:
    order = samples.instrument.argsort()
    edges = np.linspace(0, len(order), min(BINS, max(2, len(order) // 8)) + 1).astype(int)
    groups = [order[a:b] for a, b in pairwise(edges) if b > a]
    nearest = int(np.argmin(np.abs(np.log(np.asarray(exponents)) - np.log(n_d))))
    noise = _noise(samples, nearest, exponents[nearest])
    log_ratio = np.empty((len(exponents), len(groups)))
    for i, n in enumerate(exponents):
        p = 1.0 / n
        # Near zero the series below has no meaning; such pixels are not sampled, the clamp is for outliers.
        size = samples.instrument.clamp(min=3 * noise + 1e-12)
        root = signed_root(samples.full, n) - 0.5 * p * (p - 1) * noise**2 * size ** (p - 2)
        for b, group in enumerate(groups):
            log_ratio[i, b] = _log(samples.sums[i][group].mean()) - _log(root[group].mean())
    return _Bins(log_ratio=log_ratio, variance=_variance(samples, groups, nearest, exponents[nearest]))


def _log(value: Tensor) -> float:
    return float(value.clamp(min=1e-30).log())


def _residual(samples: Samples, i: int, n_d: float) -> Tensor:
    """Full picture minus what the sum says of it, in the full picture's units."""
    root = signed_root(samples.full, n_d)
    gain = samples.sums[i].sum() / root.sum()
    predicted = signed_root(samples.sums[i] / gain, 1.0 / n_d)
    return samples.full - predicted


def _noise(samples: Samples, i: int, n_d: float) -> float:
    """The smaller of two bounds: fine structure in the full picture, and what Eq. 25 leaves over."""
    residual = _residual(samples, i, n_d)
    return min(samples.noise, float(1.4826 * (residual - residual.median()).abs().median()))


def _variance(samples: Samples, groups: list[Tensor], i: int, n_d: float) -> np.ndarray:
    """Squared relative error of a bin's mean, in units of the full picture."""
    residual = _residual(samples, i, n_d)
    found = []
    for group in groups:
        spread = residual[group] - residual[group].median()
        error = 1.4826 * spread.abs().median() / len(group) ** 0.5 / samples.full[group].mean()
        found.append(float(error) ** 2 + FLOOR**2)
    return np.asarray(found)


def _gain(bins: _Bins, log_exponents: np.ndarray, log_n: float) -> tuple[float, float]:
    """C and its standard deviation at an exponent."""
    values, weights = _at(bins, log_exponents, np.asarray([log_n]))[0], np.exp(2 * log_n) / bins.variance
    mean = (weights * values).sum() / weights.sum()
    excess = (weights * (values - mean) ** 2).sum() / max(1, len(values) - 1)
    gain = np.exp(mean)
    return gain, gain * np.sqrt(max(1.0, excess) / weights.sum())


def _at(bins: _Bins, log_exponents: np.ndarray, log_n: np.ndarray) -> np.ndarray:
    """Log ratios at any exponent: local cubics through the grid, (exponents, bins)."""
    if len(log_exponents) == 1:
        return np.repeat(bins.log_ratio, len(log_n), axis=0)
    start = np.clip(np.searchsorted(log_exponents, log_n) - 2, 0, len(log_exponents) - 4)
    nodes = log_exponents[start[:, None] + np.arange(4)]
    result = np.zeros((len(log_n), bins.log_ratio.shape[1]))
    for i in range(4):
        factor = np.ones(len(log_n))
        for j in set(range(4)) - {i}:
            factor = factor * (log_n - nodes[:, j]) / (nodes[:, i] - nodes[:, j])
        result += factor[:, None] * bins.log_ratio[start + i]
    return result


def _minimum(bins: list[_Bins], log_exponents: np.ndarray) -> tuple[float, float]:
    """Exponent of least cost, and its standard deviation from the curvature there."""
    fine = np.linspace(log_exponents[0], log_exponents[-1], 4001)
    cost, residuals = np.zeros(len(fine)), 0
    for b in bins:
        values, weights = _at(b, log_exponents, fine), 1.0 / b.variance
        mean = (values * weights).sum(1, keepdims=True) / weights.sum()
        # In units of the full picture an error of a root counts n times.
        cost += (weights * (np.exp(fine)[:, None] * (values - mean)) ** 2).sum(1)
        residuals += len(weights) - 1
    k = int(np.clip(cost.argmin(), 8, len(fine) - 9))
    n = np.exp(fine[k - 8 : k + 9])
    a, b_, c = np.polyfit(n - n[8], cost[k - 8 : k + 9], 2)
    if a <= 0 or cost.argmin() in (0, len(fine) - 1):
        return 1.0, float("inf")
    best = n[8] + float(np.clip(-b_ / (2 * a), n[0] - n[8], n[-1] - n[8]))
    least = max(0.0, c - b_**2 / (4 * a))
    return float(best), float(np.sqrt(max(1.0, least / max(1, residuals - 1)) / a))
