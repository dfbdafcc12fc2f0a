"""The fit of a capture: pictures and scattering in, parameters of every pixel with their certainty out.

robust body -> globals on the most telling pixels, from several roughnesses -> globals on a sample of the object, its
neighbourhood and its noise in turn -> every pixel, and its neighbourhood in turn
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.data import Fit, PhotometricStack, Scattering
from reflectsep.errors import FitError
from reflectsep.fit.autograd import UnknownScattering
from reflectsep.fit.body import robust_body
from reflectsep.fit.materials import MOST, Materials, assigned, split
from reflectsep.fit.neighbours import Messages, Smoothness, best_smoothness, messages, neighbours
from reflectsep.fit.options import FitOptions
from reflectsep.fit.outcome import describe
from reflectsep.fit.problem import (
    ALPHA,
    FRESNEL,
    LOG_N_D,
    LOG_N_S,
    SOFTNESS,
    F,
    Observations,
    PixelProblem,
    globals_of,
    log_size,
)
from reflectsep.fit.sample import SAMPLE, sample
from reflectsep.fit.state import Sampled, State
from reflectsep.flags import Flag
from reflectsep.model import lobe_of, mixed
from reflectsep.progress import Progress, silent
from reflectsep.room import empty
from reflectsep.solve.joint import JointSolution, solve_joint
from reflectsep.solve.levenberg import Solution, Termination, solve_in_chunks
from reflectsep.solve.linear import factorise, solve
from reflectsep.solve.sharing import by_chunks, one_thread

HUBER = 5.0
"""Residuals beyond this many standard deviations are cast shadows or inter-reflections, not noise."""
MIN_PICTURES = {"measured": 6, "none": 6, "unknown": 8}
N_D_SD, N_D_SD_LEAST = 0.05, 0.01
"""Relative standard deviation of n_d: of 1 where no sweep tells, and the least that a sweep's is taken to have."""
FIRST_NOISE = 0.005
"""Of the brightest values: the noise that a fit starts with; the fit itself then tells."""
LEAST_NOISE = 1e-5
"""The same at least: pictures without any noise would make the arithmetic stiff."""
START_N_S = (8.0, 20.0, 60.0)
TELLING = 400
"""Pixels that the start of the globals is fitted to: the brightest highlights."""
HEIGHT_SPREAD = 0.5
"""Standard deviation of the logarithm of a highlight's height on a surface of one gloss."""
HEIGHT_SPREAD_BLIND = 3.0
"""The same where the lights are unknown: |a + B m| is then no size of a vector in space."""
TRIM_TELLING, TRIM = 0.8, 0.95
"""Share of the pixels that has a say in the globals: those that the model explains best."""
ROUNDS = 4
"""Times that neighbours and noise are learnt, and the globals with them."""
FURTHER_ROUNDS = 2
"""The same after another material was found."""
JOINT = Termination(tolerance=1e-6, max_iterations=6)
"""Of the globals, and of the pixels that follow them."""
SWEEPS = 2
"""Times that every pixel hears of its neighbours."""


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
    with one_thread():
        obs, mask, intensity = observe(stack, scattering, options)
        state = prepare(obs, mask, options)
        if options.held is None:
            state = fit_globals(state, options, progress)
        state = fit_pixels(state, options, progress)
        return describe(state, stack, scattering, intensity, options)


def observe(
    stack: PhotometricStack, scattering: Scattering | None, options: FitOptions
) -> tuple[Observations, Bool[Tensor, "height width"], Float[Tensor, "lights"]]:
    """Flatten the pixels that can be fitted, for lights of unit intensity."""
    dtype = torch.float64 if options.dtype == "float64" else torch.float32
    lights = len(stack.names)
    if lights < MIN_PICTURES[options.scattering]:
        raise FitError(
            f"{lights} pictures: the fit with {options.scattering} scattering needs at least "
            f"{MIN_PICTURES[options.scattering]}"
        )
    mask = stack.mask & ((stack.flags & int(Flag.INVALID_INPUT)) == 0)
    if not bool(mask.any()):
        raise FitError("no pixel to fit: the mask is empty or every pixel has invalid values")
    use = scattering is not None and options.scattering != "none"
    if use and scattering is not None:
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
    n_d = scattering.n_d if use and scattering is not None else 1.0
    s = images.new_zeros(()).expand_as(images)
    if use and scattering is not None:
        s = flattened(scattering.root, mask, intensity ** (1.0 / n_d))
    share = torch.full((lights, 1, 1), options.lambda_other, dtype=dtype)
    share[:3] = options.lambda_basis
    obs = Observations(
        images=images,
        s=s,
        clipped=flattened(stack.saturated, mask),
        alpha=alpha,
        M=torch.linalg.inv(basis),
        view=view,
        cosine=(basis @ view).clamp_min(1e-3) if known else torch.ones(3, dtype=dtype),
        lights_known=known,
        ggx=options.lobe == "ggx" and known,
        fixed_n_d=None if options.refine_n_d else n_d,
        n_d=n_d,
        n_d_sd=max(scattering.n_d_sd / n_d, N_D_SD_LEAST) if use and scattering is not None else N_D_SD,
        swept=scattering.measured if use and scattering is not None else (),
        share=share.sqrt(),
    )
    return obs, mask, intensity


def flattened(
    pictures: Tensor, mask: Bool[Tensor, "height width"], divisor: Float[Tensor, "lights"] | None = None
) -> Tensor:
    """Pictures (lights, channels, height, width) as (lights, channels, pixels), divided light by light."""
    result = empty(*pictures.shape[:2], int(mask.sum()), dtype=pictures.dtype)
    for j, picture in enumerate(pictures):
        for c, plane in enumerate(picture):
            values = plane[mask]
            result[j, c] = values if divisor is None else values / divisor[j].to(values.dtype)
    return result


def brightest(images: Float[Tensor, "lights channels pixels"]) -> float:
    """The 99.9 % quantile of the values, of no more than a million of them."""
    values = images.flatten()
    values = values[:: max(1, len(values) // 1_000_000)]
    return float(values.kthvalue(max(1, int(0.999 * len(values)))).values)


def prepare(obs: Observations, mask: Bool[Tensor, "height width"], options: FitOptions) -> State:
    """First globals and noise, and which of the globals are free."""
    peak = brightest(obs.images)
    if not peak > 0:
        raise FitError(f"the brightest picture values inside the mask are {peak:.3g}: nothing to fit")
    others = 3 * (len(obs.alpha) - 3) if options.alpha_sd > 0 else 0
    held = options.held
    if held is not None:
        others = len(held.shared) - ALPHA
        obs = replace(obs, kinds=held.kinds)
    shared = obs.alpha.new_zeros(ALPHA + others)
    fitted = options.shading == "fitted"
    swept = bool(obs.swept) and options.scattering == "measured"
    shared[:3] = obs.cosine.log()
    shared[LOG_N_S] = math.log(START_N_S[1] if options.n_s is None else options.n_s)
    shared[F] = (0.3 if swept else 1.0) if options.f is None else options.f
    shared[SOFTNESS] = 0.1 if fitted else 0.0
    shared[FRESNEL] = 1.0 if fitted and obs.lights_known else 0.0
    shared[LOG_N_D] = math.log(obs.n_d)
    free = torch.ones(len(shared), dtype=torch.bool)
    free[LOG_N_S] = options.n_s is None
    free[F] = options.f is None and swept
    free[SOFTNESS] = fitted
    free[FRESNEL] = fitted and obs.lights_known
    free[LOG_N_D] = options.refine_n_d
    if options.given is not None:
        given = torch.tensor(options.given.shared, dtype=shared.dtype)[: len(shared)]
        keep = free[: len(given)] | (held is not None)
        shared[: len(given)] = torch.where(keep, given, shared[: len(given)])
    if held is not None:
        free[:] = False
    spread = HEIGHT_SPREAD if obs.lights_known else HEIGHT_SPREAD_BLIND
    problem = (UnknownScattering if options.scattering == "unknown" else PixelProblem)(
        obs=obs,
        sigma=FIRST_NOISE * peak if held is None else held.noise,
        height_spread=math.inf if options.prior == "none" else spread,
        huber=HUBER if options.robust == "huber" else None,
        priors=options.prior == "auto",
        alpha_sd=options.alpha_sd or 0.02,
    )
    smooth = None if held is None or held.smooth is None else Smoothness(*held.smooth)
    local = obs.images[0, 0, :0]
    return State(problem=problem, mask=mask, shared=shared, free=free, smooth=smooth, local=local, peak=peak)


def first_locals(problem: PixelProblem, shared: Float[Tensor, "G"], body: Float[Tensor, "3 channels pixels"]) -> Tensor:
    """Locals from the robust body, with the B that puts the highlight where a mirror would: B m = 2 C_1 (N.V) (N.L).

    With M b = q N, B is 2 C_1 (N.V) / q.
    """
    obs = problem.obs
    s = obs.s[:3]
    m = (body - shared[F] * s).mean(1)
    normal = mixed(obs.M, m)
    size = (2.0 * log_size(shared, obs).exp()) if obs.lights_known else 2.0
    facing = torch.tensordot(obs.view, normal, 1) if obs.lights_known else normal.mean(0)
    # Smooth stand-in for max(., 0): a normal turned away must not make B infinite.
    facing = 0.5 * (facing + (facing.square() + 1e-6).sqrt())
    square = normal.square().sum(0) if obs.lights_known else normal.square().mean(0)
    log_B = (size * facing / (square + 1e-6)).log().clamp(-3.0, 6.0)
    return problem.packed(body - s, log_B)


def start_of(problem: PixelProblem, shared: Tensor) -> Float[Tensor, "P pixels"]:
    """`first_locals` from the pictures."""
    obs = problem.obs
    return first_locals(problem, shared, robust_body(obs.images, problem.sigma, obs.alpha, obs.n_d))


def offered(
    problem: PixelProblem, found: Solution, shared: Float[Tensor, "G"], end: Termination, chunk: int
) -> Solution:
    """Every pixel once more, from the lobe that its neighbours have; it keeps the cheaper solution.

    What that lobe leaves of the pictures is the body.
    """
    if problem.neighbours is None:
        return found

    def start(cut: slice) -> tuple[PixelProblem, Tensor]:
        part = problem.take(cut)
        obs, g = part.obs, globals_of(shared, part.obs)
        assert part.neighbours is not None
        z = 2.0 * log_size(shared, obs).exp() * part.neighbours.vector
        shine = lobe_of(g.a.view(3, -1) + z, g, obs.alpha)
        body = robust_body(obs.images - shine[:, None], part.sigma, obs.alpha, obs.n_d)
        m = (body - shared[F] * obs.s[:3]).mean(1)
        B = (z * m).sum(0) / m.square().sum(0).clamp_min(1e-12)
        return part, part.packed(body - obs.s[:3], B.clamp(1e-2, 1e3).log())

    other = solve_in_chunks(len(problem), chunk, shared, end, start)
    better = other.cost < found.cost
    return Solution(
        torch.where(better, other.local, found.local),
        torch.where(better, other.cost, found.cost),
        torch.where(better, other.status, found.status),
    )


def telling(problem: PixelProblem, chunk: int) -> Tensor:
    """Pixels whose pictures stand highest above their diffuse part: every second of the first 2 `TELLING`.

    Every second, so that not only the cores of a few highlights speak.
    """

    def height(cut: slice) -> tuple[Tensor]:
        part = problem.take(cut).obs
        body = robust_body(part.images, problem.sigma, part.alpha, part.n_d)
        plain = mixed(part.alpha, body).clamp_min(0.0)
        above = (part.images - plain) if part.n_d == 1.0 else part.images - plain**part.n_d
        return (above.mean(1).clamp_min(0.0).amax(0),)

    above = by_chunks(len(problem), chunk, height)[0]
    order = above.argsort(descending=True)
    return order[: 2 * TELLING : 2] if len(order) >= 2 * TELLING else order[:TELLING]


def fit_globals(state: State, options: FitOptions, progress: Progress) -> State:
    """The globals, the noise and the smoothness of the lobes, from a sample of the object."""
    chosen = sample(state.mask, SAMPLE)
    every = state.problem.take(chosen.index)
    state = replace(state, shared=start_globals(every, state, options, progress))
    shared, free = state.shared, state.free
    whole = Termination(tolerance=options.tolerance, max_iterations=options.max_iterations)

    def settle(problem: PixelProblem, local: Tensor, shared: Tensor) -> Solution:
        return solved(problem, local, shared, whole, options)

    def joint(problem: PixelProblem, local: Tensor, shared: Tensor, free: Tensor) -> JointSolution:
        return solve_joint(problem, local, shared, free, end=JOINT, inner=JOINT, chunk=options.chunk, trim=TRIM)

    last: JointSolution | None = None
    smooth: Smoothness | None = None
    problem = every
    found = settle(problem, start_of(problem, shared), shared)
    local = found.local
    rounds = ROUNDS
    while rounds:
        for _ in range(rounds):
            progress("globals", 1, 2)
            problem = replace(problem, sigma=noise_of(problem, local, shared, options.chunk, LEAST_NOISE * state.peak))
            if options.prior == "auto" and options.scattering != "unknown":
                said = all_messages(problem, local, shared, options.chunk)
                smooth = best_smoothness(said, chosen.mask)
                problem = replace(problem, neighbours=neighbours(said, chosen.mask, smooth))
            found = offered(problem, solved(problem, local, shared, whole, options), shared, whole, options.chunk)
            local = found.local
            if options.method == "joint":
                last = joint(problem, local, shared, free)
                local, shared = last.local, last.shared
        rounds = 0
        if options.method == "joint" and problem.obs.kinds < (options.materials or MOST):
            # By the pictures alone: what the neighbours said rests on the materials as they were.
            alone = replace(problem, neighbours=None)
            found = settle(alone, local, shared)
            now = Materials(problem=alone, local=found.local, cost=found.cost, shared=shared, free=free)
            more = split(now, chosen.mask, settle, joint, sure=options.materials is not None)
            if more is not None:
                problem, local, shared, free = more.problem, more.local, more.shared, more.free
                rounds = FURTHER_ROUNDS
    progress("globals", 2, 2)
    final = replace(state.problem, sigma=problem.sigma, obs=replace(state.problem.obs, kinds=problem.obs.kinds))
    sampled = Sampled(chosen, problem, local)
    return replace(state, problem=final, shared=shared, free=free, smooth=smooth, joint=last, sampled=sampled)


def start_globals(problem: PixelProblem, state: State, options: FitOptions, progress: Progress) -> Float[Tensor, "G"]:
    """Globals on the most telling pixels, from each of several roughnesses; the best of them."""
    index = telling(problem, options.chunk)
    part = problem.take(index)
    free = state.free.clone()
    free[[F, LOG_N_D]] = False
    free[ALPHA:] = False
    above = brightest(part.obs.images) / 2.0
    starts = START_N_S if options.n_s is None else (options.n_s,)
    if options.given is not None:
        starts = (float(state.shared[LOG_N_S].exp()),)
    end = Termination(tolerance=1e-4, max_iterations=10)
    inner = Termination(tolerance=1e-4, max_iterations=8)
    results = []
    for i, n_s in enumerate(starts):
        progress("globals", i, len(START_N_S) + ROUNDS)
        shared = state.shared.clone()
        if options.given is None:
            shared[LOG_N_S] = math.log(n_s)
            # The height C_1^n_s of the lobe is that of the highlights.
            shared[:3] += math.log(above) / n_s - log_size(shared, part.obs)
        local = start_of(part, shared)
        joint = solve_joint(part, local, shared, free, end=end, inner=inner, chunk=options.chunk, trim=TRIM_TELLING)
        number = max(1, int(TRIM_TELLING * len(part)))
        cost = float(joint.cost.sort().values[:number].sum() + 0.5 * part.shared_rows(joint.shared).square().sum())
        results.append((cost if math.isfinite(cost) else math.inf, i, joint.shared))
    return min(results, key=lambda entry: entry[:2])[2]


def solved(problem: PixelProblem, local: Tensor, shared: Tensor, end: Termination, options: FitOptions) -> Solution:
    """Every pixel of a problem from where it is."""
    return solve_in_chunks(
        len(problem), options.chunk, shared, end, lambda cut: (problem.take(cut), local[:, cut].contiguous())
    )


def all_messages(problem: PixelProblem, local: Tensor, shared: Tensor, chunk: int) -> Messages:
    """`messages` of all pixels."""

    def part(cut: slice) -> tuple[Tensor, Tensor]:
        said = messages(problem.take(cut), local[:, cut].contiguous(), shared)
        return said.mean.mT, said.covariance.mT

    mean, covariance = by_chunks(len(problem), chunk, part)
    return Messages(mean.mT, covariance.mT)


def noise_of(problem: PixelProblem, local: Tensor, shared: Tensor, chunk: int, least: float) -> float:
    """Standard deviation of a residual, freedoms counted: r^2 / (values - tr(V^-1 J^T J)), the worst tenth left out.

    Raises:
        FitError: most pixels have no finite cost.
    """

    def part(cut: slice) -> tuple[Tensor]:
        some, at = problem.take(cut), local[:, cut].contiguous()
        count = some.obs.images.shape[0] * some.obs.channels
        rows = some.residuals(at, shared)
        _, weight = some.robust(rows)
        J = some.jacobian(at, shared)[:count]
        V = some.normal(at, shared).V
        firm = 1e-9 * V.diagonal(dim1=0, dim2=1).mT.amax(0) + torch.finfo(V.dtype).tiny
        solution = solve(factorise(V, firm.expand(len(V), -1)), (J * weight[:count, None]).transpose(0, 1))
        used = (solution * J.transpose(0, 1)).sum((0, 1))
        misfit = (rows[:count] / some.weight.expand(some.obs.images.shape).flatten(0, 1)).square().sum(0)
        return (misfit / (count - used).clamp_min(0.2),)

    square = by_chunks(len(problem), chunk, part)[0]
    sound = square[square.isfinite()]
    if len(sound) < 0.5 * len(square):
        raise FitError(
            f"{len(square) - len(sound)} of {len(square)} pixels have no finite cost: no noise level can be told"
        )
    kept = sound.sort().values[: max(1, int(0.9 * len(sound)))]
    return max(math.sqrt(float(kept.mean())), least)


def fit_pixels(state: State, options: FitOptions, progress: Progress) -> State:
    """Every pixel under the globals, then again under what its neighbours say."""
    problem, shared = state.problem, state.shared
    whole = Termination(tolerance=options.tolerance, max_iterations=options.max_iterations)
    steps = 1 + (SWEEPS if state.smooth is not None else 0)
    progress("pixels", 0, steps)
    if state.sampled is not None and len(state.sampled.chosen.index) == len(problem):
        problem = state.sampled.problem
        found = solved(problem, state.sampled.local, shared, whole, options)
        steps = min(steps, 2)
    else:

        def first(problem: PixelProblem, _: Tensor, shared: Tensor) -> Solution:
            return solve_in_chunks(
                len(problem),
                options.chunk,
                shared,
                whole,
                lambda cut: (part := problem.take(cut), start_of(part, shared)),
            )

        found, problem = assigned(problem, state.local, shared, state.mask, first)
    for i in range(1, steps):
        progress("pixels", i, steps)
        assert state.smooth is not None
        said = all_messages(problem, found.local, shared, options.chunk)
        problem = replace(problem, neighbours=neighbours(said, state.mask, state.smooth))
        found = offered(problem, solved(problem, found.local, shared, whole, options), shared, whole, options.chunk)
    progress("pixels", steps, steps)
    return replace(state, problem=problem, local=found.local, cost=found.cost, status=found.status)
