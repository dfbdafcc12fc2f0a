"""What speaks for a richer motion: parameters beyond chance, and pixels that it was not fitted to; and its accuracy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from reflectsep.calibrate.motion import Model
from reflectsep.calibrate.motion_fit import TUKEY, MotionState, centred, frame_of, residual_of, solve_motion
from reflectsep.calibrate.pyramid import Level
from reflectsep.calibrate.register_options import RegisterOptions
from reflectsep.calibrate.tiles import chessboard, per_tile


def exceeds(
    state: MotionState, simple: tuple[Model, bool], rich: tuple[Model, bool], level: Level, options: RegisterOptions
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
    # A camera that was touched turns too: a rotation is taken where it predicts best (Akaike), not beyond chance alone.
    if simple[0] == "translation" and rich[0] == "rigid" and simple[1] == rich[1]:
        return wald > 2.0 * k
    return wald > k + 2 * (k * options.evidence) ** 0.5 + 2 * options.evidence


def _parameters(
    state: MotionState, kind: tuple[Model, bool], level: Level, options: RegisterOptions
) -> tuple[Tensor, Tensor]:
    """The motion as parameters in pixels at the picture's rim, with their covariance."""
    assert state.covariance is not None
    covariance = state.covariance[:-2, :-2]
    floor = (options.floor_px / level.factor) ** 2
    covariance = covariance + floor * torch.eye(len(covariance), dtype=torch.float64)
    centre, scale = frame_of(level)
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


def on_unseen(
    level: Level,
    simple: MotionState,
    rich: MotionState,
    first: tuple[Model, bool],
    second: tuple[Model, bool],
    options: RegisterOptions,
) -> tuple[float, float]:
    """By how much, relatively and in standard errors, the richer model predicts pixels better that it has not seen."""
    halves = chessboard(level.weight, options.tiles)
    sigma = min(simple.sigma, rich.sigma)
    errors = []
    for state, (model, drifting) in ((simple, first), (rich, second)):
        parts = []
        for half in halves:
            some = replace(level, weight=level.weight * half)
            fitted = solve_motion(some, model, state.matrix, options, drifting=drifting, begin=state)
            parts.append((fitted, half))
        errors.append(per_tile(_rho(_unseen(level, parts), sigma), level.weight, options.tiles))
    before, after = float(errors[0][0].sum()), float(errors[1][0].sum())
    return (1.0 - after / before if before > 0 else 0.0), _better(errors[0], errors[1])


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


def _unseen(level: Level, parts: Sequence[tuple[MotionState, Tensor]]) -> Tensor:
    """Residual of every pixel under the fit to the half that does not have it."""
    result = torch.zeros_like(level.moving)
    for state, half in parts:
        residual, _, valid = residual_of(level, state)
        # What the motion leaves no data for counts as no disagreement for any model.
        result = torch.where((half == 0) & valid, residual, result)
    return result


def _rho(error: Tensor, sigma: float) -> Tensor:
    unit = (error / (TUKEY * sigma)).square().clamp(max=1.0)
    return 1.0 - (1.0 - unit) ** 3


def sd_px_of(level: Level, state: MotionState, kind: tuple[Model, bool], options: RegisterOptions) -> float:
    """RMS over the pixels that count of the displacement's standard deviation, pixels of the level."""
    if state.covariance is None or kind[0] == "identity":
        return 0.0
    _, covariance = _parameters(state, kind, level, options)
    x, y, _ = centred(level)
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
