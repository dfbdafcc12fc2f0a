"""Eqs. 20 to 22 as a least-squares problem of blocks: one block a pixel, pixels last in memory.

    local   l = (d_11, d_12, .., d_1C, d_21, .., d_3C; log B)         basis light by basis light; 3 C + 1 numbers
    shared  g = (log -a_1, log -a_2, log -a_3, log n_s, f, softness, fresnel, log n_d [; delta_41, delta_42, ..]
                 [; log C_1 of material 2 over that of the first, its log n_s; of material 3 ..])

Residuals of a pixel are (model - picture) / sigma for every light and channel, clipped values counting only where the
model is darker, large ones by Huber's loss; and two rows of what is expected of a pixel before its pictures are seen:

    height      n_s (log |w| - log C_1) / spread          a surface of one gloss has highlights of one height
    neighbours  R (B m / 2 C_1 - v0)                      the lobe's vector is that of the pixels around, R^T R its
                                                          precision; see `reflectsep.fit.neighbours`

Everything but the body's own slopes reaches the unknowns through z = B m alone, three numbers a pixel:

    dz = (B / C) sum_c dd_c + B m dlog B

so that with Phi_cj = d body / d d_c, G_j = d F_j / d z and the rows' Hz, gz the normal equations are

    V(d_c, d_e) = [c = e] sum_j Phi Phi^T + (B/C) (K_c + K_e^T) + (B/C)^2 Hz           K_c = sum_j Phi_cj G_j^T
    V(d_c, log B) = (K_c + (B/C) Hz) z,    V(log B, log B) = z^T Hz z.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd import forward_ad

from reflectsep.model import (
    Globals,
    length,
    lobe_by_exponent,
    lobe_with_slopes,
    mixed,
    positive_power,
    reflectance,
    transmitted_by_globals,
    transmitted_with_slope,
)
from reflectsep.solve.levenberg import Normal

SHARED_NAMES = ("log_a_1", "log_a_2", "log_a_3", "log_n_s", "f", "softness", "fresnel", "log_n_d")
LOG_N_S, F, SOFTNESS, FRESNEL, LOG_N_D = 3, 4, 5, 6, 7
ALPHA = len(SHARED_NAMES)
"""Where what is added to the stated alphas begins, if they are refined."""

COMMON_SD = 0.01
"""Relative standard deviation of a_k / (L_k . V) among the basis lights: Eq. 7 makes them one number, C_1."""
LOG_N_S_CENTRE, LOG_N_S_SD = math.log(20.0), 1.5
"""What is expected of n_s before any picture is seen: it decides only where no picture does."""
LEAST_N_S, MOST_N_S = 1.0, 5000.0
"""A lobe of GGX roughness 0.7 is the roughest that is told from a body, one of 0.014 is a mirror."""
LEAST_N_S_OTHER = 2.5
"""The same of a further material, roughness 0.53: a rougher one would take up what is wrong with the body's shading."""
SOFTNESS_SD = 0.5
FRESNEL_SD = 0.5


@dataclass(frozen=True, kw_only=True)
class Observations:
    """What is known of every pixel, flattened, for lights of unit intensity."""

    images: Float[Tensor, "lights channels pixels"]
    s: Float[Tensor, "lights channels pixels"]
    """Scattering roots."""
    clipped: Bool[Tensor, "lights channels pixels"]
    """Known only to be at least `images`."""
    alpha: Float[Tensor, "lights 3"]
    M: Float[Tensor, "3 3"]
    """Inverse of the basis lights' directions; the identity where they are unknown."""
    view: Float[Tensor, "3"]
    cosine: Float[Tensor, "3"]
    """L_k . V of the basis lights; ones where unknown."""
    lights_known: bool
    ggx: bool
    fixed_n_d: float | None
    """The diffuse exponent; None where it is fitted."""
    n_d: float = 1.0
    """The same by the sweeps: where its fit starts."""
    n_d_sd: float = 0.05
    """Standard deviation of its logarithm."""
    swept: tuple[bool, ...] = ()
    """Of every light: its s was measured, not mixed; empty: only those of the basis."""
    share: Float[Tensor, "lights 1 1"]
    """sqrt(lambda_j) of Eq. 22."""
    kinds: int = 1
    """Materials, each with a height and an exponent of its own."""
    material: Int[Tensor, "pixels"] | None = None
    """Which of them a pixel is of; None where there is one."""

    def __len__(self) -> int:
        """Number of pixels."""
        return self.images.shape[-1]

    @property
    def channels(self) -> int:
        """Number of channels."""
        return self.images.shape[1]

    def take(self, index: Tensor | slice) -> Self:
        """Some of the pixels, in the precision of the arithmetic."""
        kind = self.alpha.dtype
        return replace(
            self,
            images=self.images[..., index].to(kind),
            s=self.s[..., index].to(kind),
            clipped=self.clipped[..., index],
            material=None if self.material is None else self.material[index],
        )


@dataclass(frozen=True, kw_only=True)
class Neighbours:
    """What the pixels around say of a pixel's lobe."""

    vector: Float[Tensor, "3 pixels"]
    """B m / 2 C_1, which is (N.V)(N.L_k) on an ideal surface."""
    R: Float[Tensor, "6 pixels"]
    """Upper triangle, row by row, of a root of its precision: R^T R."""

    def take(self, index: Tensor | slice) -> Neighbours:
        """Some of the pixels."""
        return Neighbours(vector=self.vector[..., index], R=self.R[..., index])

    def rows(self, v: Float[Tensor, "3 pixels"]) -> Float[Tensor, "3 pixels"]:
        """R (v - v0)."""
        return upper_times(self.R, v - self.vector)

    def precision(self) -> Float[Tensor, "3 3 pixels"]:
        """R^T R."""
        R = self.R.new_zeros(3, 3, self.R.shape[-1])
        for entry, (i, j) in zip(self.R, UPPER, strict=True):
            R[i, j] = entry
        return torch.einsum("kin,kjn->ijn", R, R)


UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def upper_times(R: Float[Tensor, "6 *rest"], v: Float[Tensor, "3 *rest"]) -> Float[Tensor, "3 *rest"]:
    """R v of an upper triangular R."""
    return torch.stack([R[0] * v[0] + R[1] * v[1] + R[2] * v[2], R[3] * v[1] + R[4] * v[2], R[5] * v[2]])


def globals_of(shared: Float[Tensor, "G"], obs: Observations) -> Globals:
    """The shared unknowns by name."""
    a, n_s = -shared[:3].exp(), shared[LOG_N_S].exp()
    if obs.material is not None:
        scale, exponent = materials_of(shared, obs.kinds)
        a, n_s = a[:, None] * scale.exp()[obs.material], exponent.exp()[obs.material]
    return Globals(
        a=a,
        n_s=n_s,
        n_d=shared[LOG_N_D].exp() if obs.fixed_n_d is None else obs.fixed_n_d,
        f=shared[F],
        softness=shared[SOFTNESS],
        fresnel=shared[FRESNEL],
        ggx=obs.ggx,
        M=obs.M,
    )


def materials_of(shared: Float[Tensor, "G"], kinds: int) -> tuple[Float[Tensor, "K"], Float[Tensor, "K"]]:
    """Log of every material's C_1 over that of the first, and log of its n_s."""
    others = shared[len(shared) - 2 * (kinds - 1) :].view(-1, 2)
    return (torch.cat([torch.zeros_like(shared[:1]), others[:, 0]]), torch.cat([shared[LOG_N_S, None], others[:, 1]]))


def deltas(shared: Float[Tensor, "G"], obs: Observations) -> Float[Tensor, "others*3"]:
    """What is added to the stated alphas; empty where they are held."""
    return shared[ALPHA : len(shared) - 2 * (obs.kinds - 1)]


def log_size(shared: Float[Tensor, "G"], obs: Observations) -> Tensor:
    """Log of -C_1 = |w| in the mirror direction: a_k / (L_k . V) of the basis lights, averaged; of every pixel."""
    size = (shared[:3] - obs.cosine.log()).mean()
    if obs.material is not None:
        size = size + materials_of(shared, obs.kinds)[0][obs.material]
    return size if obs.lights_known else size + math.log(3.0) / 2.0  # |a| itself, M being the identity


@dataclass(frozen=True)
class Refined:
    """Lights as refined alphas see them."""

    obs: Observations
    intensity: Float[Tensor, "lights"]


def refined(obs: Observations, shared: Float[Tensor, "G"]) -> Refined:
    """`obs` with refined alphas: I_j = t_j I(beta_j / t_j), beta = alpha + delta, t_j = |sum_i beta_ji L_i|.

    The length of the mixed vector is the light's intensity, which scales the picture and stays out of the powers. The
    basis lights' own rows stay the identity: they set the scale of d and s.
    """
    added = deltas(shared, obs)
    if len(added) == 0:
        return Refined(obs, torch.ones_like(obs.alpha[:, 0]))
    beta = torch.cat([obs.alpha[:3], obs.alpha[3:] + added.view(-1, 3)])
    t = torch.ones_like(beta[:, 0])
    if obs.lights_known:
        t = torch.cat([t[:3], (beta[3:] @ torch.linalg.inv(obs.M)).norm(dim=-1)])
    alpha = beta / t[:, None]
    own = torch.tensor(obs.swept or [False] * len(alpha), device=alpha.device)[:, None, None]
    change = mixed(alpha - obs.alpha, obs.s[:3])
    return Refined(replace(obs, alpha=alpha, s=obs.s + torch.where(own, 0.0, change)), t)


@dataclass(frozen=True, kw_only=True)
class PixelProblem:
    """All pixels under what is observed and expected of them."""

    obs: Observations
    sigma: float
    """Standard deviation of a residual."""
    height_spread: float
    """Standard deviation of the logarithm of a highlight's height about the one of the whole; inf: none expected."""
    neighbours: Neighbours | None = None
    huber: float | None = 5.0
    """Residuals beyond this many standard deviations are cast shadows or inter-reflections; None: plain squares."""
    priors: bool = True
    """Whether anything is expected of the globals beyond what makes them a lobe."""
    alpha_sd: float = 0.02
    weight: Float[Tensor, "lights 1 1"] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "weight", self.obs.share / self.sigma)

    def __len__(self) -> int:
        """Number of pixels."""
        return len(self.obs)

    def take(self, index: Tensor | slice) -> Self:
        """Some of the pixels."""
        near = None if self.neighbours is None else self.neighbours.take(index)
        return replace(self, obs=self.obs.take(index), neighbours=near)

    def unpacked(self, local: Float[Tensor, "P pixels"]) -> tuple[Tensor, Tensor]:
        """D (3, channels, pixels) and B (pixels)."""
        return local[:-1].unflatten(0, (3, self.obs.channels)), local[-1].exp()

    def packed(self, d: Float[Tensor, "3 channels pixels"], log_B: Float[Tensor, "pixels"]) -> Tensor:
        """Local unknowns from d and log B."""
        return torch.cat([d.flatten(0, 1), log_B[None]])

    def scattering(self, local: Float[Tensor, "P pixels"]) -> Float[Tensor, "3 channels pixels"]:  # noqa: ARG002
        """Scattering roots of the basis lights: as measured."""
        return self.obs.s[:3]

    def residuals(self, local: Float[Tensor, "P pixels"], shared: Float[Tensor, "G"]) -> Float[Tensor, "rows pixels"]:
        """Rows of every pixel, pictures first, before the robust loss; differentiable in both arguments."""
        light = refined(self.obs, shared)
        obs, g = light.obs, globals_of(shared, self.obs)
        d, B = self.unpacked(local)
        model = reflectance(d, B, g, s=obs.s[:3], alpha=obs.alpha, s_lights=obs.s)
        misfit = model * light.intensity[:, None, None] - obs.images
        # A clipped value is only a lower bound: a brighter model costs nothing.
        misfit = torch.where(obs.clipped, misfit.clamp_max(0.0), misfit)
        rows = [(misfit * self.weight).flatten(0, 1)]
        z = B * (d + (1.0 - g.f) * obs.s[:3]).mean(1)
        if math.isfinite(self.height_spread):
            size = length(g.M, g.a.view(3, -1) + z)
            rows.append((g.n_s * (size.log() - log_size(shared, obs)) / self.height_spread)[None])
        if self.neighbours is not None:
            rows.append(self.neighbours.rows(z / (2.0 * log_size(shared, obs).exp())))
        return torch.cat(rows)

    def robust(self, rows: Float[Tensor, "rows pixels"]) -> tuple[Tensor, Tensor]:
        """Cost of every pixel, and the weight of each row in the normal equations."""
        count = self.obs.images.shape[0] * self.obs.channels
        size = rows[:count].abs()
        if self.huber is None:
            return 0.5 * rows.square().sum(0), torch.ones_like(rows)
        loss = torch.where(size < self.huber, 0.5 * size.square(), self.huber * (size - 0.5 * self.huber))
        weight = torch.ones_like(rows)
        weight[:count] = self.huber / size.clamp_min(self.huber)
        return loss.sum(0) + 0.5 * rows[count:].square().sum(0), weight

    def _slopes(self, local: Tensor, shared: Tensor) -> _Slopes:
        light = refined(self.obs, shared)
        obs, g = light.obs, globals_of(shared, self.obs)
        d, B = self.unpacked(local)
        s = obs.s[:3]
        t = light.intensity[:, None, None]
        x = mixed(obs.alpha, d) + obs.s
        b = d + s
        Mb = mixed(g.M, b)
        q = (Mb.square().sum(0) + 1e-12).sqrt()
        c = x / q
        T, slope = transmitted_with_slope(c, g.softness, g.fresnel)
        body = q * T
        by_q = T - c * slope
        if not (isinstance(g.n_d, float) and g.n_d == 1.0):
            power = positive_power(body, g.n_d)
            # Per unit of q T, which is what the globals of the shading change.
            chain = g.n_d * power / body.clamp_min(1e-30)
            body, slope, by_q = power, slope * chain, by_q * chain
        else:
            chain = torch.ones_like(body)
        radial = mixed(g.M.mT, Mb) / q
        m = (d + (1.0 - g.f) * s).mean(1)
        z = B * m
        v = g.a.view(3, -1) + z
        Mv = mixed(g.M, v)
        size = (Mv.square().sum(0) + 1e-12).sqrt()
        u = mixed(obs.alpha, v)
        value, by_u, by_size = lobe_with_slopes(u, size, g.n_s, g.ggx)
        direction = mixed(g.M.mT, Mv) / size
        misfit = (body + value[:, None]) * t - obs.images
        silent = obs.clipped & (misfit > 0)
        misfit = torch.where(silent, 0.0, misfit)
        scale = torch.where(silent, 0.0, self.weight * t)
        rows = [(misfit * self.weight).flatten(0, 1)]
        # d body / d d_k = slope A_k + by_q radial_k, per light, channel and basis light.
        Phi = torch.stack([(slope * obs.alpha[:, k, None, None] + by_q * radial[k]) * scale for k in range(3)])
        G = torch.stack([by_u * obs.alpha[:, k, None] + by_size * direction[k] for k in range(3)])
        extra: list[Tensor] = []
        log_C = log_size(shared, obs)
        if math.isfinite(self.height_spread):
            gloss = g.n_s / self.height_spread
            rows.append((gloss * (size.log() - log_C))[None])
            extra.append(gloss * direction / size)
        if self.neighbours is not None:
            per = 0.5 / log_C.exp()
            rows.append(self.neighbours.rows(z * per))
            R = self.neighbours.R * per
            nothing = torch.zeros_like(R[0])
            extra += [torch.stack(row) for row in ((R[0], R[1], R[2]), (nothing, R[3], R[4]), (nothing, nothing, R[5]))]
        return _Slopes(
            torch.cat(rows), Phi, G, scale, extra, z, B / obs.channels, B * s.mean(1), u, size, c, q, body, chain
        )

    def normal(self, local: Float[Tensor, "P pixels"], shared: Float[Tensor, "G"]) -> Normal:
        """Cost, gradient and Gauss-Newton matrix of every pixel, in closed form."""
        return self._assembled(self._slopes(local, shared))

    def _assembled(self, at: _Slopes) -> Normal:
        rows, Phi, scale, z, share = at.rows, at.Phi, at.scale, at.z, at.share
        lights, channels, _ = self.obs.images.shape
        cost, weight = self.robust(rows)
        count = lights * channels
        w = weight[:count].unflatten(0, (lights, channels))
        r = w * rows[:count].unflatten(0, (lights, channels))
        Pw = Phi * w
        # G belongs to all channels alike, times each value's own scale.
        ws = w * scale
        total, pull = (ws * scale).sum(1), (r * scale).sum(1)
        Hz = torch.empty(3, 3, *z.shape[1:], dtype=z.dtype, device=z.device)
        gz = torch.empty_like(z)
        for k in range(3):
            gz[k] = (at.G[k] * pull).sum(0)
            for i in range(k + 1):
                Hz[k, i] = (at.G[k] * at.G[i] * total).sum(0)
        for row, slope in zip(rows[count:], at.extra, strict=True):
            gz += row * slope
            for k in range(3):
                for i in range(k + 1):
                    Hz[k, i] += slope[k] * slope[i]
        for k in range(3):
            for i in range(k):
                Hz[i, k] = Hz[k, i]
        Hzz = (Hz * z[None]).sum(1)
        K = torch.stack([torch.stack([(Phi[k] * ws * at.G[i][:, None]).sum(0) for i in range(3)]) for k in range(3)])
        own = {(k, i): (Pw[k] * Phi[i]).sum(0) for k in range(3) for i in range(k + 1)}
        P = 3 * channels + 1
        V = torch.zeros(P, P, *z.shape[1:], dtype=z.dtype, device=z.device)
        blocks = V[:-1, :-1].view(3, channels, 3, channels, -1)
        for k in range(3):
            for i in range(k + 1):
                common = share.square() * Hz[k, i]
                # (K_c)_ki + (K_e)_ik, c the row's channel and e the column's.
                blocks[k, :, i] = share * (K[k, i][:, None] + K[i, k][None]) + common
                blocks[k, :, i].diagonal(dim1=0, dim2=1).add_(own[k, i].mT)
        V[-1, :-1] = ((K * z[None, :, None]).sum(1) + (share * Hzz)[:, None]).flatten(0, 1)
        V[-1, -1] = (Hzz * z).sum(0)
        g = torch.cat([((Phi * r).sum(1) + (share * gz)[:, None]).flatten(0, 1), (gz * z).sum(0)[None]])
        return Normal(cost, g, V)

    def jacobian(self, local: Float[Tensor, "P pixels"], shared: Tensor) -> Float[Tensor, "rows P pixels"]:
        """Derivatives of `residuals` by the local unknowns, in closed form."""
        at = self._slopes(local, shared)
        lights, channels, pixels = self.obs.images.shape
        count = lights * channels
        J = local.new_zeros(len(at.rows), 3 * channels + 1, pixels)
        pictures = J[:count, :-1].view(lights, channels, 3, channels, pixels)
        for k in range(3):
            # A channel's d reaches a value of any channel through the lobe, which sees the mean of all.
            shine = at.G[k][:, None] * at.scale
            pictures[:, :, k] = (at.share * shine)[:, :, None]
            pictures[:, :, k].diagonal(dim1=1, dim2=2).add_(at.Phi[k].movedim(1, -1))
        J[:count, -1] = ((at.G * at.z[:, None]).sum(0)[:, None] * at.scale).flatten(0, 1)
        for i, slope in enumerate(at.extra, count):
            J[i, :-1] = (at.share * slope)[:, None].expand(3, channels, pixels).flatten(0, 1)
            J[i, -1] = (slope * at.z).sum(0)
        return J

    def coupled(
        self, local: Float[Tensor, "P pixels"], shared: Float[Tensor, "G"]
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """V, gl, W, H and gg of every pixel."""
        at = self.normal(local, shared)
        rows = self.residuals(local, shared)
        J, Jg = self.jacobian(local, shared), self.shared_jacobian(local, shared)
        _, weight = self.robust(rows)
        weighted = Jg * weight[:, None]
        W = torch.stack([(J * weighted[:, None, i]).sum(0) for i in range(len(shared))], 1)
        H = torch.stack([(Jg * weighted[:, None, i]).sum(0) for i in range(len(shared))], 1)
        return at.V, at.g, W, H, (weighted * rows[:, None]).sum(0)

    def shared_jacobian(self, local: Float[Tensor, "P pixels"], shared: Float[Tensor, "G"]) -> Tensor:
        """Derivatives of `residuals` by the shared unknowns (rows, G, pixels); autograd for the alphas alone."""
        at = self._slopes(local, shared)
        lights, channels, pixels = self.obs.images.shape
        count = lights * channels
        g = globals_of(shared, self.obs)
        J = local.new_zeros(len(at.rows), len(shared), pixels)

        def through(dv: Float[Tensor, "3 pixels"], column: int) -> None:
            """What a change of the lobe's vector adds to a column."""
            J[:count, column] += ((at.G * dv[:, None]).sum(0)[:, None] * at.scale).flatten(0, 1)
            for row, slope in enumerate(at.extra, count):
                J[row, column] += (slope * dv).sum(0)

        for k in range(3):
            # Of a, the pictures and the height see what they see of z; the neighbours' rows see only their unit, C_1.
            dv = torch.zeros_like(at.z)
            dv[k] = g.a[k]
            through(dv, k)
            if self.neighbours is not None:
                J[-3:, k] = (
                    -self.neighbours.rows(at.z * (0.5 / log_size(shared, self.obs).exp())).add(
                        upper_times(self.neighbours.R, self.neighbours.vector)
                    )
                    / 3.0
                )
            if math.isfinite(self.height_spread):
                J[count, k] -= g.n_s / (3.0 * self.height_spread)
        through(-at.z_by_f, F)
        if math.isfinite(self.height_spread):
            J[count, LOG_N_S] = at.rows[count]
        value = lobe_by_exponent(at.u, at.size, g.n_s, g.ggx)
        J[:count, LOG_N_S] = (g.n_s * value[:, None] * at.scale).flatten(0, 1)
        for kind in range(1, self.obs.kinds):
            # Another material's own height and exponent: what those of all would do, at its pixels alone.
            here = (self.obs.material == kind).to(J.dtype)
            first = len(shared) - 2 * (self.obs.kinds - kind)
            J[:, first] = J[:, :3].sum(1) * here
            J[:, first + 1] = J[:, LOG_N_S] * here
        if self.obs.material is not None:
            J[:, LOG_N_S] *= (self.obs.material == 0).to(J.dtype)
        by_softness, by_fresnel = transmitted_by_globals(at.c, g.softness, g.fresnel)
        for column, slope in ((SOFTNESS, by_softness), (FRESNEL, by_fresnel)):
            J[:count, column] = (at.q * slope * at.chain * at.scale).flatten(0, 1)
        if self.obs.fixed_n_d is None:
            body = at.body
            J[:count, LOG_N_D] = (body * body.clamp_min(1e-30).log() * at.scale).flatten(0, 1)
        for column in range(ALPHA, ALPHA + len(deltas(shared, self.obs))):
            axis = torch.zeros_like(shared)
            axis[column] = 1.0
            with forward_ad.dual_level():
                found = forward_ad.unpack_dual(self.residuals(local, forward_ad.make_dual(shared, axis)))
                J[:, column] = 0.0 if found.tangent is None else found.tangent
        return J

    def shared_rows(self, shared: Float[Tensor, "G"]) -> Float[Tensor, "rows"]:
        """What is expected of the globals, as residuals that are linear in them."""
        common = (shared[:3] - self.obs.cosine.log()) / COMMON_SD
        rows = [common - common.mean()] if self.obs.lights_known else [0.0 * common]
        rows.append(((shared[LOG_N_D] - math.log(self.obs.n_d)) / self.obs.n_d_sd)[None])
        if self.priors:
            expected = (
                shared[SOFTNESS] / SOFTNESS_SD,
                (shared[FRESNEL] - 0.5) / FRESNEL_SD,
            )
            exponents = materials_of(shared, self.obs.kinds)[1]
            rows += [torch.stack(expected), (exponents - LOG_N_S_CENTRE) / LOG_N_S_SD]
        return torch.cat([*rows, deltas(shared, self.obs) / self.alpha_sd])

    def bounded(self, shared: Float[Tensor, "G"]) -> Float[Tensor, "G"]:
        """F and fresnel are shares; exponents have their bounds."""
        result = shared.clone()
        result[[F, FRESNEL]] = result[[F, FRESNEL]].clamp(0.0, 1.0)
        result[LOG_N_S] = result[LOG_N_S].clamp(math.log(LEAST_N_S), math.log(MOST_N_S))
        others = list(range(len(shared) - 2 * (self.obs.kinds - 1) + 1, len(shared), 2))
        result[others] = result[others].clamp(math.log(LEAST_N_S_OTHER), math.log(MOST_N_S))
        return result


@dataclass(frozen=True)
class _Slopes:
    """A pixel's rows and what their derivatives are made of."""

    rows: Tensor
    Phi: Float[Tensor, "3 lights channels pixels"]
    G: Float[Tensor, "3 lights pixels"]
    scale: Float[Tensor, "lights channels pixels"]
    extra: list[Tensor]
    """Slopes by z of the rows after the pictures'."""
    z: Float[Tensor, "3 pixels"]
    share: Float[Tensor, "pixels"]
    """B / C."""
    z_by_f: Float[Tensor, "3 pixels"]
    """What z loses as f grows: B mean_c s."""
    u: Float[Tensor, "lights pixels"]
    size: Float[Tensor, "pixels"]
    """|w|."""
    c: Tensor
    """Cosine of the body."""
    q: Float[Tensor, "channels pixels"]
    body: Float[Tensor, "lights channels pixels"]
    chain: Tensor
    """Derivative of the body by q T."""
