"""What the report shows of a sweep: one pass over its frames, in bounded memory."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.data import FrameStream, PhotometricStack
from reflectsep.errors import SweepError
from reflectsep.scatter.filling import fill_by_maximum
from reflectsep.scatter.frames import name_of, signed_root, steps

CHOSEN = 3
"""Frames that are shown, spread over the object."""


@dataclass(frozen=True, kw_only=True)
class ShownFrame:
    """One frame with its lit band."""

    index: int
    values: Float[Tensor, "channels height width"]
    band: Bool[Tensor, "height width"]
    filled: Float[Tensor, "channels height width"]
    """The band filled with the maximum of its surroundings, as in the paper's Fig. 2."""


@dataclass(frozen=True, kw_only=True)
class SweepView:
    """A sweep as the report shows it."""

    light: str
    direction: str
    count: int
    peak: Float[Tensor, "height width"]
    """Frame, with fractions, in which the slab passes a pixel; NaN off the object."""
    straight: Float[Tensor, "2"]
    """Passage of a slab at constant speed over a flat object: frame = straight[0] + straight[1] * position in px."""
    root_sum: Float[Tensor, "channels height width"]
    """Right side of Eq. 25: the sum of the frames' n_d-th roots."""
    root_full: Float[Tensor, "channels height width"]
    """n_d-th root of the full picture."""
    frames: tuple[ShownFrame, ...]


def view_sweep(
    stack: PhotometricStack, stream: FrameStream, *, n_d: float, lit_frames: float, frames: Sequence[int] = ()
) -> SweepView:
    """Watch a sweep pass.

    Args:
        stack: the full pictures, linear.
        stream: the sweep's frames in the same units.
        n_d: of the result.
        lit_frames: number of frames in which a patch is lit, as the result found it.
        frames: indices to keep for showing; a few, evenly, where there are none.

    Raises:
        SweepError: no frame received, a frame to show that the sweep has not, or what `scatter.frames.steps` raises.
    """
    full = stack.images[stack.names.index(stream.sweep.light)]
    count = len(stream)
    wanted = set(frames) or {round(count * (k + 1) / (CHOSEN + 1)) for k in range(CHOSEN)}
    kept: dict[int, Tensor] = {}
    root_sum = torch.zeros_like(full)
    best, peak = torch.full(full.shape[1:], -torch.inf), torch.zeros(full.shape[1:])
    around = torch.zeros(3, *full.shape[1:])  # values before, at and after the brightest frame, for its fraction
    last = torch.zeros(full.shape[1:])
    rising = torch.zeros(full.shape[1:], dtype=torch.bool)
    seen = 0
    with closing(steps(stream, full, stack.mask)) as walked:
        for step in walked:
            grey = step.values.mean(0)
            around[2] = torch.where(rising, grey, around[2])
            higher = grey > best
            around[0], around[1] = torch.where(higher, last, around[0]), torch.where(higher, grey, around[1])
            best, peak = torch.where(higher, grey, best), torch.where(higher, float(step.index), peak)
            around[2] = torch.where(higher, grey, around[2])
            rising, last, seen = higher, grey, seen + 1
            root_sum += signed_root(step.values, n_d)
            if step.index in wanted:
                kept[step.index] = step.values.clone()
    if not seen:
        raise SweepError(f"{name_of(stream.sweep)}: no frame to show")
    if lacking := set(frames) - set(kept):
        numbers = ", ".join(map(str, sorted(lacking)))
        raise SweepError(f"{name_of(stream.sweep)}: frames={numbers} to show: the sweep has 0 to {count - 1}")
    # With an even number of lit frames two are alike: their middle is the passage.
    weight = (around - 0.5 * around[1]).clamp_min(0.0)
    peak = peak + (weight[2] - weight[0]) / weight.sum(0).clamp_min(1e-12)
    shown = tuple(_shown(index, values, peak, stack.mask, lit_frames) for index, values in sorted(kept.items()))
    peak = torch.where(stack.mask, peak, torch.nan)
    return SweepView(
        light=stream.sweep.light,
        direction=stream.sweep.direction,
        count=count,
        peak=peak,
        straight=_straight(peak, stream.sweep.direction),
        root_sum=root_sum,
        root_full=signed_root(full, n_d),
        frames=shown,
    )


def _shown(index: int, values: Tensor, peak: Tensor, mask: Tensor, lit_frames: float) -> ShownFrame:
    band = mask & ((peak - index).abs() <= lit_frames / 2 + 0.5)
    values = torch.nan_to_num(values) * mask
    return ShownFrame(index=index, values=values, band=band, filled=fill_by_maximum(values, band, mask))


def _straight(peak: Float[Tensor, "height width"], direction: str) -> Float[Tensor, "2"]:
    """The straight line through passage against position, by medians of its slopes (Theil and Sen)."""
    row, column = torch.nonzero(peak.isfinite(), as_tuple=True)
    position = (column if direction == "x" else row).float()
    time = peak[row, column]
    if len(position) < 2 or float(position.max()) == float(position.min()):
        return torch.stack([time.median() if len(time) else torch.tensor(0.0), torch.tensor(0.0)])
    # Pairs half the pixels apart along the slab's way: far enough for a slope.
    order = position.argsort()
    half = len(order) // 2
    first, second = order[:half], order[half : 2 * half]
    apart = position[second] - position[first]
    slope = ((time[second] - time[first]) / apart)[apart > 0].median()
    return torch.stack([(time - slope * position).median(), slope])
