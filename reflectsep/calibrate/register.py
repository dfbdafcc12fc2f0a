"""Registration of pictures that show the same thing: robust, photometric, coarse to fine, model chosen by evidence.

    moving(sample_p(x)) = sum_i c_i template_i(x) + b          for most pixels x

c and b are free, so that an unknown exposure ratio (C of Eq. 25) does no harm; with several templates the moving
picture may be any mix of them (Eq. 15). Gauss-Newton on p, c and b together, Tukey's biweight whose scale is let down
from the first residual to the noise; the gradient is the mean of both sides', which converges in a handful of steps.
The moving picture is always resampled from the original.

Evidence: of the nested models (none, translation, rigid, affine, homography) a richer one is taken where its further
parameters differ from nothing beyond chance (Wald; a covariance with the tiles of the picture as independent draws,
and a floor for what interpolation does). Any motion must besides predict pixels that it was not fitted to: the tiles
are split like a chessboard, and each half is predicted by the fit to the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from kornia.filters import gaussian_blur2d, spatial_gradient
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from reflectsep.calibrate.motion import MODELS, Model, displacement, inside, pixel_grid, positions, sample
from reflectsep.errors import CaptureError

TUKEY = 4.685
MAD_TO_SIGMA = 1.4826
COARSEST_PX = 24
FEWEST_PIXELS = 64
SLOPE_BLURS = (0.0, 1.0, 1.6, 2.4, 3.6)
SLOPE_NOISE = 0.05


@dataclass(frozen=True, kw_only=True)
class RegisterOptions:
    """How two pictures are registered."""

    models: tuple[Model, ...] = MODELS
    blur_px: float = 0.8
    """Of both pictures before they are compared: interpolation and noise weigh less."""
    levels: int = 4
    """Halvings at most."""
    iterations: int = 30
    tiles: int = 8
    """Along each side, for the evidence and the standard deviation."""
    evidence: float = 3.5
    """x of the bound P(chi^2_k >= k + 2 sqrt(k x) + 2 x) <= exp(-x) that a richer model must pass."""
    unseen: float = 2.0
    """Standard errors by which a motion must predict better what it was not fitted to."""
    floor_px: float = 0.01
    """Systematic error of a motion (interpolation) that is always allowed for."""
    most_pixels: int = 500_000
    """Larger pictures are halved until they are no larger; a twentieth of a pixel is seen there too."""
    noise_floor: float = 1e-3
    """Least residual, as a share of the picture's bright end, that is told from agreement."""
    lenient_turn: bool = True
    """Whether a rotation is taken where it predicts best (Akaike) rather than where it is beyond chance: right for a
    camera that was touched, and pictures of the same light."""
    drift: bool = False
    """Whether slow drift along `time` may be found besides."""


@dataclass(frozen=True, kw_only=True)
class Registration:
    """What a registration found."""

    matrix: Float[Tensor, "3 3"]
    model: Model
    velocity: tuple[float, float]
    displacement_px: float
    sd_px: float
    trust: float
    coefficients: Float[Tensor, "templates"]
    residual: float
    """Robust standard deviation after it, in the pictures' units."""
    gain_in_agreement: float
    """Relative fall of the error on pixels not fitted to, against no motion."""
    significance: float
    """That fall in standard errors."""


@dataclass(frozen=True, kw_only=True)
class _Level:
    """Both sides at one scale."""

    moving: Float[Tensor, "height width"]
    moving_bad: Float[Tensor, "height width"]
    templates: Float[Tensor, "templates height width"]
    weight: Float[Tensor, "height width"]
    slopes: Float[Tensor, "templates 2 height width"]
    slope_blur_px: float
    """Further blur of pictures that slopes are taken from."""
    time: Float[Tensor, "height width"]
    factor: int


@dataclass(frozen=True, kw_only=True)
class _State:
    matrix: Tensor
    velocity: Tensor
    coefficients: Tensor
    sigma: float
    cost: Tensor
    """Per pixel, Tukey's rho in units of sigma^2, 0 where there is no weight."""
    weights: Tensor
    covariance: Tensor | None = None


def register(
    moving: Float[Tensor, "height width"],
    templates: Float[Tensor, "templates height width"],
    *,
    usable: Bool[Tensor, "height width"],
    moving_usable: Bool[Tensor, "height width"] | None = None,
    time: Float[Tensor, "height width"] | None = None,
    options: RegisterOptions | None = None,
    start: Float[Tensor, "3 3"] | None = None,
) -> Registration:
    """Find the motion of `moving` against `templates`.

    Args:
        moving: the picture that may have moved.
        templates: pictures in the reference's place; the moving one is a mix of them and a constant.
        usable: reference pixels that count: on the object and a margin around it, not clipped in a template.
        moving_usable: pixels of the moving picture that are not clipped and finite.
        time: -1 to 1, when a sweep's light reached each pixel; needed for `options.drift`.
        options: settings.
        start: first guess of the matrix.

    Returns:
        The motion; identity where no model predicts unseen pixels better.

    Raises:
        CaptureError: fewer than 64 pixels to compare.
    """
    options = options or RegisterOptions()
    count = int(usable.sum())
    if count < FEWEST_PIXELS:
        raise CaptureError(f"{count} pixels can be compared, expected at least {FEWEST_PIXELS}")
    moving_usable = torch.ones_like(usable) if moving_usable is None else moving_usable
    time = torch.zeros(usable.shape) if time is None else time
    pyramid = _pyramid(moving, moving_usable, templates, usable, time, options)
    finest = pyramid[-1]
    matrix = torch.eye(3, dtype=torch.float64) if start is None else _to_level(start.double(), finest.factor)
    matrix = _coarse(pyramid, matrix, options)
    cameras: list[Model] = [model for model in options.models if model not in ("affine", "homography")]
    candidates: list[tuple[Model, bool]] = [(model, False) for model in cameras]
    if options.drift:
        # Before affine: a drift along the sweep is a stretch, and the likelier reason for one.
        candidates.extend((model, True) for model in cameras if model != "identity")
    candidates.extend((model, False) for model in options.models if model not in cameras)
    return _choose(finest, matrix, candidates, usable, options)


def _coarse(pyramid: Sequence[_Level], matrix: Tensor, options: RegisterOptions) -> Tensor:
    """Translation, then a rigid motion, from the coarsest level to the finest; in the finest's coordinates."""
    finest = pyramid[-1]
    best = matrix
    for level in pyramid:
        ratio = level.factor // finest.factor
        local = _to_level(best, ratio)
        for model in ("translation", "rigid"):
            if model in options.models:
                # Here "translation" only moves; the rotation of the level before stays.
                local = _solve(level, model, local, options).matrix
        best = _from_level(local, ratio)
    return best


def _choose(
    level: _Level, start: Tensor, candidates: Sequence[tuple[Model, bool]], usable: Tensor, options: RegisterOptions
) -> Registration:
    fits = {}
    for model, drifting in candidates:
        fits[model, drifting] = _solve(level, model, _restricted(start, model, level), options, drifting=drifting)
    chosen = candidates[0]
    for candidate in candidates[1:]:
        if _exceeds(fits[candidate], chosen, candidate, level, options):
            chosen = candidate
    fall, significance = 0.0, 0.0
    if chosen != candidates[0]:
        fall, significance = _on_unseen(level, fits[candidates[0]], fits[chosen], candidates[0], chosen, options)
        if significance < options.unseen:
            chosen = candidates[0]
    state = fits[chosen]
    matrix = _from_level(state.matrix, level.factor)
    weighed = level.weight > 0
    return Registration(
        matrix=matrix,
        model=chosen[0],
        velocity=(float(state.velocity[0]) * level.factor, float(state.velocity[1]) * level.factor),
        displacement_px=displacement(matrix, usable),
        sd_px=_sd_px(level, state, chosen, options) * level.factor,
        trust=float(state.weights[weighed].mean()),
        coefficients=state.coefficients,
        residual=state.sigma,
        gain_in_agreement=fall,
        significance=significance,
    )


def _exceeds(
    state: _State, simple: tuple[Model, bool], rich: tuple[Model, bool], level: _Level, options: RegisterOptions
) -> bool:
    """Whether the richer model's further parameters are beyond chance (Wald's test)."""
    if state.covariance is None:
        return False
    values, covariance = _parameters(state, rich, level, options)
    further = _further(simple, rich)
    if not len(further):
        return False
    values, covariance = further @ values, further @ covariance @ further.mT
    wald = float(values @ torch.linalg.solve(covariance, values))
    k = len(further)
    if options.lenient_turn and simple[0] == "translation" and rich[0] == "rigid" and simple[1] == rich[1]:
        return wald > 2.0 * k
    return wald > k + 2 * (k * options.evidence) ** 0.5 + 2 * options.evidence


def _parameters(
    state: _State, kind: tuple[Model, bool], level: _Level, options: RegisterOptions
) -> tuple[Tensor, Tensor]:
    """The motion as parameters in pixels at the picture's rim, with their covariance."""
    assert state.covariance is not None
    count = len(state.coefficients)
    covariance = state.covariance[:-count, :-count]
    floor = (options.floor_px / level.factor) ** 2
    covariance = covariance + floor * torch.eye(len(covariance), dtype=torch.float64)
    centre, scale = _frame(level)
    local = centre @ state.matrix @ torch.linalg.inv(centre)
    local = local / local[2, 2]
    linear = (local[:2, :2] - torch.eye(2, dtype=torch.float64)) * scale
    parts = {
        "identity": [],
        "translation": [local[:2, 2] * scale],
        "rigid": [local[:2, 2] * scale, torch.atan2(local[1, 0], local[0, 0])[None] * scale],
        "affine": [local[:2, 2] * scale, linear.flatten()],
        "homography": [local[:2, 2] * scale, linear.flatten(), local[2, :2] * scale],
    }[kind[0]]
    if kind[1]:
        parts.append(state.velocity)
    return torch.cat(parts), covariance


_DEGREES = {"identity": 0, "translation": 1, "rigid": 2, "affine": 3, "homography": 4}


def _further(simple: tuple[Model, bool], rich: tuple[Model, bool]) -> Tensor:
    """Rows that pick from the richer model's parameters what the simpler one holds at nothing; none if not nested."""
    size = {"identity": 0, "translation": 2, "rigid": 3, "affine": 6, "homography": 8}[rich[0]]
    unit = torch.eye(size + 2 * rich[1], dtype=torch.float64)
    if _DEGREES[simple[0]] > _DEGREES[rich[0]] or (simple[1] and not rich[1]):
        return unit[:0]
    rows = [unit[size:]]
    if simple[0] == "identity":
        rows.append(unit[:size])
    elif simple[0] == "translation":
        rows.append(unit[2:size])
    elif simple[0] == "rigid" and size > 3:
        stretch = torch.stack([unit[2], unit[5], unit[3] + unit[4]])  # not the rotation
        rows += [stretch, unit[6:size]]
    elif simple[0] == "affine":
        rows.append(unit[6:size])
    return torch.cat(rows)


def _on_unseen(
    level: _Level,
    simple: _State,
    rich: _State,
    first: tuple[Model, bool],
    second: tuple[Model, bool],
    options: RegisterOptions,
) -> tuple[float, float]:
    """By how much, relatively and in standard errors, the richer model predicts pixels better that it has not seen."""
    halves = _chessboard(level.weight, options.tiles)
    sigma = min(simple.sigma, rich.sigma)
    errors = []
    for state, (model, drifting) in ((simple, first), (rich, second)):
        parts = []
        for half in halves:
            some = replace(level, weight=level.weight * half)
            fitted = _solve(some, model, state.matrix, options, drifting=drifting, begin=state)
            parts.append((fitted, half))
        errors.append(_per_tile(_rho(_unseen(level, parts), sigma), level.weight, options.tiles))
    before, after = float(errors[0][0].sum()), float(errors[1][0].sum())
    return (1.0 - after / before if before > 0 else 0.0), _better(errors[0], errors[1])


def _restricted(matrix: Tensor, model: Model, level: _Level) -> Tensor:
    """The motion of a model that is next to `matrix` in the middle of the picture."""
    if model in ("affine", "homography", "rigid"):
        return matrix
    still = torch.eye(3, dtype=torch.float64)
    if model == "translation":
        height, width = level.weight.shape
        middle = torch.tensor([(width - 1) / 2, (height - 1) / 2, 1.0], dtype=torch.float64)
        moved = matrix @ middle
        still[:2, 2] = moved[:2] / moved[2] - middle[:2]
    return still


def _better(simple: tuple[Tensor, Tensor], rich: tuple[Tensor, Tensor]) -> float:
    """By how many standard errors the richer model predicts the tiles better."""
    counts = simple[1]
    full = counts > 0
    difference = (simple[0] - rich[0])[full]
    if difference.numel() < 4:
        return 0.0
    total = difference.sum()
    spread = difference.var() * difference.numel()
    return float(total / spread.sqrt().clamp_min(1e-30)) if float(spread) > 0 else 0.0


def _unseen(level: _Level, parts: Sequence[tuple[_State, Tensor]]) -> Tensor:
    """Residual of every pixel under the fit to the half that does not have it."""
    result = torch.zeros_like(level.moving)
    for state, half in parts:
        residual, _, valid = _residual(level, state)
        # What the motion leaves no data for counts as no disagreement for any model.
        result = torch.where((half == 0) & valid, residual, result)
    return result


def _rho(error: Tensor, sigma: float) -> Tensor:
    unit = (error / (TUKEY * sigma)).square().clamp(max=1.0)
    return 1.0 - (1.0 - unit) ** 3


def _per_tile(values: Tensor, weight: Tensor, tiles: int) -> tuple[Tensor, Tensor]:
    tile = _tile_index(weight, tiles).flatten()
    sums = torch.zeros(tiles * tiles, dtype=torch.float64)
    counts = sums.clone()
    sums.index_add_(0, tile, (values * weight).flatten())
    counts.index_add_(0, tile, weight.flatten())
    return sums, counts


def _tile_index(like: Tensor, tiles: int) -> Tensor:
    """Index of every pixel's tile; tiles share out the box of the pixels that count."""
    height, width = like.shape
    rows = (like > 0).any(1).nonzero()[:, 0]
    columns = (like > 0).any(0).nonzero()[:, 0]
    top, bottom = int(rows[0]), int(rows[-1]) + 1
    left, right = int(columns[0]), int(columns[-1]) + 1
    y = ((torch.arange(height) - top).clamp(0, bottom - top - 1) * tiles) // (bottom - top)
    x = ((torch.arange(width) - left).clamp(0, right - left - 1) * tiles) // (right - left)
    return y[:, None] * tiles + x[None, :]


def _chessboard(weight: Tensor, tiles: int) -> tuple[Tensor, Tensor]:
    index = _tile_index(weight, tiles)
    dark = ((index // tiles + index % tiles) % 2).double()
    return dark, 1.0 - dark


def _to_level(matrix: Tensor, factor: int) -> Tensor:
    """A matrix of full pixels in those of a picture that was shrunk by `factor`."""
    shrink = _shrink(factor)
    return shrink @ matrix @ torch.linalg.inv(shrink)


def _from_level(matrix: Tensor, factor: int) -> Tensor:
    shrink = _shrink(factor)
    back = torch.linalg.inv(shrink) @ matrix @ shrink
    return back / back[2, 2]


def _shrink(factor: int) -> Tensor:
    offset = (1.0 / factor - 1.0) / 2.0  # pixel centres of averaged blocks
    return torch.tensor([[1.0 / factor, 0, offset], [0, 1.0 / factor, offset], [0, 0, 1.0]], dtype=torch.float64)


def _pyramid(
    moving: Tensor, moving_usable: Tensor, templates: Tensor, usable: Tensor, time: Tensor, options: RegisterOptions
) -> list[_Level]:
    """Coarsest first."""
    pictures = torch.cat([moving[None], templates]).double()
    pictures = torch.where(torch.isfinite(pictures), pictures, 0.0)
    bad, weight, time = (~moving_usable).double(), usable.double(), time.double()
    factor, levels = 1, []
    while True:
        if pictures[0].numel() <= options.most_pixels:
            levels.append(_level(pictures, bad, weight, time, factor, options.blur_px))
            if len(levels) > options.levels or min(pictures.shape[1:]) < 2 * COARSEST_PX:
                break
        pictures = avg_pool2d(pictures[:, None], 2)[:, 0]
        time = avg_pool2d(time[None, None], 2)[0, 0]
        bad = max_pool2d(bad[None, None], 2)[0, 0]
        weight = avg_pool2d(weight[None, None], 2)[0, 0]
        factor *= 2
    return levels[::-1]


def _level(pictures: Tensor, bad: Tensor, weight: Tensor, time: Tensor, factor: int, blur_px: float) -> _Level:
    radius = max(1, round(3 * blur_px))
    smooth = _blurred(pictures, blur_px)
    slope_blur_px = _slope_blur(pictures, smooth, weight, blur_px)
    grown = max_pool2d(bad[None, None], 2 * radius + 1, stride=1, padding=radius)[0, 0]
    holes = max_pool2d((weight == 0).double()[None, None], 3, stride=1, padding=1)[0, 0]
    return _Level(
        moving=smooth[0],
        moving_bad=grown,
        templates=smooth[1:],
        weight=torch.where(holes > 0, 0.0, weight),
        slopes=_slopes(smooth[1:], slope_blur_px),
        slope_blur_px=slope_blur_px,
        time=time,
        factor=factor,
    )


def _blurred(pictures: Tensor, blur_px: float) -> Tensor:
    if blur_px <= 0:
        return pictures
    size = 2 * max(1, round(3 * blur_px)) + 1
    size = min(size, 2 * ((min(pictures.shape[1:]) - 1) // 2) + 1)
    return gaussian_blur2d(pictures[:, None], (size, size), (blur_px, blur_px), border_type="replicate")[:, 0]


def _slopes(pictures: Tensor, blur_px: float) -> Tensor:
    return spatial_gradient(_blurred(pictures, blur_px)[:, None], mode="diff", order=1)[:, 0]


def _slope_blur(raw: Tensor, smooth: Tensor, weight: Tensor, blur_px: float) -> float:
    """The least further blur at which noise makes up less than `SLOPE_NOISE` of the slopes' energy.

    Noisy slopes would be taken for signal: the estimate would seem surer than it is, and follow the noise.
    """
    kernel = torch.tensor([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]], dtype=raw.dtype) / 6.0
    counts = weight > 0
    detail = torch.nn.functional.conv2d(raw[:, None], kernel[None, None], padding=1)[:, 0, counts]
    noise = MAD_TO_SIGMA * detail.abs().median(1).values
    for more in SLOPE_BLURS:
        energy = _slopes(smooth, more).square().sum(1)[:, counts].mean(1)
        width = (blur_px**2 + more**2) ** 0.5
        share = noise.square() / (4 * torch.pi * width**4) / energy.clamp_min(1e-300)
        if bool((share < SLOPE_NOISE).all()):
            return more
    return SLOPE_BLURS[-1]


def _residual(level: _Level, state: _State) -> tuple[Tensor, Tensor, Tensor]:
    """Moving - mix, the moved picture, and where both are measured."""
    height, width = level.moving.shape
    places = positions(state.matrix, height, width, state.velocity[:, None, None] * level.time)
    both = sample(torch.stack([level.moving, level.moving_bad]), places, "bicubic")
    valid = inside(places) & (both[1] < 0.5) & (level.weight > 0)
    mix = torch.einsum("i,ihw->hw", state.coefficients[:-1], level.templates) + state.coefficients[-1]
    return both[0] - mix, both[0], valid


def _fit_mix(level: _Level, moved: Tensor, weights: Tensor) -> Tensor:
    """Weighted least squares for the coefficients and the constant."""
    columns = torch.cat([level.templates, torch.ones_like(moved)[None]]).flatten(1).mT
    w = weights.flatten()[:, None]
    gram = columns.mT @ (w * columns)
    ridge = 1e-10 * torch.diag(gram.diagonal().clamp_min(1e-300))
    return torch.linalg.solve(gram + ridge, columns.mT @ (w * moved.flatten()[:, None]))[:, 0]


def _solve(
    level: _Level,
    model: Model,
    start: Tensor,
    options: RegisterOptions,
    *,
    drifting: bool = False,
    begin: _State | None = None,
) -> _State:
    """Gauss-Newton for one model at one level; from `begin` with its scale held, where given."""
    count = len(level.templates) + 1
    state = _State(
        matrix=start.clone(),
        velocity=torch.zeros(2, dtype=torch.float64) if begin is None else begin.velocity,
        coefficients=torch.zeros(count, dtype=torch.float64),
        sigma=float("inf"),
        cost=torch.zeros_like(level.moving),
        weights=level.weight,
    )
    _, moved, valid = _residual(level, state)
    floor = options.noise_floor * float(_bright(level))
    state = replace(state, coefficients=_fit_mix(level, moved, level.weight * valid))
    sigma = None if begin is None else begin.sigma
    for _ in range(options.iterations):
        residual, moved, valid = _residual(level, state)
        if int(valid.sum()) < FEWEST_PIXELS // 4:
            return state
        robust = max(MAD_TO_SIGMA * float(residual[valid].abs().median()), floor)
        if begin is None:
            rms = float(residual[valid].square().mean().sqrt())
            sigma = max(rms, robust) if sigma is None else max(robust, 0.7 * sigma)
        assert sigma is not None
        weights = (1.0 - (residual / (TUKEY * sigma)).square()).clamp_min(0).square() * valid * level.weight
        state = replace(state, sigma=sigma, weights=weights)
        columns = _columns(level, state, moved, model, drifting)
        step, covariance = _step(columns, residual, weights, level, options)
        state = replace(state, covariance=covariance)
        state = _moved(state, step, model, drifting, level)
        motion = step[: len(step) - count]
        if (motion.numel() == 0 or float(motion.abs().max()) < 1e-4) and sigma <= 1.01 * robust:
            break
    residual, _, valid = _residual(level, state)
    unit = (residual / (TUKEY * state.sigma)).square()
    weights = (1.0 - unit).clamp_min(0).square() * valid * level.weight
    return replace(state, weights=weights)


def _bright(level: _Level) -> Tensor:
    values = level.moving[level.weight > 0].abs()
    return values.kthvalue(max(1, round(0.99 * values.numel()))).values if values.numel() else torch.tensor(1.0)


def _columns(level: _Level, state: _State, moved: Tensor, model: Model, drifting: bool) -> Tensor:
    """Derivatives of the residual by the motion (pixels at the object's rim) and by the mix: (pixels, unknowns)."""
    slope = _slopes(moved[None], level.slope_blur_px)[0]
    mixed = torch.einsum("i,idhw->dhw", state.coefficients[:-1], level.slopes)
    gx, gy = 0.5 * (slope + mixed)
    x, y, _ = _centred(level)
    parts: list[Tensor] = []
    if model != "identity":
        parts += [gx, gy]
    if model == "rigid":
        parts += [-gx * y + gy * x]
    if model in ("affine", "homography"):
        parts += [gx * x, gx * y, gy * x, gy * y]
    if model == "homography":
        radial = gx * x + gy * y
        parts += [-radial * x, -radial * y]
    if drifting:
        parts += [gx * level.time, gy * level.time]
    mix = [*(-template for template in level.templates), -torch.ones_like(moved)]
    return torch.stack([*parts, *mix]).flatten(1).mT


def _centred(level: _Level) -> tuple[Tensor, Tensor, float]:
    """Coordinates about the middle of what counts, over half its size: parameters are all in pixels."""
    height, width = level.weight.shape
    x, y, _ = pixel_grid(height, width)
    scale = max(height, width) / 2.0
    return (x - (width - 1) / 2) / scale, (y - (height - 1) / 2) / scale, scale


def _step(
    columns: Tensor, residual: Tensor, weights: Tensor, level: _Level, options: RegisterOptions
) -> tuple[Tensor, Tensor]:
    """Gauss-Newton step, and the covariance of the unknowns with tiles as the independent draws."""
    counts = weights.flatten() > 0
    columns, w, error = columns[counts], weights.flatten()[counts], residual.flatten()[counts]
    scale = (columns.square() * w[:, None]).sum(0).sqrt().clamp_min(1e-30)
    unit = columns / scale
    gram = unit.mT @ (w[:, None] * unit)
    gram = gram + 1e-9 * torch.eye(gram.shape[0], dtype=gram.dtype)
    step = -torch.linalg.solve(gram, unit.mT @ (w * error)) / scale
    inverse = torch.linalg.inv(gram)
    density = max(_noise_density(residual, weights, options), 1e-30)
    plain = inverse * density
    tile = _tile_index(level.weight, options.tiles).flatten()[counts]
    sums = torch.zeros(options.tiles**2, unit.shape[1], dtype=unit.dtype)
    sums.index_add_(0, tile, (w * error)[:, None] * unit)
    tiled = inverse @ (sums.mT @ sums) @ inverse
    # Tiles see what noise alone does not say, but a few that hold most of the outline are too few draws by themselves.
    excess = float((gram @ tiled).trace()) / density / len(plain)
    covariance = plain * max(1.0, excess) / (scale[:, None] * scale[None, :])
    return step, covariance


def _noise_density(residual: Tensor, weights: Tensor, options: RegisterOptions) -> float:
    """Variance that independent pixels would need to move the estimate as much as these, which the blur correlates."""
    total = weights.sum().clamp_min(1.0)
    variance = (weights * residual.square()).sum() / total
    return float(variance) * max(1.0, 4.0 * torch.pi * options.blur_px**2)


def _moved(state: _State, step: Tensor, model: Model, drifting: bool, level: _Level) -> _State:
    """The state after a step; the motion's part is composed before the matrix (x -> S (x + step))."""
    count = len(state.coefficients)
    motion, mix = step[: len(step) - count], step[len(step) - count :]
    velocity = state.velocity
    if drifting:
        velocity = velocity + motion[-2:].clamp(-2.0, 2.0)
        motion = motion[:-2]
    matrix = state.matrix
    if model != "identity":
        longest = float(motion.abs().max())
        motion = motion * min(1.0, 2.0 / max(longest, 1e-30))  # a linearisation holds for a pixel or two
        matrix = matrix @ _increment(motion, model, level)
        matrix = matrix / matrix[2, 2]
    return replace(state, matrix=matrix, velocity=velocity, coefficients=state.coefficients + mix)


def _frame(level: _Level) -> tuple[Tensor, float]:
    """Matrix to the coordinates of `_centred`, and their scale."""
    height, width = level.weight.shape
    scale = max(height, width) / 2.0
    matrix = torch.tensor(
        [[1 / scale, 0, -(width - 1) / 2 / scale], [0, 1 / scale, -(height - 1) / 2 / scale], [0, 0, 1]],
        dtype=torch.float64,
    )
    return matrix, scale


def _increment(motion: Tensor, model: Model, level: _Level) -> Tensor:
    centre, scale = _frame(level)
    local = torch.eye(3, dtype=torch.float64)
    local[0, 2], local[1, 2] = motion[0] / scale, motion[1] / scale
    if model == "rigid":
        angle = motion[2] / scale
        c, s = angle.cos(), angle.sin()
        local[:2, :2] = torch.stack([torch.stack([c, -s]), torch.stack([s, c])])
    if model in ("affine", "homography"):
        local[:2, :2] += motion[2:6].view(2, 2) / scale
    if model == "homography":
        local[2, :2] = motion[6:8] / scale
    return torch.linalg.inv(centre) @ local @ centre


def _sd_px(level: _Level, state: _State, kind: tuple[Model, bool], options: RegisterOptions) -> float:
    """RMS over the pixels that count of the displacement's standard deviation, pixels of the level."""
    if state.covariance is None or kind[0] == "identity":
        return 0.0
    _, covariance = _parameters(state, kind, level, options)
    x, y, _ = _centred(level)
    counts = level.weight > 0
    x, y = x[counts], y[counts]
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    columns = {"translation": [], "rigid": [(-y, x)], "affine": [], "homography": []}[kind[0]]
    if kind[0] in ("affine", "homography"):
        columns += [(x, zero), (y, zero), (zero, x), (zero, y)]
    if kind[0] == "homography":
        columns += [(-x * x, -x * y), (-x * y, -y * y)]
    columns = [(one, zero), (zero, one), *columns]
    jacobian = torch.stack([torch.stack(column) for column in columns], -1)  # (2, pixels, parameters)
    size = jacobian.shape[-1]
    variance = torch.einsum("dpi,ij,dpj->p", jacobian, covariance[:size, :size], jacobian)
    return float(variance.mean().clamp_min(0).sqrt())
