"""What a finished fit says: parameters as pictures, their certainty, and flags."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from reflectsep.data import Fit, Learnt, PhotometricStack, Scattering
from reflectsep.fit.blocks import build_problem
from reflectsep.fit.chunks import in_chunks
from reflectsep.fit.options import FitOptions
from reflectsep.fit.problem import (
    ALPHA,
    LEAST_LOG_N_S,
    LOG_N_S,
    MOST_LOG_N_S,
    SHARED_NAMES,
    mixing_of,
    pixel_residual,
    refined,
    s_of_lights,
    unpack,
    unpack_globals,
)
from reflectsep.fit.solution import lobe_pictures
from reflectsep.fit.state import State
from reflectsep.flags import Flag, mark
from reflectsep.room import empty
from reflectsep.solve.joint import reduced_system, solve_firm
from reflectsep.solve.sharing import by_chunks

AMBIGUOUS_COST = 2.0
"""Two solutions whose costs differ by less are not told apart by the pictures."""
NEAR_LIMIT = 0.02
"""A log n_s this near its bound was stopped by it."""
OUTLIER = 5.0
"""Residual, in standard deviations, that marks a pixel."""


def describe(
    state: State,
    stack: PhotometricStack,
    scattering: Scattering | None,
    intensity: Float[Tensor, "lights"],
    options: FitOptions,
) -> Fit:
    """The finished fit as pictures in single precision; zero outside the mask."""
    obs, mask, shared = state.obs, state.mask, state.shared
    x, g = unpack(state.found.local, obs.channels), unpack_globals(shared, obs.n_d)
    names = names_of(stack, state)
    if options.held is None:
        covariance = shared_covariance(state)
        order = tuple(name for name, free in zip(names, state.free.tolist(), strict=True) if free)
    else:
        covariance, order = carried_covariance(options.held, names, shared), options.held.order
    chosen = torch.tensor([names.index(name) for name in order], dtype=torch.long)
    told = covariance[chosen][:, chosen]
    local_sd = local_deviation(state, covariance)
    sd = unpack(local_sd, obs.channels)
    B, B_sd = x.B, x.B * sd.log_B
    picture = lambda values: to_picture(values, mask)  # noqa: E731
    alpha, alpha_sd, strength = refined_alpha(state, intensity, covariance)
    return Fit(
        a=g.a.float(),
        n_s=g.n_s.float(),
        n_d=torch.as_tensor(g.n_d).float(),
        softness=g.softness.abs().float(),
        crest=g.crest.float(),
        global_names=order,
        covariance=told,
        d=picture(x.d),
        s=picture(in_chunks(len(obs), lambda cut: s_of_pixels(state, cut))),
        B=picture(B[:, None, None].expand(-1, obs.channels, 1))[0],
        d_sd=picture(sd.d),
        B_sd=picture(B_sd[:, None, None].expand(-1, obs.channels, 1))[0],
        residual=picture(in_chunks(len(obs), lambda cut: (-picture_residual(state, cut) * intensity).float())),
        intensity=strength.float(),
        alpha=alpha,
        alpha_sd=alpha_sd,
        flags=final_flags(state, stack, scattering),
        noise=state.sigma,
        cost=float(state.found.cost.sum()),
        iterations=state.joint.iterations if state.joint is not None else 0,
        history=tuple({"cost": c} for c in (state.joint.history if state.joint is not None else ())),
        learnt=Learnt(
            shared=tuple(shared.tolist()),
            order=order,
            covariance=tuple(tuple(row) for row in told.tolist()),
            noise=state.sigma,
            shape=state.priors.shape,
            height=state.priors.height,
            scales=state.scales,
        ),
        warnings=warnings(state, options),
    )


def carried_covariance(held: Learnt, names: tuple[str, ...], like: Tensor) -> Float[Tensor, "G G"]:
    """Covariance of the globals by the fit that they come from, zero where that held them."""
    covariance = like.new_zeros(len(names), len(names))
    index = torch.tensor([names.index(name) for name in held.order], dtype=torch.long)
    values = torch.tensor(held.covariance, dtype=like.dtype).reshape(len(index), len(index))
    covariance[index[:, None], index] = values
    return covariance


def names_of(stack: PhotometricStack, state: State) -> tuple[str, ...]:
    """Names of the globals; a refined alpha is named after its light and its basis light."""
    others = [f"alpha_{name}_{basis}" for name in stack.names[3:] for basis in stack.names[:3]]
    return (*SHARED_NAMES, *others) if len(state.shared) > ALPHA else SHARED_NAMES


def refined_alpha(
    state: State, intensity: Float[Tensor, "lights"], covariance: Float[Tensor, "G G"]
) -> tuple[Float[Tensor, "lights 3"] | None, Float[Tensor, "lights 3"] | None, Float[Tensor, "lights"]]:
    """Alphas in the capture's units and their standard deviation, None where they were held; and all intensities."""
    if len(state.shared) == ALPHA:
        return None, None, intensity
    mixed = mixing_of(state.obs, state.shared)
    strength = intensity * mixed.intensity
    alpha = mixed.alpha * strength[:, None] / intensity[:3]
    sd = torch.zeros_like(alpha)
    sd[3:] = covariance.diagonal()[ALPHA:].clamp_min(0.0).sqrt().view(-1, 3)
    return alpha.float(), (sd * intensity[:, None] / intensity[:3]).float(), strength


def to_picture(values: Float[Tensor, "pixels channels maps"], mask: Tensor) -> Float[Tensor, "maps channels h w"]:
    """Values of the fitted pixels as pictures, float32."""
    picture = empty(values.shape[2], values.shape[1], *mask.shape, dtype=torch.float32).zero_()
    for k, channels in enumerate(picture):
        for c, plane in enumerate(channels):
            plane[mask] = values[:, c, k].float()
    return picture


def s_of_pixels(state: State, cut: slice) -> Float[Tensor, "some channels lights"]:
    """Scattering roots of every light at some of the pixels, float32."""
    obs = refined(state.obs.take(cut), state.shared)
    return s_of_lights(unpack(state.found.local[cut], obs.channels), obs).float()


def picture_residual(state: State, cut: slice) -> Float[Tensor, "some channels lights"]:
    """Model minus picture of every value of some of the pixels, lights of unit intensity."""
    obs = state.obs.take(cut)
    rows = pixel_residual(state.found.local[cut], state.shared, obs, state.priors.take(cut))
    count = obs.images[0].numel()
    return rows[:, :count].view_as(obs.images) / obs.weight


def shared_covariance(state: State) -> Float[Tensor, "G G"]:
    """Inverse of the reduced system over the free globals, zero elsewhere."""
    problem = build_problem(state.obs, state.priors, robust=state.robust)
    S = reduced_system(problem, state.found.local, state.shared, state.effort.chunk).S
    covariance = torch.zeros_like(S)
    index = state.free.nonzero()[:, 0]
    covariance[index[:, None], index] = torch.linalg.pinv(S[index][:, index], hermitian=True)
    return covariance


def local_deviation(state: State, covariance: Float[Tensor, "G G"]) -> Float[Tensor, "pixels P"]:
    """Standard deviation of every local unknown, that of the globals carried along.

    cov(l) = V^-1 + V^-1 W cov(g) W^T V^-1
    """

    def deviation(cut: slice) -> tuple[Tensor]:
        index = torch.arange(cut.start, cut.stop)
        problem = build_problem(state.obs.take(index), state.priors.take(index), robust=state.robust)
        at = problem.coupled_equations(state.found.local[index], state.shared)
        P = len(at.V)
        eye = torch.eye(P, dtype=at.V.dtype)[..., None].expand_as(at.V)
        solved = solve_firm(at.V, torch.cat([eye, at.W.transpose(0, 1)]))
        own, pull = solved[:P].diagonal(), solved[P:]
        variance = own + torch.einsum("gpn,gh,hpn->np", pull, covariance, pull)
        return (variance.clamp_min(0.0).sqrt(),)

    return by_chunks(len(state.obs), state.effort.chunk, deviation)[0]


def final_flags(
    state: State,
    stack: PhotometricStack,
    scattering: Scattering | None,
) -> Int[Tensor, "height width"]:
    """Flags of the stack and of the scattering, and what the fit itself noticed."""
    obs, found = state.obs, state.found
    flags = stack.flags if scattering is None else stack.flags | scattering.flags
    if scattering is not None:
        flags = mark(flags, scattering.invalid & stack.mask & ~state.mask, Flag.INVALID_INPUT)
    x = unpack(found.local, obs.channels)
    shine = in_chunks(len(obs), lambda cut: shine_of(state, cut).amax(-1))

    def misfit(cut: slice) -> Tensor:
        found = picture_residual(state, cut)
        return torch.where(obs.clipped[cut], found.clamp_max(0.0), found).abs().amax((1, 2))

    unlike = in_chunks(len(obs), misfit) > OUTLIER * state.sigma
    dark = in_chunks(len(obs), lambda cut: (x.d[cut].mean(1) < 0).any(-1))
    marks = {
        Flag.FAINT_LOBE: shine < 3.0 * state.sigma,
        Flag.NOT_CONVERGED: ~found.converged,
        Flag.AMBIGUOUS: found.runner_up < found.cost + AMBIGUOUS_COST,
        Flag.ATTACHED_SHADOW: dark,
        Flag.SHADOW_OR_OUTLIER: unlike,
        Flag.UNDEREXPOSED: obs.images[..., :3].amax((1, 2)) < 3.0 * state.sigma,
    }
    for flag, where in marks.items():
        picture = torch.zeros_like(state.mask)
        picture[state.mask] = where
        flags = mark(flags, picture, flag)
    return mark(flags, ~stack.mask, Flag.OUTSIDE_MASK)


def shine_of(state: State, cut: slice) -> Float[Tensor, "some lights"]:
    """`lobe_pictures` of some of the pixels."""
    return lobe_pictures(state.obs, state.found.local[cut], state.shared)


def warnings(state: State, options: FitOptions) -> tuple[str, ...]:
    """What a person should know before trusting the numbers."""
    said = []
    in_two = lambda cut: (shine_of(state, cut) > 3.0 * state.sigma).sum(-1) >= 2  # noqa: E731
    seen = int(in_chunks(len(state.obs), in_two).sum())
    if seen < 30 and options.held is None:
        said.append(
            f"only {seen} pixels show the highlight in two or more pictures: n_s, a and B rest on the prior; "
            "the specular component is not to be trusted"
        )
    if bool(state.free[LOG_N_S]):
        said += at_its_limit(float(state.shared[LOG_N_S]))
    if state.joint is not None and not state.joint.converged:
        said.append(f"the joint fit stopped at its limit of {options.max_iterations} iterations")
    if not state.obs.lights_known:
        said.append("light directions are unknown: no bound on the lobe's direction, and no relighting by direction")
    return tuple(said)


def at_its_limit(log_n_s: float) -> list[str]:
    """What is to be said of a fitted n_s that only its bounds have stopped."""
    if LEAST_LOG_N_S + NEAR_LIMIT < log_n_s < MOST_LOG_N_S - NEAR_LIMIT:
        return []
    ends = "sharpest" if log_n_s > LEAST_LOG_N_S + NEAR_LIMIT else "broadest"
    return [
        f"n_s ended at {math.exp(log_n_s):.0f}, the {ends} lobe that is fitted: the pictures do not show one that all "
        "pixels share, do not lie alike, or the light directions are wrong; the specular component is not to be trusted"
    ]
