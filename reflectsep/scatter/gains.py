"""Which values enter Eq. 25, and what is done where it cannot be solved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.data import PhotometricStack
from reflectsep.room import empty, stacked
from reflectsep.scatter.exponent import GRID, UNKNOWN_SD, Exponent, Samples, complete, solve_exponent
from reflectsep.scatter.frames import name_of
from reflectsep.scatter.local import box_sum
from reflectsep.scatter.options import HeldSweeps, ScatterOptions
from reflectsep.scatter.passage import Passage
from reflectsep.scatter.width import lit_frames
from reflectsep.scatter.width_fit import fitted_width

MOST_SAMPLES = 20000
FEWEST_SAMPLES = 24
SAME_RATIO = 1.35
"""Where C and the lit frames agree this well, exposures are equal and C, the more exact, is the slab's width."""
LEAST_PACE, MOST_PACE = 0.5, 2.0
"""Of the typical pace, in frames a pixel, at which the slab passes pixels that the width is fitted to."""
HIGHLIGHT_RANK = 0.85
"""Pixels whose picture stands out from their median over the lights more than in this part of all are left out."""


@dataclass(frozen=True, kw_only=True)
class Gains:
    """Exponent and gains of all sweeps, and how they came about."""

    n_d: float
    n_d_sd: float
    source: str
    gains: tuple[float, ...]
    gains_sd: tuple[float, ...]
    lit_frames: tuple[float, ...]
    warnings: tuple[str, ...]


def exponents(options: ScatterOptions) -> tuple[float, ...]:
    """Values of n_d for which the first pass sums roots."""
    if options.held is not None:
        return (options.held.n_d,)
    return GRID if options.n_d is None else (options.n_d,)


def choose_samples(stack: PhotometricStack, lights: Sequence[int]) -> list[Bool[Tensor, "channels height width"]]:
    """Values of each light's full picture for Eq. 25: on the object, bright enough, unclipped, without a highlight.

    A pixel is chosen by its neighbours, never by its own noise: leaving out the brightest would bend Eq. 25.
    """
    near = stacked((_around(picture, stack.mask) for picture in stack.images), len(stack.images))
    typical = empty(*near.shape[1:], dtype=near.dtype)
    for row in range(near.shape[2]):
        typical[:, row] = near[:, :, row].median(0).values
    chosen = {k: _chosen(stack, k, near[k], typical) for k in set(lights)}
    return [chosen[k] for k in lights]


def _chosen(stack: PhotometricStack, light: int, own: Tensor, typical: Tensor) -> Bool[Tensor, "channels height width"]:
    level = own.mean(0)
    bright = (own > 0.05 * _rank(level[stack.mask], 0.99)) & stack.mask & ~stack.saturated[light]
    if not bright.any():
        return bright
    excess = own / typical.clamp(min=1e-6)
    quiet = bright & (excess <= _rank(excess[bright], HIGHLIGHT_RANK)) & (own <= _rank(own[bright], 0.97))
    where = quiet.flatten().nonzero()[:, 0]
    stride = max(1, -(-len(where) // MOST_SAMPLES))
    chosen = torch.zeros(own.numel(), dtype=torch.bool)
    chosen[where[::stride]] = True
    return chosen.view_as(own)


def _rank(values: Tensor, q: float) -> Tensor:
    """The value below which a part q of all lies."""
    return values.kthvalue(min(len(values), int(q * len(values)) + 1)).values


def solve_gains(
    stack: PhotometricStack,
    lights: list[int],
    passages: list[Passage],
    samples: list[Bool[Tensor, "channels height width"]],
    options: ScatterOptions,
) -> Gains:
    """Solve Eq. 25 over the sweeps that allow it; take C from the slab's geometry for the others."""
    if options.held is not None:
        return _held(options.held, passages)
    of = [_samples(stack, k, p, m) for k, p, m in zip(lights, passages, samples, strict=True)]
    usable = [i for i, s in enumerate(of) if s is not None]
    frames = [options.lit_frames or _lit_frames(p, stack.mask) for p in passages]
    warnings: list[str] = []
    found: Exponent | None = None
    if usable:
        found = solve_exponent([s for s in of if s is not None], exponents(options))
    n_d, sd, source = _exponent(found, options, warnings)
    of_eq_25 = {i: (found.gains[slot], found.gains_sd[slot]) for slot, i in enumerate(usable) if found is not None}
    if options.lit_frames is None:
        # Where C is not the width itself, it is worth the profiles' fit.
        doubtful = [i for i, f in enumerate(frames) if i not in of_eq_25 or not same_ratio(of_eq_25[i][0], f)]
        for i in doubtful:
            frames[i] = _fitted(passages[i], stack.mask, frames[i])
    gains, gains_sd = list(frames), [0.1 * f for f in frames]
    for i, (gain, gain_sd) in of_eq_25.items():
        gains[i], gains_sd[i] = gain, gain_sd
    for i in set(range(len(of))) - set(usable):
        warnings.append(_geometry_warning(passages[i], frames[i], stack.mask))
    return Gains(
        n_d=n_d,
        n_d_sd=sd,
        source=source,
        gains=tuple(gains),
        gains_sd=tuple(gains_sd),
        lit_frames=tuple(frames),
        warnings=tuple(warnings),
    )


def _held(held: HeldSweeps, passages: list[Passage]) -> Gains:
    reports = [held.of(passage.sweep.light, passage.sweep.direction) for passage in passages]
    return Gains(
        n_d=held.n_d,
        n_d_sd=held.n_d_sd,
        source=held.n_d_source,
        gains=tuple(report.gain for report in reports),
        gains_sd=tuple(report.gain_sd for report in reports),
        lit_frames=tuple(report.lit_frames for report in reports),
        warnings=(),
    )


def _exponent(found: Exponent | None, options: ScatterOptions, warnings: list[str]) -> tuple[float, float, str]:
    if options.n_d is not None:
        return options.n_d, 0.0, "fixed"
    if found is None or not found.identifiable:
        why = "no pixel is fit for Eq. 25" if found is None else f"its standard deviation would be {found.n_d_sd:.2g}"
        warnings.append(f"n_d cannot be told from the sweeps ({why}), as on an opaque object: 1 is taken")
        return 1.0, UNKNOWN_SD if found is None else found.n_d_sd, "unidentifiable"
    return found.n_d, found.n_d_sd, "estimated"


def _geometry_warning(passage: Passage, frames: float, mask: Tensor) -> str:
    clipped = float((passage.clipped & mask).sum() / mask.sum())
    beside = float((passage.lost_near() & mask).sum() / mask.sum())
    ratio = (
        "the exposures in the manifest" if passage.sweep.exposure_s is not None else "equal exposures, none is given"
    )
    return (
        f"{name_of(passage.sweep)}: C is the {frames:.2f} frames in which a patch is lit, not from Eq. 25 "
        f"({clipped:.0%} of the object is clipped in lit frames, {beside:.0%} has lost some), and rests on {ratio}"
    )


def _lit_frames(passage: Passage, mask: Tensor) -> float:
    """Counted over pixels whose lit interval is clear; else the median of profiles as narrow as the slab."""
    values = passage.lit_frames[mask]
    guess = max(1.0, float(values[values < 2.0 * values.median()].median()))
    narrow = passage.narrow & mask
    return lit_frames(passage.kept, passage.centre, narrow, guess=guess, step_px=passage.step_px(mask)) or guess


def _fitted(passage: Passage, mask: Tensor, counted: float) -> float:
    """By the profiles, where they tell.

    Where the surface turns along the light's way the slab passes many pixels at once: their edges are sharper than the
    model's and what scatters to them comes from nearer than it has it, so that the width comes out up to a tenth small.
    In frames that are not clipped only dim pixels count, and dim ones lie there often.
    """
    narrow, step_px = passage.narrow & mask, passage.step_px(mask)
    pace = passage.frames_per_px() * step_px
    for pixels in (narrow & (pace > LEAST_PACE) & (pace < MOST_PACE), narrow):
        width = fitted_width(passage.kept, passage.centre, pixels, guess=counted, step_px=step_px)
        if width is not None:
            return width
    return counted


def same_ratio(gain: float, frames: float) -> bool:
    """Whether C is the lit frames, so that the sweep's exposure is the pictures'."""
    return 1 / SAME_RATIO < gain / frames < SAME_RATIO


def _samples(stack: PhotometricStack, light: int, passage: Passage, chosen: Tensor) -> Samples | None:
    full, total = stack.images[light], passage.total
    # What stands in for a lost frame is the less exact the nearer the slab.
    for frames in (5.0, 2.0):
        sound = chosen & ~(passage.clipped | passage.lost_near(frames))
        if int(sound.sum()) >= (10 if frames > 2.0 else 1) * FEWEST_SAMPLES:
            break
    else:
        return None
    sound[sound.clone()] = complete(total[sound], full[sound])
    if int(sound.sum()) < FEWEST_SAMPLES:
        return None
    inside = sound[chosen]
    return Samples(
        full=full[sound].double(),
        instrument=_around(full, stack.mask)[sound].double(),
        sums=passage.sums[:, inside],
        noise=fine_noise(full, stack.mask),
    )


def _around(full: Float[Tensor, "channels height width"], mask: Bool[Tensor, "height width"]) -> Tensor:
    """Mean over the 5 x 5 neighbours on the object, the pixel itself left out."""
    weight = mask.to(full)
    count = box_sum(weight[None])[0] - weight
    result = torch.empty_like(full)
    for c, channel in enumerate(full):
        own = channel * weight
        values = box_sum(own[None])[0] - own
        result[c] = torch.where(count > 0.5, values / count.clamp(min=0.5), channel)
    return result


def fine_noise(full: Tensor, mask: Tensor) -> float:
    """Robust spread of what a 3 x 3 second difference leaves, on the object."""
    kernel = torch.tensor([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]])
    detail = torch.nn.functional.conv2d(full[:, None], kernel[None, None].to(full), padding=1)[:, 0] / 6.0
    inner = torch.nn.functional.max_pool2d((~mask)[None, None].float(), 3, stride=1, padding=1)[0, 0] == 0
    return float(1.4826 * detail[:, inner].abs().median()) if inner.any() else 0.0
