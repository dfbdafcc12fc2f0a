"""Registration of pictures that show the same thing: robust, photometric, coarse to fine, model chosen by evidence.

    moving(sample_p(x)) = c template(x) + b          for most pixels x

c and b are free, so that an unknown exposure ratio (C of Eq. 25) does no harm. Gauss-Newton on p, c and b together,
Tukey's biweight whose scale is let down from the first residual to the noise; the gradient is the mean of both sides',
which converges in a handful of steps. The moving picture is always resampled from the original.

Evidence: of the nested models (none, translation, rigid, affine, homography) a richer one is taken where its further
parameters differ from nothing beyond chance (Wald; a covariance with the tiles of the picture as independent draws,
and a floor for what interpolation does). Any motion must besides predict pixels that it was not fitted to: the tiles
are split like a chessboard, and each half is predicted by the fit to the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.calibrate.evidence import exceeds, on_unseen, sd_px_of
from reflectsep.calibrate.motion import Model, displacement
from reflectsep.calibrate.motion_fit import FEWEST_PIXELS, MotionState, solve_motion
from reflectsep.calibrate.pyramid import Level, from_level, pyramid_of, to_level
from reflectsep.calibrate.register_options import RegisterOptions
from reflectsep.errors import CaptureError


@dataclass(frozen=True, kw_only=True)
class Registration:
    """What a registration found."""

    matrix: Float[Tensor, "3 3"]
    model: Model
    velocity: tuple[float, float]
    displacement_px: float
    sd_px: float
    trust: float
    gain: float
    residual: float
    """Robust standard deviation after it, in the pictures' units."""
    gain_in_agreement: float
    """Relative fall of the error on pixels not fitted to, against no motion."""
    significance: float
    """That fall in standard errors."""


def register(
    moving: Float[Tensor, "height width"],
    template: Float[Tensor, "height width"],
    *,
    usable: Bool[Tensor, "height width"],
    moving_usable: Bool[Tensor, "height width"] | None = None,
    time: Float[Tensor, "height width"] | None = None,
    options: RegisterOptions | None = None,
) -> Registration:
    """Find the motion of `moving` against `template`.

    Args:
        moving: the picture that may have moved.
        template: the picture in the reference's place; the moving one is its multiple and a constant.
        usable: reference pixels that count: on the object and a margin around it, not clipped in the template.
        moving_usable: pixels of the moving picture that are not clipped and finite.
        time: -1 to 1, when a sweep's light reached each pixel; needed for `options.drift`.
        options: settings.

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
    pyramid = pyramid_of(moving, moving_usable, template, usable, time, options)
    finest = pyramid[-1]
    matrix = _coarse(pyramid, options)
    cameras: list[Model] = [model for model in options.models if model not in ("affine", "homography")]
    candidates: list[tuple[Model, bool]] = [(model, False) for model in cameras]
    if options.drift:
        # Before affine: a drift along the sweep is a stretch, and the likelier reason for one.
        candidates.extend((model, True) for model in cameras if model != "identity")
    candidates.extend((model, False) for model in options.models if model not in cameras)
    return _choose(finest, matrix, candidates, usable, options)


def _coarse(pyramid: Sequence[Level], options: RegisterOptions) -> Tensor:
    """Translation, then a rigid motion, from the coarsest level to the finest but one; in the finest's coordinates.

    At the finest level every model is fitted for itself.
    """
    finest = pyramid[-1]
    best = torch.eye(3, dtype=torch.float64)
    for level in pyramid[:-1] or pyramid:
        ratio = level.factor // finest.factor
        local = to_level(best, ratio)
        for model in ("translation", "rigid"):
            if model in options.models:
                # Here "translation" only moves; the rotation of the level before stays.
                local = solve_motion(level, model, local, options).matrix
        best = from_level(local, ratio)
    return best


def _choose(
    level: Level, start: Tensor, candidates: Sequence[tuple[Model, bool]], usable: Tensor, options: RegisterOptions
) -> Registration:
    fits: dict[tuple[Model, bool], MotionState] = {}
    chosen = candidates[0]
    for candidate in candidates:
        model, drifting = candidate
        if model == "homography" and chosen[0] != "affine":
            continue  # a camera that tilts by enough to converge shears as well
        fits[candidate] = solve_motion(level, model, _restricted(start, model, level), options, drifting=drifting)
        if candidate != candidates[0] and exceeds(fits[candidate], chosen, candidate, level, options):
            chosen = candidate
    fall, significance = 0.0, 0.0
    if chosen != candidates[0]:
        fall, significance = on_unseen(level, fits[candidates[0]], fits[chosen], candidates[0], chosen, options)
        if significance < options.unseen:
            chosen = candidates[0]
    state = fits[chosen]
    matrix = from_level(state.matrix, level.factor)
    weighed = level.weight > 0
    return Registration(
        matrix=matrix,
        model=chosen[0],
        velocity=(float(state.velocity[0]) * level.factor, float(state.velocity[1]) * level.factor),
        displacement_px=displacement(matrix, usable),
        sd_px=sd_px_of(level, state, chosen, options) * level.factor,
        trust=float(state.weights[weighed].mean()),
        gain=float(state.mix[0]),
        residual=state.sigma,
        gain_in_agreement=fall,
        significance=significance,
    )


def _restricted(matrix: Tensor, model: Model, level: Level) -> Tensor:
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
