"""How many frames light a patch, from the frames of some pixels, where no exposure ratio tells.

With v a pixel's frames, `full` the mean of those that the slab lights wholly, and `beside` the brightest of those next
to its lit interval, which scattering alone leaves,

    2 h = sum over frames of (v - beside) / (full - beside), each from 0 to 1

which counts a frame that is lit in part by that part. The participation ratio of all pixels is a first guess alone:
where the frames of one lit interval differ, as beside a shadow's edge, it counts too few, and too many where they are
clipped. Four per cent in the width are three in the scattering.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from reflectsep.scatter.frames import Step

PIXELS = 4096
"""Pixels at most whose frames are kept."""
BESIDE = 1.5
"""Frames from the lit interval's end within which a frame says what scattering alone is there."""
FEWEST = 64
"""Pixels without a clipped or lost frame that it takes."""
CLEAR = 2.0
"""A pixel counts where its lit frames are so many times as bright as those beside."""
ROUNDS = 3
MOST_CHANGE = 0.25
"""A width that differs more from the first guess is none."""


@dataclass(frozen=True, kw_only=True)
class Kept:
    """Frames of some pixels."""

    at: Int[Tensor, "P"]
    """Where they are in the flattened picture."""
    index: Int[Tensor, "frames"]
    value: Float[Tensor, "frames P"]
    """Channel mean."""
    spoilt: Bool[Tensor, "frames P"]
    """Clipped or lost."""


class Keeper:
    """Takes some pixels of every frame as it passes; what is kept is a few megabytes."""

    def __init__(self, mask: Bool[Tensor, "height width"], frames: int) -> None:
        where = mask.flatten().nonzero()[:, 0]
        self.at = where[:: max(1, -(-len(where) // PIXELS))]
        self._index: list[int] = []
        # In one piece from the start: a little piece a frame, between frames that come and go, tears memory up.
        self._value = torch.zeros(frames, len(self.at))
        self._spoilt = torch.ones(frames, len(self.at), dtype=torch.bool)

    def add(self, step: Step) -> None:
        """One frame."""
        row = len(self._index)
        self._index.append(step.index)
        self._value[row] = step.values.flatten(1)[:, self.at].mean(0)
        self._spoilt[row] = step.lost
        if step.saturated is not None:
            self._spoilt[row] |= step.saturated.flatten(1)[:, self.at].any(0)

    def kept(self) -> Kept:
        """What was taken."""
        rows = len(self._index)
        return Kept(at=self.at, index=torch.tensor(self._index), value=self._value[:rows], spoilt=self._spoilt[:rows])


def lit_frames(
    kept: Kept,
    centre: Float[Tensor, "height width"],
    narrow: Bool[Tensor, "height width"],
    *,
    guess: float,
    step_px: float,
) -> float | None:
    """Mean number of frames that light a patch; None where too few pixels show theirs clearly.

    Args:
        kept: frames of some pixels.
        centre: frame in which the middle of the slab passes a pixel.
        narrow: pixels that the slab lights.
        guess: of the number.
        step_px: pixels that the slab moves in a frame.
    """
    offset = kept.index[:, None] - centre.flatten()[kept.at]
    half, edge = max(0.5, guess / 2), 0.5 / step_px + 0.05
    count = None
    for _ in range(ROUNDS):
        count = _count(kept, offset, narrow.flatten()[kept.at], half, edge)
        if count is None or abs(count / guess - 1.0) > MOST_CHANGE:
            return None
        half = max(0.5, count / 2)
    return count


def _count(kept: Kept, offset: Tensor, narrow: Tensor, half: float, edge: float) -> float | None:
    """Mean over the pixels, with half the width and its edge as they are known so far."""
    away = offset.abs()
    near = away <= half + edge + BESIDE
    whole = away <= max(half - edge, 0.25)
    full = (kept.value * whole).sum(0) / torch.where(whole.any(0), whole.sum(0), torch.nan)
    beside = torch.where(near & (away > half + edge), kept.value, -torch.inf).amax(0)
    sound = narrow & ~(kept.spoilt & near).any(0) & full.isfinite() & beside.isfinite() & (full > CLEAR * beside)
    sound &= full > 0
    if int(sound.sum()) < FEWEST:
        return None
    share = (kept.value - beside) / (full - beside)
    return float((share.clamp(0.0, 1.0) * near).sum(0)[sound].double().mean())
