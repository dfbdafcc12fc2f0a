"""One motion model at one scale: Gauss-Newton on the motion, the gain and the offset together, robustly.

The gradient is the mean of both sides', which converges in a handful of steps; Tukey's biweight is let down from the
first residual to the noise. The moving picture is always resampled from the original.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from reflectsep.calibrate.motion import Model, inside, pixel_grid, positions, sample
from reflectsep.calibrate.pyramid import MAD_TO_SIGMA, Level, slopes_of
from reflectsep.calibrate.register_options import RegisterOptions
from reflectsep.calibrate.tiles import tile_index

TUKEY = 4.685
FEWEST_PIXELS = 64
SETTLED_PX = 5e-4
"""A step this small, pixels at the rim, is the last."""


@dataclass(frozen=True, kw_only=True)
class MotionState:
    """A motion under way."""

    matrix: Tensor
    velocity: Tensor
    mix: Tensor
    """Gain and offset."""
    sigma: float
    weights: Tensor
    covariance: Tensor | None = None


def residual_of(level: Level, state: MotionState) -> tuple[Tensor, Tensor, Tensor]:
    """Moving - mix, the moved picture, and where both are measured."""
    height, width = level.moving.shape
    places = positions(state.matrix, height, width, state.velocity[:, None, None] * level.time)
    valid = inside(places) & (level.weight > 0)
    if level.moving_bad is None:
        moved = sample(level.moving[None], places)[0]
    else:
        moved, bad = sample(torch.stack([level.moving, level.moving_bad]), places)
        valid &= bad < 0.5
    return moved - state.mix[0] * level.template - state.mix[1], moved, valid


def _fit_mix(level: Level, moved: Tensor, weights: Tensor) -> Tensor:
    """Weighted least squares for gain and offset."""
    columns = torch.stack([level.template, torch.ones_like(moved)]).flatten(1)
    weighed = weights.flatten() * columns
    gram = weighed @ columns.mT
    ridge = 1e-10 * torch.diag(gram.diagonal().clamp_min(1e-300))
    return torch.linalg.solve(gram + ridge, weighed @ moved.flatten())


def solve_motion(
    level: Level,
    model: Model,
    start: Tensor,
    options: RegisterOptions,
    *,
    drifting: bool = False,
    begin: MotionState | None = None,
) -> MotionState:
    """Gauss-Newton for one model at one level; from `begin` with its scale held, where given."""
    state = MotionState(
        matrix=start.clone(),
        velocity=torch.zeros(2, dtype=torch.float64) if begin is None else begin.velocity,
        mix=torch.zeros(2, dtype=torch.float64),
        sigma=float("inf"),
        weights=level.weight,
    )
    residual, moved, valid = residual_of(level, state)
    floor = options.noise_floor * float(_bright(level))
    state = replace(state, mix=_fit_mix(level, moved, level.weight * valid))
    sigma = None if begin is None else begin.sigma
    for i in range(options.iterations):
        residual = moved - state.mix[0] * level.template - state.mix[1]
        if int(valid.sum()) < FEWEST_PIXELS // 4:
            return state
        robust = max(MAD_TO_SIGMA * float(residual[valid].abs().median()), floor)
        if begin is None:
            rms = float(residual[valid].square().mean().sqrt())
            sigma = max(rms, robust) if sigma is None else max(robust, 0.7 * sigma)
        assert sigma is not None
        state = replace(state, sigma=sigma, weights=_tukey(residual, sigma) * valid * level.weight)
        columns = _columns(level, state, moved, model, drifting)
        system = _normal_equations(columns, residual, state.weights)
        step = -torch.linalg.solve(system.gram, system.gradient) / system.scale
        state = _moved(state, step, model, drifting, level)
        motion = step[:-2]
        settled = (motion.numel() == 0 or float(motion.abs().max()) < SETTLED_PX) and sigma <= 1.01 * robust
        if settled or i == options.iterations - 1:
            state = replace(state, covariance=_covariance(system, residual, state.weights, level, options))
            break
        if motion.numel():  # a picture that lies still is sampled once
            _, moved, valid = residual_of(level, state)
    residual, _, valid = residual_of(level, state)
    return replace(state, weights=_tukey(residual, state.sigma) * valid * level.weight)


def _tukey(residual: Tensor, sigma: float) -> Tensor:
    return (1.0 - (residual / (TUKEY * sigma)).square()).clamp_min(0).square()


def _bright(level: Level) -> Tensor:
    values = level.moving[level.weight > 0].abs()
    return values.kthvalue(max(1, round(0.99 * values.numel()))).values if values.numel() else torch.tensor(1.0)


def _columns(level: Level, state: MotionState, moved: Tensor, model: Model, drifting: bool) -> Tensor:
    """Derivatives of the residual by the motion (pixels at the object's rim) and by the mix: (unknowns, pixels)."""
    if model == "identity":
        return torch.stack([-level.template, -torch.ones_like(moved)]).flatten(1)
    gx, gy = 0.5 * (slopes_of(moved[None], level.slope_blur_px)[0] + state.mix[0] * level.slopes)
    x, y, _ = centred(level)
    parts = [gx, gy]
    if model == "rigid":
        parts += [-gx * y + gy * x]
    if model in ("affine", "homography"):
        parts += [gx * x, gx * y, gy * x, gy * y]
    if model == "homography":
        radial = gx * x + gy * y
        parts += [-radial * x, -radial * y]
    if drifting:
        parts += [gx * level.time, gy * level.time]
    return torch.stack([*parts, -level.template, -torch.ones_like(moved)]).flatten(1)


def centred(level: Level) -> tuple[Tensor, Tensor, float]:
    """Coordinates about the middle of what counts, over half its size: parameters are all in pixels."""
    height, width = level.weight.shape
    x, y, _ = pixel_grid(height, width)
    scale = max(height, width) / 2.0
    return (x - (width - 1) / 2) / scale, (y - (height - 1) / 2) / scale, scale


@dataclass(frozen=True)
class _System:
    """Normal equations in units in which every unknown weighs alike."""

    gram: Tensor
    gradient: Tensor
    scale: Tensor
    weighed: Tensor
    """Derivatives times weights (unknowns, pixels)."""


def _normal_equations(columns: Tensor, residual: Tensor, weights: Tensor) -> _System:
    weighed = columns * weights.flatten()
    gram = weighed @ columns.mT
    scale = gram.diagonal().sqrt().clamp_min(1e-30)
    gram = gram / scale[:, None] / scale + 1e-9 * torch.eye(gram.shape[0], dtype=gram.dtype)
    return _System(gram, weighed @ residual.flatten() / scale, scale, weighed)


def _covariance(system: _System, residual: Tensor, weights: Tensor, level: Level, options: RegisterOptions) -> Tensor:
    """Covariance of the unknowns with tiles as the independent draws."""
    inverse = torch.linalg.inv(system.gram)
    density = max(_noise_density(residual, weights, options), 1e-30)
    plain = inverse * density
    tile = tile_index(level.weight, options.tiles).flatten()
    sums = torch.zeros(options.tiles**2, len(plain), dtype=plain.dtype)
    sums.index_add_(0, tile, (system.weighed * residual.flatten() / system.scale[:, None]).mT)
    tiled = inverse @ (sums.mT @ sums) @ inverse
    # Tiles see what noise alone does not say, but a few that hold most of the outline are too few draws by themselves.
    excess = float((system.gram @ tiled).trace()) / density / len(plain)
    return plain * max(1.0, excess) / (system.scale[:, None] * system.scale[None, :])


def _noise_density(residual: Tensor, weights: Tensor, options: RegisterOptions) -> float:
    """Variance that independent pixels would need to move the estimate as much as these, which the blur correlates."""
    total = weights.sum().clamp_min(1.0)
    variance = (weights * residual.square()).sum() / total
    return float(variance) * max(1.0, 4.0 * torch.pi * options.blur_px**2)


def _moved(state: MotionState, step: Tensor, model: Model, drifting: bool, level: Level) -> MotionState:
    """The state after a step; the motion's part is composed before the matrix (x -> S (x + step))."""
    motion, mix = step[:-2], step[-2:]
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
    return replace(state, matrix=matrix, velocity=velocity, mix=state.mix + mix)


def frame_of(level: Level) -> tuple[Tensor, float]:
    """Matrix to the coordinates of `centred`, and their scale."""
    height, width = level.weight.shape
    scale = max(height, width) / 2.0
    matrix = torch.tensor(
        [[1 / scale, 0, -(width - 1) / 2 / scale], [0, 1 / scale, -(height - 1) / 2 / scale], [0, 0, 1]],
        dtype=torch.float64,
    )
    return matrix, scale


def _increment(motion: Tensor, model: Model, level: Level) -> Tensor:
    centre, scale = frame_of(level)
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
