"""Eqs. 20 to 22 as a least-squares problem of blocks: one block a pixel.

    local   l = (d_11, d_12, d_13, d_21, ...; log B [; s_11, ...])       channel-major; 3 C + 1 [+ 3 C] numbers
    shared  g = (a_1, a_2, a_3, log n_s, log C_2, softness, ggx, log n_d [; delta_41, delta_42, ...])

ggx is 1 where the lobe is that of GGX microfacets and 0 where it is the paper's power; it is chosen, never solved for.
The crest of such a lobe is C_2 / 2, its argument in the mirror direction.

Residuals of a pixel: sqrt(lambda_j) (model - picture) / sigma for every channel and light, then the priors' rows:

    shape     (log B + log(|M d|^2 / M d . V) - log C_2) / tau       B d is C_2 (N.V) N.L_k, so B follows from d
    parallel  (d + s) off the direction of s, relative to |s|         whole and scattered light see one irradiance
    ratio     (d + s) / s against its neighbourhood                   how much scatters changes slowly over a surface
    lobe      B d / C_2 against its neighbourhood                     the surface's shape is smooth, whatever its albedo
    facing    B d / C_2 off the direction of d + s                    scattering blurs the normal, but not by much
    measured  (s - measured s) / its standard deviation               where s is unknown too
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.fit.mixing import Mixing, mixing
from reflectsep.kernel.compiling import Speed
from reflectsep.model import Globals, edge_width, reflectance

SHARED_NAMES = ("a_1", "a_2", "a_3", "log_n_s", "log_C_2", "softness", "ggx", "log_n_d")
LOG_N_S, LOG_C_2, SOFTNESS, GGX, LOG_N_D = 3, 4, 5, 6, 7
ALPHA = len(SHARED_NAMES)
"""Where what is added to the stated alphas begins, if they are refined."""

Moved = TypeVar("Moved", "Observations", "Priors")

LEAST_LOG_N_S = 1.4
"""log of 4: a broader lobe is no highlight but diffuse light that the diffuse part has not explained."""
MOST_LOG_N_S = 5.3
"""log of 200: a sharper lobe is a mirror image, of which a handful of directional lights sees single pixels."""


@dataclass(frozen=True, kw_only=True)
class Observations:
    """What is known of every pixel, flattened, for lights of unit intensity."""

    images: Float[Tensor, "pixels channels lights"]
    s: Float[Tensor, "pixels channels lights"]
    weight: Float[Tensor, "pixels channels lights"]
    """sqrt(lambda_j) / sigma; 0 removes a value."""
    clipped: Bool[Tensor, "pixels channels lights"]
    """Known only to be at least `images`."""
    alpha: Float[Tensor, "lights 3"]
    normal_map: Float[Tensor, "3 3"]
    """M, with M d along the surface normal: the inverse of the basis light directions."""
    view: Float[Tensor, "3"]
    cosine: Float[Tensor, "3"]
    """L_k . V of the basis lights; ones where unknown."""
    lights_known: bool
    n_d: float | None
    """The diffuse exponent; None where it is fitted."""
    n_d_swept: float = 1.0
    """The same by the sweeps: where its fit starts."""
    n_d_sd: float = 0.05
    """Standard deviation of log `n_d_swept`."""
    swept: tuple[bool, ...] = ()
    """Of every light: its s was measured, not mixed; empty: only those of the basis."""
    s_unknown: bool = False
    """The scattering roots of the basis lights are local unknowns too."""
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    """Where chunks of pixels are searched and solved."""
    fused: Speed | None = None
    """How the compiled solver runs; None: the plain one."""

    def __len__(self) -> int:
        """Number of pixels."""
        return len(self.images)

    @property
    def channels(self) -> int:
        """Number of channels."""
        return self.images.shape[1]

    @property
    def s_basis(self) -> Float[Tensor, "pixels channels 3"]:
        """Scattering roots of the basis lights."""
        return self.s[..., :3]

    def take(self, index: Tensor | slice) -> Observations:
        """Some of the pixels."""
        return replace(
            self,
            images=self.images[index],
            s=self.s[index],
            weight=self.weight[index],
            clipped=self.clipped[index],
        )

    def there(self) -> Observations:
        """The same on the device where it is to be worked on."""
        return moved(self, self.device)


@dataclass(frozen=True, kw_only=True)
class Priors:
    """What is expected of a pixel before its pictures are looked at; a weight of 0 switches a row off."""

    shape: float = 1.0 / 0.1
    """1 / tau of the shape row."""
    parallel: Float[Tensor, "pixels"]
    ratio: Float[Tensor, "pixels"]
    ratio_weight: Float[Tensor, "pixels"]
    lobe: Float[Tensor, "pixels 3"]
    """B d / C_2 = (N.V)(N.L_k) as the neighbours have it."""
    lobe_weight: Float[Tensor, "pixels"]
    """1 / standard deviation of that."""
    facing: Float[Tensor, "pixels 3"]
    """Unit vector along d + s, which is that of N.L_k up to what scattering blurs."""
    facing_weight: Float[Tensor, "pixels"]
    """1 / standard deviation of the lobe across that direction."""
    s_weight: Float[Tensor, "pixels"]
    """1 / standard deviation of the measured s; only where s is a local unknown."""
    mirror_sd: float = 0.02
    """Standard deviation of log(C_2 / -2 C_1): 0 for a lobe about the mirror direction."""
    common_sd: float = 0.01
    """Relative standard deviation of a_k / (L_k . V) among the basis lights."""
    height: float = 1.0
    """Highest peak of the lobe that is not penalised."""
    height_sd: float = 0.03
    """Standard deviation of the logarithm of the excess. Rough surfaces are no cosine lobes, and thousands of pixels
    that agree on a wrong shape outvote any soft bound on it: the three bounds of the lobe are firm."""
    exponent_sd: float = 0.001
    """The same of log n_s beyond `LEAST_LOG_N_S` and `MOST_LOG_N_S`."""
    log_n_d: float = 0.0
    n_d_sd: float = 0.05
    """n_d by the sweeps, and the standard deviation of its logarithm."""
    softness_sd: float = 0.3
    alpha_sd: float = 0.02
    """Standard deviation of a stated alpha, of lights of unit intensity."""

    def take(self, index: Tensor | slice) -> Priors:
        """Some of the pixels."""
        return replace(
            self,
            parallel=self.parallel[index],
            ratio=self.ratio[index],
            ratio_weight=self.ratio_weight[index],
            lobe=self.lobe[index],
            lobe_weight=self.lobe_weight[index],
            facing=self.facing[index],
            facing_weight=self.facing_weight[index],
            s_weight=self.s_weight[index],
        )


def moved(values: Moved, device: torch.device) -> Moved:
    """Observations or priors with their tensors on a device."""
    return replace(values, **{k: v.to(device) for k, v in vars(values).items() if isinstance(v, Tensor)})


def no_priors(pixels: int, like: Tensor) -> Priors:
    """Priors whose rows of single pixels are all switched off."""
    zero = like.new_zeros(pixels)
    vector = like.new_zeros(pixels, 3)
    return Priors(
        shape=0.0,
        parallel=zero,
        ratio=zero,
        ratio_weight=zero,
        lobe=vector,
        lobe_weight=zero,
        facing=vector,
        facing_weight=zero,
        s_weight=zero,
    )


@dataclass(frozen=True)
class Locals:
    """A pixel's unknowns by name."""

    d: Float[Tensor, "pixels channels 3"]
    log_B: Float[Tensor, "pixels"]  # noqa: N815
    s: Float[Tensor, "pixels channels 3"] | None

    @property
    def B(self) -> Float[Tensor, "pixels"]:  # noqa: N802  (the paper's symbol)
        """The lobe's factor."""
        return self.log_B.exp()

    def take(self, index: Tensor | slice) -> Locals:
        """Some of the pixels."""
        return Locals(self.d[index], self.log_B[index], None if self.s is None else self.s[index])

    def pack(self) -> Float[Tensor, "pixels P"]:
        """As one row a pixel."""
        parts = [self.d.flatten(-2), self.log_B[..., None]]
        return torch.cat(parts if self.s is None else [*parts, self.s.flatten(-2)], -1)


def unpack(local: Tensor, channels: int) -> Locals:
    """One row a pixel, by name."""
    P = 3 * channels
    d = local[..., :P].unflatten(-1, (channels, 3))
    s = local[..., P + 1 :].unflatten(-1, (channels, 3)) if local.shape[-1] > P + 1 else None
    return Locals(d, local[..., P], s)


def mixing_of(obs: Observations, shared: Float[Tensor, "G"]) -> Mixing:
    """Alphas as `shared` has them."""
    return mixing(obs.alpha, shared[ALPHA:], torch.linalg.inv(obs.normal_map) if obs.lights_known else None)


def alpha_of(obs: Observations, shared: Float[Tensor, "G"]) -> Float[Tensor, "lights 3"]:
    """Alphas as `shared` has them, the stated ones where they are held."""
    return obs.alpha if len(shared) == ALPHA else mixing_of(obs, shared).alpha


def refined(obs: Observations, shared: Float[Tensor, "G"]) -> Observations:
    """`obs` as the refined alphas see them: pictures, weights and mixed scattering of lights of unit intensity.

    The same where alphas are held, and then `obs` itself.
    """
    if len(shared) == ALPHA:
        return obs
    mixed = mixing_of(obs, shared)
    own = torch.tensor(obs.swept or [False] * len(obs.alpha), device=obs.images.device)
    change = obs.s_basis @ (mixed.alpha - obs.alpha).mT
    return replace(
        obs,
        alpha=mixed.alpha,
        images=obs.images / mixed.intensity,
        weight=obs.weight * mixed.intensity,
        s=obs.s + torch.where(own, 0.0, change),
    )


def unpack_globals(shared: Float[Tensor, "G"], n_d: float | None) -> Globals:
    """The shared unknowns by name, in the model's own parameters; `n_d` where it is not fitted."""
    return Globals(
        a=shared[:3],
        n_s=shared[LOG_N_S].exp(),
        n_d=shared[LOG_N_D].exp() if n_d is None else n_d,
        softness=shared[SOFTNESS],
        crest=(shared[GGX] > 0).to(shared.dtype) * 0.5 * shared[LOG_C_2].exp(),
    )


def linear(x: Float[Tensor, "*pixels 3"], M: Float[Tensor, "n 3"]) -> Float[Tensor, "*pixels n"]:
    """M x of every pixel, by the same additions however many pixels there are, which a matrix product is not."""
    return x[..., :1] * M[:, 0] + x[..., 1:2] * M[:, 1] + x[..., 2:] * M[:, 2]


def log_shape(d: Float[Tensor, "*pixels 3"], M: Tensor, view: Tensor, known: bool) -> Float[Tensor, "*pixels"]:
    """Log of |M d|^2 / (M d . V), or of mean_k d where the lights are unknown: C_2 / B by the lobe's geometry.

    d_k = q N.L_k gives M d = q N; and B d_k = C_2 (N.V)(N.L_k) (Eqs. 6, 7 and 18), hence B = C_2 (N.V) / q.
    """
    if not known:
        mean = d.mean(-1)
        return (0.5 * (mean + (mean.square() + 1e-8).sqrt())).log()
    g = linear(d, M)
    facing = linear(g, view[None])[..., 0]
    # Smooth stand-ins for max(., 0): a normal turned away must not make the row infinite.
    facing = 0.5 * (facing + (facing.square() + 1e-6).sqrt())
    return (g.square().sum(-1) + 1e-6).log() - facing.log()


def shape_row(log_B: Tensor, d_mean: Float[Tensor, "*pixels 3"], shared: Tensor, obs: Observations) -> Tensor:
    """Log B less its value by the lobe's geometry; 0 on a surface of one gloss."""
    return log_B + log_shape(d_mean, obs.normal_map, obs.view, obs.lights_known) - shared[LOG_C_2]


def normalised_lobe(x: Locals, shared: Tensor) -> Float[Tensor, "pixels 3"]:
    """B mean_c d / C_2, which is (N.V)(N.L_k): a matter of shape alone."""
    return x.B[:, None] * x.d.mean(-2) / shared[LOG_C_2].exp()


def across(v: Float[Tensor, "pixels 3"], direction: Float[Tensor, "pixels 3"]) -> Float[Tensor, "pixels 3"]:
    """The part of v that is not along the unit vector `direction`."""
    return v - (v * direction).sum(-1, keepdim=True) * direction


def s_of_lights(x: Locals, obs: Observations) -> Float[Tensor, "pixels channels lights"]:
    """Scattering roots of every light: as measured, moved by the mix of what the fit changed of the basis."""
    return obs.s if x.s is None else obs.s + (x.s - obs.s_basis) @ obs.alpha.mT


def pixel_residual(
    local: Tensor, shared: Tensor, obs: Observations, priors: Priors
) -> Float[Tensor, "pixels residuals"]:
    """Residuals of every pixel, pictures first, then the priors' rows."""
    obs = refined(obs, shared)
    x = unpack(local, obs.channels)
    s = obs.s_basis if x.s is None else x.s
    model = reflectance(
        x.d,
        x.B,
        unpack_globals(shared, obs.n_d),
        s=s_of_lights(x, obs),
        alpha=obs.alpha,
        width=edge_width(obs.s_basis, shared[SOFTNESS]),
    )
    misfit = model - obs.images
    # A clipped value is only a lower bound: a brighter model costs nothing.
    misfit = torch.where(obs.clipped, misfit.clamp_max(0.0), misfit)
    rows = [(misfit * obs.weight).flatten(-2)]

    rows.append((priors.shape * shape_row(x.log_B, x.d.mean(-2), shared, obs))[..., None])

    whole, power = x.d + s, s.square().sum(-1, keepdim=True) + 1e-9
    along = (whole * s).sum(-1, keepdim=True) / power
    rows.append((priors.parallel[..., None, None] * (whole - along * s)).flatten(-2))
    rows.append(priors.ratio_weight[..., None] * (along[..., 0].mean(-1, keepdim=True) - priors.ratio[..., None]))
    lobe = normalised_lobe(x, shared)
    rows.append(priors.lobe_weight[..., None] * (lobe - priors.lobe))
    rows.append(priors.facing_weight[..., None] * across(lobe, priors.facing))
    if x.s is not None:
        rows.append((priors.s_weight[..., None, None] * (x.s - obs.s_basis)).flatten(-2))
    return torch.cat(rows, -1)


def shared_residual(shared: Tensor, cosine: Tensor, priors: Priors) -> Float[Tensor, "rows"]:
    """Priors of the shared parameters (method: a physical lobe is bounded and about the mirror direction)."""
    C_1 = shared[:3] / cosine
    mean = C_1.mean()
    log_C_1 = (-mean).clamp_min(1e-3).log()
    excess = shared[LOG_N_S].exp() * log_C_1 - math.log(priors.height)
    rows = torch.stack(
        [
            (shared[LOG_C_2] - log_C_1 - math.log(2.0)) / priors.mirror_sd,
            excess.clamp_min(0.0) / priors.height_sd,
            (shared[LOG_N_S] - MOST_LOG_N_S).clamp_min(0.0) / priors.exponent_sd,
            (LEAST_LOG_N_S - shared[LOG_N_S]).clamp_min(0.0) / priors.exponent_sd,
            (shared[LOG_N_D] - priors.log_n_d) / priors.n_d_sd,
            shared[SOFTNESS] / priors.softness_sd,
        ]
    )
    return torch.cat([(C_1 / mean - 1.0) / priors.common_sd, rows, shared[ALPHA:] / priors.alpha_sd])
