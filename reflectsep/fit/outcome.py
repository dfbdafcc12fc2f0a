"""What a finished fit says: parameters as pictures, their certainty, and flags."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from reflectsep.data import Fit, Learnt, PhotometricStack, Scattering
from reflectsep.fit.options import FitOptions
from reflectsep.fit.problem import (
    ALPHA,
    LEAST_N_S,
    LOG_N_S,
    MOST_N_S,
    SHARED_NAMES,
    PixelProblem,
    deltas,
    globals_of,
    materials_of,
    refined,
)
from reflectsep.fit.state import State
from reflectsep.flags import Flag, mark
from reflectsep.model import lobe_of, lobe_vector
from reflectsep.room import empty
from reflectsep.solve.joint import reduced
from reflectsep.solve.levenberg import Status
from reflectsep.solve.linear import factorise, solve
from reflectsep.solve.sharing import by_chunks

OUTLIER = 5.0
"""Residual, in standard deviations, that marks a pixel."""
FAINT = 3.0
"""Highlights below so many standard deviations of the noise are not seen."""
FEW = 30
"""Pixels that see the highlight twice, of which n_s and a can be told."""


def describe(
    state: State,
    stack: PhotometricStack,
    scattering: Scattering | None,
    intensity: Float[Tensor, "lights"],
    options: FitOptions,
) -> Fit:
    """The finished fit as pictures in single precision; zero outside the mask."""
    problem, shared = state.problem, state.shared
    assert state.cost is not None
    assert state.status is not None
    kinds = problem.obs.kinds
    g = globals_of(shared, replace(problem.obs, material=None))
    scale, exponents = materials_of(shared, kinds)
    names = names_of(stack, shared, kinds)
    if options.held is None:
        covariance = shared_covariance(state, options.chunk)
        order = tuple(name for name, free in zip(names, state.free.tolist(), strict=True) if free)
    else:
        covariance, order = carried_covariance(options.held, names, shared), options.held.order
    chosen = torch.tensor([names.index(name) for name in order], dtype=torch.long)
    told = covariance[chosen][:, chosen]
    pictures = Pictures(state, options.chunk, intensity)
    alpha, alpha_sd, strength = refined_alpha(state, intensity, covariance)
    parts = pictures.made(covariance)
    return Fit(
        a=g.a.float(),
        n_s=g.n_s.float(),
        n_d=torch.as_tensor(g.n_d).float(),
        f=g.f.float(),
        softness=g.softness.abs().float(),
        fresnel=g.fresnel.float(),
        ggx=g.ggx,
        materials=torch.stack([scale.exp(), exponents.exp()], 1).float(),
        material=material_map(state),
        global_names=order,
        covariance=told,
        intensity=strength.float(),
        alpha=alpha,
        alpha_sd=alpha_sd,
        flags=final_flags(state, stack, scattering, pictures),
        noise=problem.sigma,
        cost=float(state.cost.sum()),
        iterations=state.joint.iterations if state.joint is not None else 0,
        history=tuple({"cost": c} for c in (state.joint.history if state.joint is not None else ())),
        learnt=Learnt(
            shared=tuple(shared.tolist()),
            order=order,
            covariance=tuple(tuple(row) for row in told.tolist()),
            noise=problem.sigma,
            kinds=kinds,
            smooth=None if state.smooth is None else (state.smooth.width_px, state.smooth.spread),
        ),
        warnings=warnings(state, options, pictures),
        **parts,
    )


class Pictures:
    """Maps of what a fit found, made chunk by chunk; and per-pixel figures that flags go by."""

    def __init__(self, state: State, chunk: int, intensity: Float[Tensor, "lights"]) -> None:
        self.state, self.chunk, self.intensity = state, chunk, intensity
        pixels = len(state.problem)
        self.highlight = empty(pixels, dtype=torch.float32)
        """The brightest off-specular value of each pixel."""
        self.twice = torch.zeros(pixels, dtype=torch.bool)
        """Whether it is seen in two pictures or more."""
        self.misfit = empty(pixels, dtype=torch.float32)
        self.dark = torch.zeros(pixels, dtype=torch.bool)

    def made(self, covariance: Float[Tensor, "G G"]) -> dict[str, Tensor]:
        """D, s, B, their deviations and the residual, zero outside the mask."""
        problem, mask = self.state.problem, self.state.mask
        lights, channels, _ = problem.obs.images.shape
        place = mask.flatten().nonzero()[:, 0]
        room = lambda *lead: empty(*lead, mask.numel(), dtype=torch.float32).zero_()  # noqa: E731
        maps = {"d": room(3, channels), "d_sd": room(3, channels), "s": room(lights, channels)}
        maps |= {"B": room(), "B_sd": room(), "residual": room(lights, channels)}

        def part(cut: slice) -> tuple[Tensor, ...]:
            some, at = problem.take(cut), self.state.local[:, cut].contiguous()
            return self._part(some, at, covariance)

        d, d_sd, s, B, B_sd, residual, highlight, twice, misfit, dark = by_chunks(len(problem), self.chunk, part)
        for name, values in (("d", d), ("d_sd", d_sd), ("s", s), ("residual", residual)):
            maps[name][..., place] = values.movedim(0, -1)
        maps["B"][place], maps["B_sd"][place] = B, B_sd
        self.highlight[:], self.twice[:], self.misfit[:], self.dark[:] = highlight, twice, misfit, dark
        return {name: values.unflatten(-1, mask.shape) for name, values in maps.items()}

    def _part(self, some: PixelProblem, at: Tensor, covariance: Tensor) -> tuple[Tensor, ...]:
        shared, channels = self.state.shared, some.obs.channels
        d, B = some.unpacked(at)
        count = some.obs.images.shape[0] * channels
        misfit = (some.residuals(at, shared)[:count] / some.weight.expand(some.obs.images.shape).flatten(0, 1)).view(
            some.obs.images.shape
        )
        light = refined(some.obs, shared)
        g = globals_of(shared, some.obs)
        s3 = some.scattering(at)
        shine = lobe_of(lobe_vector(d, s3, B, g), g, light.obs.alpha)
        s = light.obs.s.clone()
        if at.shape[0] > 3 * channels + 1:
            s = torch.tensordot(light.obs.alpha, s3, 1)
        sd = deviation(some, at, shared, covariance)
        last = lambda x: x.movedim(-1, 0).float()  # noqa: E731
        return (
            last(d),
            last(sd[: 3 * channels].unflatten(0, (3, channels))),
            last(s),
            B.float(),
            (B * sd[3 * channels]).float(),
            last(-misfit * self.intensity[:, None, None]),
            shine.amax(0).float(),
            (shine > FAINT * some.sigma).sum(0) >= 2,
            misfit.abs().amax((0, 1)).float(),
            (d + s3).mean(1).amin(0) < 0,
        )


def deviation(
    problem: PixelProblem, local: Float[Tensor, "P pixels"], shared: Tensor, covariance: Float[Tensor, "G G"]
) -> Float[Tensor, "P pixels"]:
    """Standard deviation of every local unknown, that of the globals carried along.

    cov(l) = V^-1 + V^-1 W cov(g) W^T V^-1
    """
    V, gl, W, _, _ = problem.coupled(local, shared)
    firm = 1e-9 * V.diagonal(dim1=0, dim2=1).mT.amax(0) + torch.finfo(V.dtype).tiny
    P, pixels = gl.shape
    eye = torch.eye(P, dtype=V.dtype, device=V.device)[..., None].expand(P, P, pixels)
    solved = solve(factorise(V, firm.expand(P, -1)), torch.cat([eye, W], 1))
    own, pull = solved[:, :P].diagonal(dim1=0, dim2=1).mT, solved[:, P:]
    return (own + torch.einsum("pgn,gh,phn->pn", pull, covariance, pull)).clamp_min(0.0).sqrt()


def carried_covariance(held: Learnt, names: tuple[str, ...], like: Tensor) -> Float[Tensor, "G G"]:
    """Covariance of the globals by the fit that they come from, zero where that held them."""
    covariance = like.new_zeros(len(names), len(names))
    index = torch.tensor([names.index(name) for name in held.order], dtype=torch.long)
    values = torch.tensor(held.covariance, dtype=like.dtype).reshape(len(index), len(index))
    covariance[index[:, None], index] = values
    return covariance


def material_map(state: State) -> Int[Tensor, "height width"]:
    """Material of every pixel; 0 outside the mask."""
    picture = torch.zeros(state.mask.shape, dtype=torch.int32)
    if state.problem.obs.material is not None:
        picture[state.mask] = state.problem.obs.material.to(torch.int32)
    return picture


def names_of(stack: PhotometricStack, shared: Float[Tensor, "G"], kinds: int) -> tuple[str, ...]:
    """Names of the globals; a refined alpha is named after its light and its basis light."""
    others = [f"alpha_{name}_{basis}" for name in stack.names[3:] for basis in stack.names[:3]]
    more = [f"{what}_{kind}" for kind in range(2, kinds + 1) for what in ("log_C_1", "log_n_s")]
    refined_too = len(shared) > ALPHA + len(more)
    return (*SHARED_NAMES, *(others if refined_too else []), *more)


def refined_alpha(
    state: State, intensity: Float[Tensor, "lights"], covariance: Float[Tensor, "G G"]
) -> tuple[Float[Tensor, "lights 3"] | None, Float[Tensor, "lights 3"] | None, Float[Tensor, "lights"]]:
    """Alphas in the capture's units and their standard deviation, None where they were held; and all intensities."""
    if len(deltas(state.shared, state.problem.obs)) == 0:
        return None, None, intensity
    light = refined(state.problem.obs.take(slice(0, 1)), state.shared)
    strength = intensity * light.intensity
    alpha = light.obs.alpha * strength[:, None] / intensity[:3]
    sd = torch.zeros_like(alpha)
    count = len(deltas(state.shared, state.problem.obs))
    sd[3:] = covariance.diagonal()[ALPHA : ALPHA + count].clamp_min(0.0).sqrt().view(-1, 3)
    return alpha.float(), (sd * intensity[:, None] / intensity[:3]).float(), strength


def shared_covariance(state: State, chunk: int) -> Float[Tensor, "G G"]:
    """Inverse of the reduced system over the free globals, zero elsewhere."""
    covariance = torch.zeros(len(state.shared), len(state.shared), dtype=state.shared.dtype)
    index = state.free.nonzero()[:, 0]
    if state.sampled is None or len(index) == 0:
        return covariance
    sampled = state.sampled
    every = torch.arange(len(sampled.problem))
    S, _, _ = reduced(sampled.problem, sampled.local, state.shared, chunk, every)
    covariance[index[:, None], index] = torch.linalg.pinv(S[index][:, index], hermitian=True)
    return covariance


def final_flags(
    state: State, stack: PhotometricStack, scattering: Scattering | None, pictures: Pictures
) -> Int[Tensor, "height width"]:
    """Flags of the stack and of the scattering, and what the fit itself noticed."""
    problem, sigma = state.problem, state.problem.sigma
    assert state.status is not None
    flags = stack.flags if scattering is None else stack.flags | scattering.flags
    if scattering is not None:
        flags = mark(flags, scattering.invalid & stack.mask & ~state.mask, Flag.INVALID_INPUT)
    marks = {
        Flag.FAINT_LOBE: pictures.highlight < FAINT * sigma,
        Flag.NOT_CONVERGED: state.status == int(Status.EXHAUSTED),
        Flag.FAILED: state.status == int(Status.FAILED),
        Flag.ATTACHED_SHADOW: pictures.dark,
        Flag.SHADOW_OR_OUTLIER: pictures.misfit > OUTLIER * sigma,
        Flag.UNDEREXPOSED: problem.obs.images[:3].amax((0, 1)) < FAINT * sigma,
    }
    for flag, where in marks.items():
        picture = torch.zeros_like(state.mask)
        picture[state.mask] = where
        flags = mark(flags, picture, flag)
    return mark(flags, ~stack.mask, Flag.OUTSIDE_MASK)


def warnings(state: State, options: FitOptions, pictures: Pictures) -> tuple[str, ...]:
    """What a person should know before trusting the numbers."""
    said = []
    seen = int(pictures.twice.sum())
    if seen < FEW and options.held is None:
        said.append(
            f"only {seen} pixels show the highlight in two or more pictures: n_s, a and B rest on what is expected of "
            "a highlight; the specular component is not to be trusted"
        )
    for n_s in materials_of(state.shared, state.problem.obs.kinds)[1].exp().tolist():
        if bool(state.free[LOG_N_S]) and not LEAST_N_S * 1.01 < n_s < MOST_N_S / 1.01:
            said.append(f"n_s ended at {n_s:.3g}: the pictures show no lobe that all pixels share")
    if state.joint is not None and state.joint.status == Status.FAILED:
        said.append("the joint fit found no globals that lower the cost")
    if not state.problem.obs.lights_known:
        said.append("light directions are unknown: no bound on the lobe's direction, and no relighting by direction")
    return tuple(said)
