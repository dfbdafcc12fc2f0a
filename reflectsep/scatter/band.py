"""The lit band: which frames hold a pixel's own light, and the second pass over a sweep that leaves them out.

Two ways to find it. `profile`: the pixel's lit interval, from its passage (reflectsep/scatter/passage.py) and the
slab's width, with fractions of a frame and a margin for frames that light it in part. `threshold`: frames near the
passage that exceed a part of the full picture, both on one scale. A pixel in shadow is never lit and has no hole: all
of its light came through the body.

The second pass keeps a window of frames around each pixel's passage and the sum of all others, so memory does not grow
with the number of frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.data import FrameStream
from reflectsep.progress import Progress
from reflectsep.scatter.frames import Step, signed_root, steps
from reflectsep.scatter.passage import Passage

BLUR_PX = 4.0
"""Along the slab, of the light it brings."""
OUTSHINE = 1.1
FULL_LIGHT = 0.3
"""Part of the brightest row's sum from which on a slab is taken to bring all its light: what the camera sees of it
depends on how a surface is turned, what enters does not."""


@dataclass(frozen=True, kw_only=True)
class Profiles:
    """Root frames around each pixel's passage; P pixels of the object."""

    root: Float[Tensor, "frames channels P"]
    offset: Float[Tensor, "frames P"]
    """Frame minus passage."""
    hole: Bool[Tensor, "frames P"]
    """Not scattering alone, or not received: to be filled."""
    present: Bool[Tensor, "frames P"]
    """Received."""
    lit: Bool[Tensor, "P"]
    """Pixels that the slab lights at all."""
    saturated: Bool[Tensor, "frames channels P"]
    light: Float[Tensor, "frames P"]
    """Light that a frame's slab brings to the object in the pixel's row (column, for a sweep along y), relative to the
    frames that light the pixel itself."""
    rest: Float[Tensor, "channels P"]
    """Sum of the root frames outside the window."""

    def part(self, pixels: slice) -> Profiles:
        """The same for some of the pixels."""
        return replace(self, **{k: v[..., pixels] for k, v in vars(self).items()})

    @property
    def measured(self) -> Float[Tensor, "channels P"]:
        """Sum of all root frames that need no filling."""
        return self.rest + (self.root * (self.present & ~self.hole)[:, None]).sum(0)


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


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """A sweep ready for its second pass: what every hole filling works from."""

    stream: FrameStream
    full: Float[Tensor, "channels height width"]
    mask: Bool[Tensor, "height width"]
    band: LitBand
    n_d: float
    reach: int
    clipped_elsewhere: Bool[Tensor, "height width"]
    """Pixels saturated in a frame that does not light them; written while the frames pass."""
    progress: Progress

    def walk(
        self, visit: Callable[[Step, Float[Tensor, "channels height width"], Bool[Tensor, "height width"]], None]
    ) -> None:
        """Call `visit(step, root, hole)` for every frame; a full pass over the files."""
        name = f"sweep {self.stream.sweep.light} {self.stream.sweep.direction}: scattering"
        for step in steps(self.stream, self.full, self.mask):
            hole = self.band.hole(step)
            self.clipped_elsewhere.logical_or_(step.saturated.any(0) & ~hole)
            visit(step, signed_root(step.values, self.n_d), hole)
            self.progress(name, step.index + 1, len(self.stream))

    def profiles(self) -> Profiles:
        """Pass over the sweep and keep each pixel's window."""
        window = _Window(self)
        self.walk(window.add)
        return window.profiles()

    def picture(self, values: Float[Tensor, "channels P"]) -> Float[Tensor, "channels height width"]:
        """Values of the object's pixels as a picture, nothing elsewhere."""
        result = torch.zeros_like(self.full)
        result[:, self.mask] = values.to(result)
        return result


class _Window:
    """Frames around each pixel's passage, filled as they come."""

    def __init__(self, evidence: Evidence) -> None:
        band, mask = evidence.band, evidence.mask
        self.mask = mask
        self.reach = math.ceil(band.half + band.edge) + evidence.reach
        self.size = 2 * self.reach + 1
        self.centre = band.passage.centre[mask]
        self.first_index = self.centre.round().long() - self.reach
        self.ordered, self.order = self.first_index.sort(stable=True)
        self.at = mask.flatten().nonzero()[:, 0]
        self.brought = _Light(evidence)
        channels, pixels = len(evidence.full), len(self.at)
        self.root = torch.zeros((self.size, channels, pixels))
        self.saturated = torch.zeros((self.size, channels, pixels), dtype=torch.bool)
        self.hole = torch.zeros((self.size, pixels), dtype=torch.bool)
        self.present = torch.zeros((self.size, pixels), dtype=torch.bool)
        self.light = torch.zeros((self.size, pixels))
        self.rest = torch.zeros((channels, pixels))
        self.evidence = evidence

    def add(self, step: Step, root: Tensor, hole: Tensor) -> None:
        # Pixels in the order of their windows: those whose window holds this frame stand together.
        ends = torch.tensor([step.index - self.size + 1, step.index + 1])
        first, last = torch.searchsorted(self.ordered, ends).tolist()
        pixels = self.order[first:last]
        where, at = step.index - self.first_index[pixels], self.at[pixels]
        values = root.flatten(1)[:, self.at]
        inside = values[:, pixels].T
        values[:, pixels] = 0.0
        self.rest += values
        self.root[where, :, pixels] = inside
        self.saturated[where, :, pixels] = step.saturated.flatten(1)[:, at].T
        # A lost frame in the window is a hole too: its neighbours may be lit.
        self.hole[where, pixels] = hole.flatten()[at] | step.lost
        self.present[where, pixels] = not step.lost
        self.light[where, pixels] = self.brought.of(step.index).flatten()[at]

    def profiles(self) -> Profiles:
        index = self.first_index + torch.arange(self.size)[:, None]
        lit = self._lit(index - self.centre)
        return Profiles(
            root=self.root,
            offset=index - self.centre,
            hole=self.hole & (lit | ~self.present),
            present=self.present,
            lit=lit,
            saturated=self.saturated,
            light=_relative(self.light, (index - self.centre).abs() <= max(0.5, self.evidence.band.half)),
            rest=self.rest,
        )

    def _lit(self, offset: Tensor) -> Tensor:
        """A doubtful pixel is lit only if its own frames outshine the others: in a shadow those beside it do."""
        band = self.evidence.band
        value = self.root.mean(1)
        own = (offset.abs() <= band.half) & self.present
        mean = (value * own).sum(0) / own.sum(0).clamp(min=1)
        beside = torch.where(self.present & ~self.hole, value, 0.0).amax(0)
        shadowed = band.doubtful[self.mask] & own.any(0) & (mean < OUTSHINE * beside)
        return band.lit[self.mask] & ~shadowed


class _Light:
    """What the slab of a frame lights, summed across it and blurred along it."""

    def __init__(self, evidence: Evidence) -> None:
        self.band, self.mask = evidence.band, evidence.mask
        self.grey = evidence.full.mean(0).clamp(min=0.0) * evidence.mask
        self.along = 1 if evidence.stream.sweep.direction == "x" else 0

    def of(self, index: int) -> Float[Tensor, "height width"]:
        """Of one frame, at every pixel."""
        lit = (self.band.passage.centre - index).abs_().neg_().add_(self.band.half + 0.5).clamp_(0.0, 1.0)
        line = lit.mul_(self.grey).sum(self.along)
        radius = min(12, len(line) - 1)
        taps = torch.exp(-0.5 * (torch.arange(-radius, radius + 1) / BLUR_PX) ** 2)
        line = torch.nn.functional.conv1d(line[None, None], (taps / taps.sum())[None, None], padding=radius)[0, 0]
        return line.unsqueeze(self.along).expand_as(lit)


def _relative(light: Tensor, own: Tensor) -> Tensor:
    """Over its mean in the pixel's own frames; bounded, since a faint row says little."""
    light = (light / (FULL_LIGHT * light.amax(0)).clamp(min=1e-12)).clamp(max=1.0)
    mean = (light * own).sum(0) / own.sum(0).clamp(min=1)
    return (light / mean.clamp(min=1e-12)).clamp(max=4.0)
