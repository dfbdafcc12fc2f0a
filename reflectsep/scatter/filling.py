"""What stands in for the scattering that the lit frames of a pixel hide: three ways, one interface.

Each takes the evidence of a sweep and returns C times the scattering, with its standard deviation by the method.

profile        every pixel: what the frames beside its lit interval hold, and a fitted spread for the light that none of
               them shows (reflectsep/scatter/spread.py), beyond a distance that is a setting.
maximum        every frame: the largest value on the hole's rim (paper). The rim lies against the slab.
interpolation  every frame: a smooth surface through the hole's surroundings (paper), by normalised convolution with
               ever wider Gaussians.

`maximum` and `interpolation` know of no distance; they stand for about half the slab's width
(`scripts/hole_fillings.py` prints how far each is from light that left more than 1 and 2 pixels away).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Bool
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn.functional import max_pool2d

from reflectsep.scatter.evidence import Evidence, Mask, Picture
from reflectsep.scatter.frames import Step, signed_root
from reflectsep.scatter.geometry import Surface
from reflectsep.scatter.spread import Slab, Spreading

HIDDEN_ERROR, PICTURE_ERROR = 0.12, 0.005
"""Standard deviations relative to what no frame shows, and to the picture (`scripts/scattering_spectrum.py`)."""
LEAST_NOISE = 1e-4
"""Of a frame, relative to the full picture: quantised black has no noise that shows."""
PAPER_ERROR = 0.15
"""Relative standard deviation of the paper's fillings (`scripts/hole_fillings.py`)."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What a filling may need beside the frames."""

    slab: Slab
    distance_px: float
    noise: float
    """Standard deviation of a root frame."""
    gain: float
    """C."""
    surface: Surface


class Filling(Protocol):
    """C times the scattering, and its standard deviation by what the method supposes."""

    def __call__(self, evidence: Evidence, setting: Setting) -> tuple[Picture, Picture]:
        """Fill the holes and sum."""
        ...


def maximum(evidence: Evidence, setting: Setting) -> tuple[Picture, Picture]:  # noqa: ARG001
    """Every frame's holes by the largest value around them."""
    return _sum_frames(evidence, fill_by_maximum)


def interpolation(evidence: Evidence, setting: Setting) -> tuple[Picture, Picture]:  # noqa: ARG001
    """Every frame's holes by a smooth surface."""
    return _sum_frames(evidence, fill_by_interpolation)


def profile(evidence: Evidence, setting: Setting) -> tuple[Picture, Picture]:
    """Every pixel's hidden scattering by the spread that its neighbourhood shares."""
    spreading = Spreading(
        evidence.band.passage.centre,
        evidence.full,
        setting.surface,
        setting.slab,
        reach=evidence.reach,
        noise=max(setting.noise, LEAST_NOISE * float(evidence.full[:, evidence.mask].median())),
        distance_px=setting.distance_px,
    )
    tiles, total = evidence.gather(spreading.tiles)
    ceiling = setting.gain * signed_root(evidence.full, evidence.n_d)
    passage = evidence.band.passage
    dark = passage.dark if evidence.n_d == 1.0 else 0.0
    found, hidden = spreading.finish(tiles, total, ceiling, frames=passage.received, dark=dark)
    return found, (HIDDEN_ERROR * hidden).square_().add_((PICTURE_ERROR * ceiling).square_()).sqrt_()


FILLINGS: dict[str, Filling] = {"profile": profile, "maximum": maximum, "interpolation": interpolation}


def _sum_frames(evidence: Evidence, fill: Callable[[Picture, Mask, Mask], Picture]) -> tuple[Picture, Picture]:
    """Sum of the frames, each filled by itself; a lost frame counts as the mean of its filled neighbours."""
    state = _FrameSum(evidence.full, evidence.mask, fill)
    evidence.walk(state.add)
    return state.total, PAPER_ERROR * state.total.abs()


class _FrameSum:
    def __init__(self, full: Tensor, mask: Tensor, fill: Callable[[Picture, Mask, Mask], Picture]) -> None:
        self.mask, self.fill = mask, fill
        self.total, self.before, self.gap = torch.zeros_like(full), torch.zeros_like(full), 0

    def add(self, step: Step, root: Tensor, hole: Tensor) -> None:
        if step.lost:
            self.gap += 1
            return
        filled = self.fill(root, hole, self.mask) if hole.any() else root
        self.total += filled + self.gap * (self.before + filled) / 2
        self.before, self.gap = filled, 0


def fill_by_maximum(frame: Picture, hole: Mask, mask: Mask) -> Picture:
    """The largest value on the rim grows into the hole, a pixel at a time, until it is closed."""
    known, open_ = mask & ~hole, hole & mask
    if not known.any():
        return frame * ~hole
    if not open_.any():
        return frame
    # Only the holes and their rim are looked at.
    rows, columns = (_span(open_.any(axis)) for axis in (1, 0))
    result = frame.clone()
    result[:, rows, columns] = _grown(frame[:, rows, columns], known[rows, columns], open_[rows, columns])
    return result


def _span(present: Bool[Tensor, "pixels"]) -> slice:
    """From the first to the last that is present, and one more on either side."""
    places = present.nonzero()[:, 0]
    return slice(max(0, int(places[0]) - 1), int(places[-1]) + 2)


def _grown(frame: Picture, known: Mask, open_: Mask) -> Picture:
    if not known.any():
        return torch.where(open_, 0.0, frame)
    low = float(frame[:, known].min()) - 1.0
    values = torch.where(known, frame, low)
    left = open_
    while left.any():
        grown = max_pool2d(values[None], 3, stride=1, padding=1)[0]
        reached = left & (grown > low + 0.5).all(0)
        if not reached.any():
            break
        values = torch.where(reached, grown, values)
        left = left & ~reached
    return torch.where(open_ & ~left, values, torch.where(left, 0.0, frame))


def fill_by_interpolation(frame: Picture, hole: Mask, mask: Mask) -> Picture:
    """Normalised convolution with Gaussians of growing width: the narrowest that reaches a pixel decides."""
    known = (mask & ~hole).to(frame)
    result, open_ = frame * ~hole, hole & mask
    sigma = 1.0
    while open_.any() and sigma < max(frame.shape[-2:]):
        radius = min(int(3 * sigma), min(frame.shape[-2:]) - 1)
        size = 2 * radius + 1
        stack = torch.cat([frame * known, known[None]])[None]
        blurred = gaussian_blur2d(stack, (size, size), (sigma, sigma), border_type="constant")[0]
        reached = open_ & (blurred[-1] > 0.02)
        result = torch.where(reached, blurred[:-1] / blurred[-1].clamp(min=1e-6), result)
        open_ = open_ & ~reached
        sigma *= 2.0
    return result
