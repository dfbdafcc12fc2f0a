"""One picture as a linear combination of three (Shashua), robust against highlights and shadows.

In the n_d-root domain, over the pixels p that are diffuse and lit in all four pictures,

    e_p = (y_p - x_p . alpha) / sqrt(1 + |alpha|^2)

is noise alone. All four pictures are noisy alike, so the distance to the plane is minimised (total least squares) and
not the error in y, which would pull alpha towards zero. In order:

1. Selection by rank: the brightest pixels of each picture (highlights) and those that any of the four pictures leaves
   dark against the pixel's own brightest (shadows) are left out.
2. Least median of squares over random small samples finds the majority's plane; a fixed seed, so always the same.
3. Tukey's biweight, reweighted from there: M = sum w (x, y)^T (x, y); alpha from its smallest eigenvector.
4. Sandwich covariance over tiles of the picture, because the residuals of neighbouring pixels are alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.errors import LightError

TUKEY = 4.685
MAD_TO_SIGMA = 1.4826
LARGEST_PICTURE = 1 << 22
"""Pixels that are looked at."""


@dataclass(frozen=True, kw_only=True)
class EstimateSettings:
    """How alpha is estimated from pictures."""

    n_d: float = 1.0
    brightest: float = 0.05
    """Share of the pixels left out at the bright end of each picture."""
    faintest: float = 0.10
    """Share of the pixels left out at the dark end, by their brightest picture (noise only)."""
    shadow_ratio: float = 0.15
    """A pixel is shadowed where one of the four roots is below this share of its largest."""
    hypotheses: int = 512
    sample: int = 4
    """Pixels a hypothesis is made from."""
    score_pixels: int = 4096
    """Pixels that hypotheses are scored on."""
    iterations: int = 60
    tiles: int = 10
    """Tiles along each side of the picture, for the covariance."""
    minimum_pixels: int = 100
    most_pixels: int = 50_000
    """Of more values, evenly spread ones are used: they already pin alpha down, and time stays bounded."""
    separation: float = 2.5
    """Least ratio between the weakest signal and the noise that tell alpha apart."""
    largest: float = 30.0
    """Largest norm of alpha that is believed."""
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class AlphaEstimate:
    """Alpha of one light from the pictures."""

    alpha: Float[Tensor, "3"]
    sd: Float[Tensor, "3"]
    covariance: Float[Tensor, "3 3"]
    pixels: int
    """Values that passed the selection by rank."""
    inliers: float
    """Their mean weight, 0 to 1."""
    noise: float
    """Robust standard deviation of one root, in the n_d-root domain."""


def signed_root(values: Float[Tensor, "*shape"], exponent: float) -> Float[Tensor, "*shape"]:
    """sign(I) |I|^(1/exponent): the root that keeps the noise round zero where it is."""
    return values if exponent == 1.0 else torch.sign(values) * values.abs() ** (1.0 / exponent)


def estimate_alpha(
    basis: Float[Tensor, "3 channels height width"],
    picture: Float[Tensor, "channels height width"],
    usable: Bool[Tensor, "channels height width"],
    *,
    settings: EstimateSettings | None = None,
) -> AlphaEstimate:
    """Alpha such that `picture^(1/n_d) = sum_i alpha_i basis_i^(1/n_d)` on diffuse, lit pixels (Eq. 16).

    Args:
        basis: linear pictures under the basis lights.
        picture: linear picture under the light in question, on the same scale.
        usable: true where all four values may be used.
        settings: of the selection and of the solver.

    Raises:
        LightError: too few diffuse pixels, or pictures that do not tell alpha apart (repeated or coplanar basis
            lights, or an object that shows too few orientations).
    """
    settings = settings or EstimateSettings()
    # Of very large pictures every second, third ... row and column: far more than are looked at in the end.
    every = math.ceil((usable[0].numel() / LARGEST_PICTURE) ** 0.5)
    basis, picture, usable = (each[..., ::every, ::every] for each in (basis, picture, usable))
    roots = signed_root(torch.cat([basis, picture[None]]).double(), settings.n_d)
    chosen = select_diffuse(roots, usable, settings)
    count = int(chosen.sum())
    if count < settings.minimum_pixels:
        raise LightError(
            f"{count} pixels are diffuse and lit in all four pictures, expected at least {settings.minimum_pixels}; "
            "give the light's direction, or choose basis lights nearer to it"
        )
    stride = -(-count // settings.most_pixels)
    samples = roots[:, chosen][:, ::stride].mT  # (pixels, 4)
    scale = samples.abs().median().clamp_min(1e-300)
    alpha, sigma = _least_median(samples / scale, settings)
    alpha, sigma, weights = _reweighted(samples / scale, alpha, sigma, settings)
    covariance = _covariance(samples / scale, alpha, sigma, _tiles(chosen, settings.tiles)[::stride])
    return AlphaEstimate(
        alpha=alpha.float(),
        sd=covariance.diagonal().clamp_min(0).sqrt().float(),
        covariance=covariance.float(),
        pixels=count,
        inliers=float(weights.mean()),
        noise=float(sigma * scale),
    )


def select_diffuse(
    roots: Float[Tensor, "4 channels height width"],
    usable: Bool[Tensor, "channels height width"],
    settings: EstimateSettings,
) -> Bool[Tensor, "channels height width"]:
    """Pixels that by rank are neither highlights nor shadows in any of the four pictures."""
    inside = roots[:, usable]
    if inside.shape[1] == 0:
        return usable
    limit = _quantile(inside, 1.0 - settings.brightest)
    brightest = inside.amax(0)
    floor = _quantile(brightest[None], settings.faintest)
    good = (inside <= limit[:, None]).all(0) & (brightest >= floor) & (brightest > 0)
    good &= (inside > settings.shadow_ratio * brightest).all(0)
    chosen = torch.zeros_like(usable)
    chosen[usable] = good
    return chosen


def _quantile(values: Tensor, share: float) -> Tensor:
    """Quantile along the last axis by rank; torch.quantile refuses long rows."""
    rank = min(values.shape[1] - 1, max(0, round(share * (values.shape[1] - 1))))
    return values.kthvalue(rank + 1, dim=1).values


def _distance(samples: Tensor, alpha: Tensor) -> Tensor:
    """Distance of (x, y) samples (pixels, 4) to the planes of alpha (..., 3): (..., pixels)."""
    error = samples[:, 3] - alpha @ samples[:, :3].mT
    return error / (1.0 + alpha.square().sum(-1, keepdim=True)).sqrt()


def _least_median(samples: Tensor, settings: EstimateSettings) -> tuple[Tensor, Tensor]:
    """Alpha with the least median distance among random hypotheses, and the scale that its median stands for."""
    generator = torch.Generator().manual_seed(settings.seed)
    pick = torch.randint(samples.shape[0], (settings.hypotheses, settings.sample), generator=generator)
    x, y = samples[pick][..., :3], samples[pick][..., 3]
    # A ridge of rounding size keeps a sample of alike pixels solvable; its hypothesis then simply scores badly.
    gram = x.mT @ x + 1e-9 * torch.eye(3, dtype=x.dtype) * x.square().sum((1, 2))[:, None, None]
    alpha = torch.linalg.solve(gram, (x.mT @ y[..., None]))[..., 0]
    stride = max(1, samples.shape[0] // settings.score_pixels)
    median = _distance(samples[::stride], alpha).abs().median(dim=1).values
    best = int(median.argmin())
    return alpha[best], MAD_TO_SIGMA * median[best]


def _reweighted(
    samples: Tensor, alpha: Tensor, sigma: Tensor, settings: EstimateSettings
) -> tuple[Tensor, Tensor, Tensor]:
    """Tukey's biweight from a robust start: alpha, sigma, weights."""
    weights = torch.ones_like(samples[:, 0])
    tiny = 1e-9 * samples.square().mean().sqrt()
    for _ in range(settings.iterations):
        error = _distance(samples, alpha)
        sigma = torch.maximum(MAD_TO_SIGMA * error.abs().median(), tiny)
        weights = (1.0 - (error / (TUKEY * sigma)).square()).clamp_min(0).square()
        values, axes = torch.linalg.eigh(samples.mT @ (weights[:, None] * samples))
        _check_spread(values, settings)
        normal = axes[:, 0]
        if float(normal[:3].norm()) > settings.largest * abs(float(normal[3])):
            # The plane that noise alone separates holds no y: the basis pictures depend on one another.
            raise LightError(f"alpha would be larger than {settings.largest:g}: repeated or coplanar basis lights")
        update = -normal[:3] / normal[3]
        moved = (update - alpha).norm()
        alpha = update
        if moved < 1e-9 * (1.0 + alpha.norm()):
            break
    return alpha, sigma, weights


def _check_spread(eigenvalues: Tensor, settings: EstimateSettings) -> None:
    """Refuse samples whose weakest signal does not stand out of the noise, or out of rounding."""
    values = eigenvalues.clamp_min(0).sqrt()
    ratio = float(values[1] / values[0].clamp_min(1e-300))
    if ratio < settings.separation or float(values[1]) < 1e-6 * float(values[3]):
        raise LightError(
            f"the pictures do not tell alpha apart (weakest signal {ratio:.2g} times the noise, expected at least "
            f"{settings.separation:g}): repeated or coplanar basis lights, or too few surface orientations"
        )


def _tiles(chosen: Tensor, tiles: int) -> Tensor:
    """Index of the tile of every chosen value, in the order of boolean indexing."""
    _, rows, columns = torch.nonzero(chosen, as_tuple=True)
    height, width = chosen.shape[1:]
    return (rows * tiles // height) * tiles + columns * tiles // width


def _covariance(samples: Tensor, alpha: Tensor, sigma: Tensor, tile: Tensor) -> Tensor:
    """H^-1 G H^-1 with G summed over tiles: neighbours err alike, so tiles and not pixels are the independent draws."""
    x = samples[:, :3]
    unit = _distance(samples, alpha) / (TUKEY * sigma)
    inside = unit.abs() < 1
    core = (1.0 - unit.square()).clamp_min(0)
    slope = torch.where(inside, core * (1.0 - 5.0 * unit.square()), torch.zeros_like(core))
    gradient = (core.square() * (samples[:, 3] - x @ alpha))[:, None] * x
    sums = torch.zeros(int(tile.max()) + 1, 3, dtype=x.dtype).index_add_(0, tile, gradient)
    occupied = int(torch.unique(tile).numel())
    hessian = torch.linalg.pinv(x.mT @ (slope[:, None] * x), hermitian=True)
    small_sample = occupied / max(1, occupied - 3)
    covariance = small_sample * hessian @ (sums.mT @ sums) @ hessian
    if not math.isfinite(float(covariance.sum())):
        raise LightError("the spread of alpha is not a finite number; expected pictures with values of ordinary size")
    return covariance
