"""The fit of a capture: pictures and scattering in, parameters of every pixel with their certainty out.

robust body -> grid and joint fit of the globals on telling pixels -> search over B of every pixel
-> lobes handed on between neighbours -> everything jointly -> soft shadows and neighbourhood, jointly again
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.data import Fit, Learnt, PhotometricStack, Scattering
from reflectsep.errors import FitError
from reflectsep.fit.blocks import build_problem
from reflectsep.fit.body import extend_into_shadow, robust_body
from reflectsep.fit.chunks import cuts, in_chunks, taken
from reflectsep.fit.expectations import (
    first_priors,
    near_maximum,
    noise_of,
    quantile,
    shape_spread,
    unknowns_in_effect,
    with_facing,
    with_ratio,
)
from reflectsep.fit.options import FitOptions
from reflectsep.fit.outcome import describe, picture_residual, shine_of
from reflectsep.fit.problem import (
    ALPHA,
    GGX,
    LOG_C_2,
    LOG_N_D,
    LOG_N_S,
    SOFTNESS,
    Observations,
    Priors,
    no_priors,
    unpack,
)
from reflectsep.fit.search import GRID_N_S, globals_grid, informative_pixels
from reflectsep.fit.smoothness import predict, scales_of, with_lobe
from reflectsep.fit.solution import (
    Effort,
    LocalFit,
    fit_everything,
    fit_globals,
    fit_locals,
    hand_on_lobes,
    initial_shared,
    lobe_pictures,
    offer_lobes,
)
from reflectsep.fit.state import State
from reflectsep.flags import Flag
from reflectsep.kernel.compiling import Speed
from reflectsep.model import diffuse
from reflectsep.progress import Progress, silent
from reflectsep.room import empty
from reflectsep.solve.joint import JointOptions, costs_in_chunks
from reflectsep.solve.local import Termination
from reflectsep.solve.sharing import one_thread

HUBER = 5.0
"""Residuals beyond this many standard deviations are cast shadows or inter-reflections, not noise."""
MIN_PICTURES = {"measured": 6, "none": 6, "unknown": 8}
N_D_SD, N_D_SD_LEAST = 0.05, 0.01
"""Relative standard deviation of n_d: of 1 where no sweep tells, and the least that a sweep's is taken to have."""
TRIAL = 4000
"""Pixels that tell whether an extension is worth fitting to all of them."""
EXTENSION_GAIN = 0.01
"""Soft shadows stay only where they lower the whole cost by this share."""


def fit_reflectance(
    stack: PhotometricStack,
    scattering: Scattering | None,
    options: FitOptions = FitOptions(),  # noqa: B008  (frozen)
    *,
    progress: Progress = silent,
) -> Fit:
    """Fit {a, n_s} and {B, D_1, D_2, D_3}(x) of Eqs. 20 and 21 to the pictures (paper, section 5).

    Args:
        stack: linear pictures (lights, channels, height, width), six or more (eight with unknown scattering).
        scattering: s of every light; None or `options.scattering == "none"`: s = 0, the model of Lin & Lee.
        options: see `FitOptions`.
        progress: called as (stage, done, total).

    Raises:
        FitError: too few pictures, no usable pixel, pictures without contrast, or alphas to be refined without a joint
            fit.
    """
    if options.alpha_sd > 0 and options.method != "joint":
        raise FitError(f"alpha_sd {options.alpha_sd:g} with method {options.method}: alphas are refined jointly alone")
    if options.held is not None:
        options = replace(options, refine_n_d="log_n_d" in options.held.order)
    dtype = torch.float64 if options.dtype == "float64" else torch.float32
    cores = torch.get_num_threads()
    with one_thread():
        obs, mask, intensity = observe(stack, scattering, options, dtype)
        speed = Speed(compile=options.compile, cores=cores)
        if options.device == "cpu" and speed.compiles(obs.images[..., 0].numel(), obs.images):
            obs = replace(obs, fused=replace(speed, compile="always"))
        state = prepare(obs, mask, options)
        state = start(state, options, progress)
        if options.method == "joint":
            state = refine(state, options, progress)
        return describe(state, stack, scattering, intensity, options)


def observe(
    stack: PhotometricStack, scattering: Scattering | None, options: FitOptions, dtype: torch.dtype
) -> tuple[Observations, Bool[Tensor, "height width"], Float[Tensor, "lights"]]:
    """Flatten the pixels that can be fitted, for lights of unit intensity; weights are filled in by `prepare`."""
    lights = len(stack.names)
    if lights < MIN_PICTURES[options.scattering]:
        raise FitError(
            f"{lights} pictures: the fit with {options.scattering} scattering needs at least "
            f"{MIN_PICTURES[options.scattering]}"
        )
    mask = stack.mask & ((stack.flags & int(Flag.INVALID_INPUT)) == 0)
    if not bool(mask.any()):
        raise FitError("no pixel to fit: the mask is empty or every pixel has invalid values")
    if scattering is not None and options.scattering != "none":
        pixels, mask = int(mask.sum()), mask & ~scattering.invalid
        if not bool(mask.any()):
            raise FitError(f"no pixel to fit: the scattering is not finite at any of the {pixels} pixels")
    known = stack.light_vectors is not None
    vectors = stack.light_vectors.to(dtype) if stack.light_vectors is not None else torch.eye(3, dtype=dtype)
    intensity = vectors.norm(dim=-1) if known else torch.ones(lights, dtype=dtype)
    view = stack.view.to(dtype)
    basis = vectors[:3] / vectors[:3].norm(dim=-1, keepdim=True)
    alpha = stack.alpha.to(dtype)
    if known:
        alpha = (vectors / intensity[:, None]) @ torch.linalg.inv(basis)
    images = flattened(stack.images, mask, intensity)
    high, low = float(images.amax()), float(images.amin())
    # Not exactly 0 for equal pictures: dividing by the intensities rounds.
    if not high - low > 1e-6 * max(high, -low):
        raise FitError("the pictures have no contrast inside the mask")
    use = scattering is not None and options.scattering != "none"
    n_d = scattering.n_d if use and scattering is not None else 1.0
    s = images.new_zeros(()).expand_as(images)
    if use and scattering is not None:
        s = flattened(scattering.root, mask, intensity ** (1.0 / n_d))
    obs = Observations(
        images=images,
        s=s,
        weight=images.new_ones(()).expand_as(images),
        clipped=flattened(stack.saturated, mask),
        alpha=alpha,
        normal_map=torch.linalg.inv(basis),
        view=view,
        cosine=basis @ view if known else torch.ones(3, dtype=dtype),
        lights_known=known,
        n_d=None if options.refine_n_d else n_d,
        n_d_swept=n_d,
        n_d_sd=max(scattering.n_d_sd / n_d, N_D_SD_LEAST) if use and scattering is not None else N_D_SD,
        swept=scattering.measured if use and scattering is not None else (),
        s_unknown=options.scattering == "unknown" or (use and options.scattering_sd > 0),
        device=torch.device(options.device),
    )
    return obs, mask, intensity


def flattened(
    pictures: Tensor, mask: Bool[Tensor, "height width"], divisor: Float[Tensor, "lights"] | None = None
) -> Tensor:
    """Pictures (lights, channels, height, width) as (pixels, channels, lights), divided light by light."""
    kind = pictures.dtype if divisor is None else divisor.dtype
    result = empty(int(mask.sum()), pictures.shape[1], len(pictures), dtype=kind)
    for j, picture in enumerate(pictures):
        for c, plane in enumerate(picture):
            values = plane[mask].to(kind)
            result[:, c, j] = values if divisor is None else values / divisor[j]
    return result


def prepare(obs: Observations, mask: Bool[Tensor, "height width"], options: FitOptions) -> State:
    """Noise, robust body, scattering beyond the shadow's edge, first priors."""
    n_d = obs.n_d_swept
    scale = near_maximum(obs.images.amax((1, 2)))
    if not scale > 0:
        raise FitError(f"the brightest picture values inside the mask are {scale:.3g}: nothing to fit")
    alike = lambda weight: obs.images.new_tensor(weight).expand_as(obs.images)  # noqa: E731
    body, flat = robust_body(obs.images, alike(100.0 / scale), obs.alpha, n_d), obs.images.new_zeros(())

    def rms(cut: slice) -> Tensor:
        return (obs.images[cut] - diffuse(body[cut] @ obs.alpha.mT, flat, n_d)).square().mean((1, 2)).sqrt()

    held = options.held
    sigma = noise_of(obs.images, in_chunks(len(obs), rms), 3) if held is None else held.noise
    body = robust_body(obs.images, alike(1.0 / sigma), obs.alpha, n_d)
    obs = replace(obs, s=beyond_the_edge(obs, body), weight=weights(obs, options, sigma))
    shared = initial_shared(obs.images, obs.cosine, n_d, options.n_s)
    shared[GGX] = float(options.lobe == "ggx")
    priors = replace(first_priors(obs, body, sigma, shared), log_n_d=math.log(n_d), n_d_sd=obs.n_d_sd)
    if options.prior == "none":
        bare = no_priors(len(obs), obs.images)
        priors = replace(bare, height=priors.height, log_n_d=priors.log_n_d, n_d_sd=priors.n_d_sd)
    if options.scattering == "measured" and obs.s_unknown:
        priors = replace(priors, s_weight=scattering_weight(obs, options, sigma))
    elif obs.s_unknown:
        priors = replace(priors, parallel=torch.zeros_like(priors.parallel))
        priors = replace(priors, ratio_weight=torch.zeros_like(priors.ratio_weight))
    free = torch.tensor([True, True, True, options.n_s is None, True, False, False, options.refine_n_d])
    if held is not None:
        priors = replace(priors, shape=held.shape, height=held.height)
    if options.alpha_sd > 0 if held is None else len(held.shared) > ALPHA:
        priors = replace(priors, alpha_sd=options.alpha_sd or priors.alpha_sd)
        others = 3 * (len(obs.alpha) - 3)
        shared = torch.cat([shared, shared.new_zeros(others)])
        free = torch.cat([free, torch.zeros(others, dtype=torch.bool)])
    if options.given is not None:
        shared, free = from_given(shared, free, options.given, held=held is not None)
    polish = Termination(tolerance=options.tolerance * 1e-2, max_iterations=60)
    chunk = -(-options.chunk // obs.channels)
    joint = JointOptions(max_iterations=options.max_iterations, tolerance=options.tolerance, chunk=chunk)
    effort = Effort(polish=polish, joint=joint, chunk=chunk)
    nothing = LocalFit(obs.images[:, 0, :1], obs.images[:, 0, 0], obs.images[:, 0, 0], obs.clipped[:, 0, 0])
    return State(
        obs=obs,
        priors=priors,
        mask=mask,
        effort=effort,
        robust=HUBER if options.robust == "huber" else None,
        sigma=sigma,
        shared=shared,
        free=free,
        body=body,
        found=nothing,
    )


def from_given(
    shared: Float[Tensor, "G"], free: Bool[Tensor, "G"], given: Learnt, *, held: bool
) -> tuple[Float[Tensor, "G"], Bool[Tensor, "G"]]:
    """Globals as another fit left them, and which of them are fitted on."""
    count = min(len(shared), len(given.shared))
    # An exponent that is fixed stays what it is.
    keep = free.clone()
    keep[[i for i in range(len(free)) if held or i not in (LOG_N_S, LOG_N_D)]] = True
    taken, free = shared.clone(), free.clone()
    taken[:count] = torch.tensor(given.shared[:count], dtype=shared.dtype)
    shared = torch.where(keep, taken, shared)
    if held:
        return shared, torch.zeros_like(free)
    free[SOFTNESS] = bool(shared[SOFTNESS] != 0)
    return shared, free


def beyond_the_edge(
    obs: Observations, body: Float[Tensor, "pixels channels 3"]
) -> Float[Tensor, "pixels channels lights"]:
    """Scattering roots of all lights, going on below zero beyond the edge of an attached shadow."""
    any_at_all = bool(obs.s.any())
    # Lights with a sweep of their own keep what was measured, moved with the extension beyond the shadow's edge.
    own = torch.tensor(obs.swept or [False] * len(obs.alpha))

    def roots(cut: slice) -> Tensor:
        measured, basis = obs.s[cut], obs.s_basis[cut]
        extended = extend_into_shadow(basis, body[cut]) if any_at_all else basis
        mixed = extended @ obs.alpha.mT
        linear = basis @ obs.alpha.mT
        s = torch.where(own, measured.minimum(measured + mixed - linear), mixed)
        s[..., :3] = extended
        return s

    return in_chunks(len(obs), roots)


def scattering_weight(obs: Observations, options: FitOptions, sigma: float) -> Float[Tensor, "pixels"]:
    """1 / standard deviation of the measured s: that of the method, and the noise of its frames."""
    size = in_chunks(len(obs), lambda cut: obs.s_basis[cut].square().mean((1, 2)).sqrt())
    return 1.0 / (options.scattering_sd * size + sigma)


def weights(obs: Observations, options: FitOptions, sigma: float) -> Float[Tensor, "pixels channels lights"]:
    """sqrt(lambda_j) / sigma of every value (Eq. 22), in the memory of one pixel."""
    factor = torch.full((obs.images.shape[-1],), options.lambda_other, dtype=obs.images.dtype)
    factor[:3] = options.lambda_basis
    if options.weights == "noise":
        factor = torch.ones_like(factor)
    return (factor.sqrt() / sigma).expand_as(obs.images)


def start(state: State, options: FitOptions, progress: Progress) -> State:
    """Globals on telling pixels, then every pixel (the paper's two steps), then the noise and the shape's scatter."""
    if options.held is not None:
        return each_pixel(state, progress)
    state = each_pixel(start_globals(state, options, progress), progress)
    state = with_noise_of_fit(state, options)
    obs = state.obs
    if options.prior == "auto" and obs.lights_known:
        # By the noise that is known only now: by the first, too large one, hardly any lobe may have counted as seen.
        vote = (state.found.cost <= quantile(state.found.cost, state.effort.trim)).nonzero()[:, 0]
        shine = in_chunks(len(vote), lambda cut: lobe_pictures(obs, state.found.local[vote[cut]], state.shared))
        spread = shape_spread(obs, taken(state.found.local, vote), state.shared, shine, state.sigma)
        shape = max(state.priors.shape, 1.0 / spread)
        state = rescored(replace(state, priors=replace(state.priors, shape=shape)))
    return state


def each_pixel(state: State, progress: Progress) -> State:
    """Every pixel on its own, and lobes handed on."""
    obs, effort = state.obs, state.effort
    progress("pixels", 0, 3)
    found = fit_locals(obs, state.priors, state.shared, effort, state.robust)
    for i, radius in enumerate((2, 1)):
        progress("pixels", i + 1, 3)
        found = hand_on_lobes(obs, state.priors, found, state.shared, state.mask, effort, state.robust, radius=radius)
    progress("pixels", 3, 3)
    return replace(state, found=found)


def start_globals(state: State, options: FitOptions, progress: Progress) -> State:
    """Globals on telling pixels, from a grid or from where another fit has left them."""
    obs, effort = state.obs, state.effort
    index = informative_pixels(obs, state.body, options.globals_pixels)

    def globals_from(state: State, starts: list[Tensor]) -> Tensor:
        part = state.obs.take(index), state.priors.take(index)
        report = lambda done, total: progress("globals", done, total)  # noqa: E731
        return fit_globals(*part, starts, state.free, effort, state.robust, report)

    n_s = GRID_N_S if options.n_s is None else (options.n_s,)
    part, priors = obs.take(index), state.priors.take(index)

    first = state.shared

    def trials(priors: Priors) -> list[Tensor]:
        if options.given is not None:
            return []
        return globals_grid(part, priors, first, n_s, trim=effort.trim, best=effort.starts)

    state = replace(state, shared=globals_from(state, trials(priors) or [first]))
    if options.prior == "auto":
        part, priors = state.obs.take(index), state.priors.take(index)
        found = fit_locals(part, priors, state.shared, effort, state.robust)
        good = (found.cost <= found.cost.quantile(effort.trim)).nonzero()[:, 0]
        shine = lobe_pictures(part, found.local, state.shared)[good]
        spread = shape_spread(part.take(good), found.local[good], state.shared, shine, state.sigma)
        state = replace(state, priors=replace(state.priors, shape=1.0 / spread))
        # Under the firmer prior another start may lead lower.
        again = trials(state.priors.take(index))
        state = replace(state, shared=globals_from(state, [state.shared, *again]))
    return state


def with_noise_of_fit(state: State, options: FitOptions) -> State:
    """The noise as the fit itself leaves it: the first figure, from before any lobe was known, is too large."""
    rms = in_chunks(len(state.obs), lambda cut: picture_residual(state, cut).square().mean((1, 2)).sqrt())
    unsound = int((~rms.isfinite() | ~state.found.cost.isfinite()).sum())
    if unsound > 0.5 * len(rms):
        raise FitError(f"{unsound} of {len(rms)} pixels have no finite cost at any start: no noise level can be told")
    unknowns = unknowns_in_effect(state.obs, state.priors, state.found.local, state.shared)
    return with_noise(state, options, noise_of(state.obs.images, rms, unknowns))


def with_noise(state: State, options: FitOptions, sigma: float) -> State:
    """`state` with another noise level, in the pictures' weights and in whatever prior goes by it."""
    obs, priors = replace(state.obs, weight=weights(state.obs, options, sigma)), state.priors
    if options.scattering == "measured" and obs.s_unknown:
        priors = replace(priors, s_weight=scattering_weight(obs, options, sigma))
    return rescored(replace(state, obs=obs, priors=priors, sigma=sigma))


def refine(state: State, options: FitOptions, progress: Progress) -> State:
    """Everything jointly; then soft shadows where they pay; then the neighbourhood's say."""
    if options.alpha_sd > 0 and options.held is None:
        # Only now: a handful of pixels would lead alphas astray before the lobe is known.
        free = state.free.clone()
        free[ALPHA:] = True
        state = replace(state, free=free)
    state = joint_step(state, "joint fit", progress)
    if options.lobe != "single" and options.held is None and not bool(state.free[SOFTNESS]):
        state = try_soft_edges(state, progress)
    if bool((state.priors.parallel > 0).any()):
        for i in range(2):
            x = unpack(state.found.local, state.obs.channels)
            s = state.obs.s_basis if x.s is None else x.s
            whole = in_chunks(len(s), lambda cut, d=x.d, s=s: d[cut] + s[cut])
            priors = with_ratio(state.priors, state.obs, whole, state.body, state.mask)
            shine = in_chunks(len(s), partial(shine_of, state))
            priors = with_facing(priors, state.obs, x, state.shared, shine, state.sigma, state.mask)
            state = rescored(replace(state, priors=priors))
            state = joint_step(hand_on(state, 1), f"neighbourhood {i + 1} of 2", progress)
    return smooth_lobes(rescored(hand_on(state, 1)), options, progress)


def smooth_lobes(state: State, options: FitOptions, progress: Progress) -> State:
    """The lobes of the neighbourhood, at finer and finer scales; how smooth they are is learnt before it has a say."""
    scales: list[tuple[float, float]] = []
    if options.held is not None:
        scales = list(options.held.scales)
    elif options.prior == "auto":
        scales = scales_of(state)
    state = replace(state, scales=tuple(scales))
    for i, (scale, spread) in enumerate(scales):
        prediction = predict(state, scale, spread)
        if prediction is None:
            continue
        state = rescored(replace(state, priors=with_lobe(state.priors, prediction)))
        C_2 = state.shared[LOG_C_2].exp()
        vector = in_chunks(len(state.obs), lambda cut, p=prediction.lobe, C_2=C_2: p[cut] * C_2)
        found = offer_lobes(state.obs, state.priors, state.found, state.shared, vector, state.effort, state.robust)
        state = joint_step(rescored(replace(state, found=found)), f"smooth lobes {i + 1} of {len(scales)}", progress)
    return state


def joint_step(state: State, stage: str, progress: Progress) -> State:
    """One joint solve of globals and all pixels."""
    total = state.effort.joint.max_iterations
    joint = fit_everything(
        state.obs,
        state.priors,
        state.found,
        state.shared,
        state.free,
        state.effort,
        state.robust,
        lambda done, limit: progress(stage, done, limit),
    )
    progress(stage, total, total)
    found = replace(state.found, local=joint.local, converged=joint.settled)
    return rescored(replace(state, shared=joint.shared, joint=joint, found=found))


def rescored(state: State) -> State:
    """Costs at the present parameters and priors."""
    problem = build_problem(state.obs, state.priors, robust=state.robust)
    cost = costs_in_chunks(problem, state.found.local, state.shared, state.effort.chunk)
    shift = cost - state.found.cost
    found = replace(state.found, cost=cost, runner_up=state.found.runner_up + shift.nan_to_num(0.0))
    return replace(state, found=found)


def hand_on(state: State, radius: int) -> State:
    """`hand_on_lobes` on the state."""
    found = hand_on_lobes(
        state.obs,
        state.priors,
        state.found,
        state.shared,
        state.mask,
        state.effort,
        state.robust,
        radius=radius,
    )
    return replace(state, found=found)


def try_soft_edges(state: State, progress: Progress) -> State:
    """Free soft shadows where there is scattering; keep them only if the cost falls by more than `EXTENSION_GAIN`.

    Of many pixels, `TRIAL` of them tell whether all are to be tried.
    """
    if not any(bool((state.obs.s[cut] != 0).any()) for cut in cuts(len(state.obs))):
        return state
    every = len(state.obs) // TRIAL
    if every > 1 and not _pays(_with_soft_edges(_every(state, every), progress), _every(state, every)):
        return state
    trial = _with_soft_edges(state, progress)
    return trial if _pays(trial, state) else state


def _with_soft_edges(state: State, progress: Progress) -> State:
    """The joint fit with them."""
    shared, free = state.shared.clone(), state.free.clone()
    shared[SOFTNESS], free[SOFTNESS] = 0.12, True
    return joint_step(rescored(replace(state, shared=shared, free=free)), "shadow edges", progress)


def _pays(trial: State, state: State) -> bool:
    before, after = float(state.found.cost.sum()), float(trial.found.cost.sum())
    return math.isfinite(after) and after < before * (1.0 - EXTENSION_GAIN)


def _every(state: State, step: int) -> State:
    """One of `step` pixels, for what needs no neighbours."""
    index, found = slice(None, None, step), state.found
    found = LocalFit(found.local[index], found.cost[index], found.runner_up[index], found.converged[index])
    return replace(state, obs=state.obs.take(index), priors=state.priors.take(index), found=found)
