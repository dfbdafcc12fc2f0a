"""The lit band: which frames hold a pixel's own light.

Two ways to find it. `profile`: the pixel's lit interval, from its passage (reflectsep/scatter/passage.py) and the
slab's width, with fractions of a frame and a margin for frames that light it in part. `threshold`: frames near the
passage that exceed a part of the full picture, both on one scale. A pixel in shadow is never lit and has no hole: all
of its light came through the body.
"""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.scatter.frames import Step
from reflectsep.scatter.passage import Passage


@dataclass(frozen=True, kw_only=True)
class LitBand:
    """Decides which frames light a pixel."""

    passage: Passage
    half: float
    edge: float
    lit: Bool[Tensor, "height width"]
    """Pixels that the slab lights at all."""
    doubtful: Bool[Tensor, "height width"]
    """Pixels whose brightest frame is too dark, against the full picture, to be sure of that: perhaps in shadow."""
    threshold: Float[Tensor, "height width"] | None
    """Grey value above which a frame near the passage counts as lit; None: the interval in time decides."""

    def hole(self, step: Step) -> Bool[Tensor, "height width"]:
        """Pixels that this frame lights."""
        away = (step.index - self.passage.centre).abs()
        if self.threshold is None or step.lost:
            return self.lit & (away <= self.half + self.edge)
        return self.lit & (away <= 2 * self.half + 2) & (step.values.mean(0) > self.threshold)
