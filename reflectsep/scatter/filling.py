"""What stands in for the scattering in the holes that the lit band leaves: five ways, one interface.

Each takes the evidence of a sweep and returns the root sum of its frames, holes filled. None but `profile` knows of a
distance; each of the others stands for one nevertheless, that from which on it takes light for scattering.

maximum        every frame: the largest value on the hole's rim (paper). The rim lies against the slab.
interpolation  every frame: a smooth surface through the hole's surroundings (paper), by normalised convolution with
               ever wider Gaussians.
time           every pixel: a straight line across its own lit frames.
orthogonal     every pixel: the mean of what the sweep of the same light the other way measured beside its own lit
               interval (A u B = A + B - A n B: what one sweep lacks the other has, and the common part is averaged).
               Without such a sweep: `time`.
profile        every pixel: its profile as a sum of exponentials (reflectsep/scatter/kernel.py), with the distance a
               setting.

Relative RMS error on a path-traced wax blob (mean free path 1.44 px, slab 4 px wide, 2 px a frame), lit band by the
interval in time, against the light that left more than 1 and more than 2 px from where it entered:

    profile at 1 px   4.8 %   25 %       maximum        13.8 %  9.7 %       time                    26 %   14 %
    profile at 2 px    16 %  5.7 %       interpolation    20 %  7.4 %       orthogonal (one light)  25 %   14 %

So `profile` is the default, `interpolation` and `maximum` stand for about half the slab's width, and `time` for more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Bool, Float
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn.functional import max_pool2d

from reflectsep.scatter.evidence import Evidence, Mask, Picture
from reflectsep.scatter.frames import Step
from reflectsep.scatter.kernel import Slab, fill_by_profile
from reflectsep.scatter.windows import Profiles

CALM_STEPS = 0.75
"""Standard deviation of the smoothing of filled profiles, in steps of the slab."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What a filling may need beside the frames."""

    slab: Slab
    distance_px: float
    noise: float
    """Standard deviation of a root frame."""
    partner: Evidence | None = None
    """The sweep of the same light the other way."""
    partner_gain: float = 1.0
    """C of this sweep over C of the partner."""
    stretch: Float[Tensor, "height width"] | None = None
    """Frames that a length along the surface takes, over those across the sheet of light; None: 1 everywhere."""


class Filling(Protocol):
    """Root sum of a sweep's frames, holes filled, undivided by C."""

    def __call__(self, evidence: Evidence, setting: Setting) -> Picture:
        """Fill the holes and sum."""
        ...


def maximum(evidence: Evidence, setting: Setting) -> Picture:  # noqa: ARG001
    """Every frame's holes by the largest value around them."""
    return _sum_frames(evidence, fill_by_maximum)


def interpolation(evidence: Evidence, setting: Setting) -> Picture:  # noqa: ARG001
    """Every frame's holes by a smooth surface."""
    return _sum_frames(evidence, fill_by_interpolation)


def time(evidence: Evidence, setting: Setting) -> Picture:  # noqa: ARG001
    """Every pixel's lit frames by a straight line."""
    return evidence.fill(fill_along_time)


def orthogonal(evidence: Evidence, setting: Setting) -> Picture:
    """Every pixel's lit frames by what the other sweep saw beside its own."""
    if setting.partner is None:
        return time(evidence, setting)
    beside = setting.partner_gain * setting.partner.gather(_beside).flatten(1)
    return evidence.fill(lambda profiles: beside[:, profiles.at] * profiles.hole.sum(0))


def profile(evidence: Evidence, setting: Setting) -> Picture:
    """Every pixel's lit frames by its fitted profile."""
    stretch = None if setting.stretch is None else setting.stretch.flatten()

    def fill(profiles: Profiles) -> Tensor:
        distance = setting.distance_px if stretch is None else setting.distance_px * stretch[profiles.at]
        return fill_by_profile(profiles, setting.slab, distance_px=distance, noise=setting.noise)

    return calmed(evidence.fill(fill), evidence.mask, CALM_STEPS / setting.slab.frames_per_px)


def calmed(root: Picture, mask: Mask, sigma_px: float) -> Picture:
    """Stripes smoothed away, edges kept.

    How near the closest unlit frame comes to a pixel changes with a period of one step of the slab, and what is filled
    with it: stripes of some per cent. Scattered light is smooth, so a Gaussian of that width removes them; where a
    pixel is farther from it than three times what is usual there is an edge of the material, and it stays as it is.
    """
    reach = 2 * max(1, round(3 * sigma_px)) + 1
    blur = lambda p: gaussian_blur2d(p[None], (reach, reach), (sigma_px, sigma_px), "constant")[0]  # noqa: E731
    smooth = blur(root * mask) / blur(mask[None].to(root)).clamp(min=1e-6)
    away = (root - smooth).abs() / smooth.abs().clamp(min=1e-9)
    bright = mask & (smooth.mean(0) > 0.05 * smooth.mean(0)[mask].max())
    if not bright.any():
        return root
    usual = 1.4826 * away[:, bright].median()
    return torch.where((away <= 3.0 * usual) & mask, smooth, root)


FILLINGS: dict[str, Filling] = {
    "profile": profile,
    "maximum": maximum,
    "interpolation": interpolation,
    "orthogonal": orthogonal,
    "time": time,
}


def _sum_frames(evidence: Evidence, fill: Callable[[Picture, Mask, Mask], Picture]) -> Picture:
    """Sum of the frames, each filled by itself; a lost frame counts as the mean of its filled neighbours."""
    state = _FrameSum(evidence.full, evidence.mask, fill)
    evidence.walk(state.add)
    return state.total


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


def fill_along_time(profiles: Profiles) -> Float[Tensor, "channels P"]:
    """Sum over the holes of the line between the values on either side of them."""
    before, after, since, until = _neighbours(profiles)
    weight = (since / (since + until).clamp(min=1))[:, None]
    line = torch.where(before.isnan(), after, torch.where(after.isnan(), before, torch.lerp(before, after, weight)))
    return (line.nan_to_num(0.0) * profiles.hole[:, None]).sum(0)


def _neighbours(profiles: Profiles) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Last value before and first after every frame that is no hole, NaN where there is none, and their distances."""
    known = profiles.present & ~profiles.hole

    def swept(order: list[int]) -> tuple[Tensor, Tensor]:
        value = torch.full_like(profiles.root[0], torch.nan)
        steps_since = torch.zeros_like(profiles.offset[0])
        values, distances = torch.empty_like(profiles.root), torch.empty_like(profiles.offset)
        for i in order:
            value = torch.where(known[i], profiles.root[i], value)
            steps_since = torch.where(known[i], 0.0, steps_since + 1)
            values[i], distances[i] = value, steps_since
        return values, distances

    frames = list(range(len(known)))
    before, since = swept(frames)
    after, until = swept(frames[::-1])
    return before, after, since, until


def _beside(profiles: Profiles) -> Float[Tensor, "channels P"]:
    """Mean of the last value before and the first after the middle frame that are no holes."""
    before, after, _, _ = _neighbours(profiles)
    return _mean_of(before[len(before) // 2], after[len(after) // 2])


def _mean_of(a: Tensor, b: Tensor) -> Tensor:
    """Mean of two, or the one that is there."""
    return torch.where(a.isnan(), b, torch.where(b.isnan(), a, (a + b) / 2)).nan_to_num(0.0)
