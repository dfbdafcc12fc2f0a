"""Each pixel's frames around its passage, handed on as soon as they are complete.

Pixels whose windows begin with the same frame are a group. A group is opened with that frame and closed with the last
of its window, so that only the pixels near the slab hold frames: memory does not grow with the number of frames.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from reflectsep.scatter.band import LitBand
from reflectsep.scatter.frames import Step, signed_root

TOGETHER = 1 << 12
"""Pixels that are handed on at a time, at least: fewer do not pay for the calls."""
OUTSHINE = 1.1


@dataclass(frozen=True, kw_only=True)
class Profiles:
    """Root frames around the passage of P pixels of the object."""

    root: Float[Tensor, "frames channels P"]
    offset: Float[Tensor, "frames P"]
    """Frame minus passage; frames are a unit step apart, and the middle one is within half a frame of the passage."""
    present: Bool[Tensor, "frames P"]
    """Received."""
    lit: Bool[Tensor, "P"]
    """Pixels that the slab lights at all."""
    saturated: Bool[Tensor, "frames channels P"]
    at: Int[Tensor, "P"]
    """Place of each pixel in the flattened picture."""


@dataclass(frozen=True, kw_only=True)
class View:
    """What of a sweep its windows need to know."""

    full: Float[Tensor, "channels height width"]
    mask: Bool[Tensor, "height width"]
    band: LitBand
    n_d: float
    reach: int
    """Frames on either side of the lit interval."""


class Windows:
    """Takes the frames as they come and gives the profiles that are complete."""

    def __init__(self, view: View) -> None:
        self.view, band = view, view.band
        self.reach = math.ceil(band.half + band.edge) + view.reach
        self.size = 2 * self.reach + 1
        at = view.mask.flatten().nonzero()[:, 0]
        first = band.passage.centre.flatten()[at].round().int() - self.reach
        first, order = first.sort(stable=True)
        self.at = at[order]
        self.centre = band.passage.centre.flatten()[self.at]
        firsts, counts = first.unique_consecutive(return_counts=True)
        self.firsts, self.starts = firsts.tolist(), [0, *counts.cumsum(0).tolist()]
        self.begun = 0
        self.open: deque[_Group] = deque()
        self.done: list[Profiles] = []

    def add(self, step: Step) -> Iterator[Profiles]:
        """Put a frame into the windows that hold it; profiles that are complete, many at a time."""
        self._open_until(step.index)
        self._close_until(step.index)
        if self.open:
            self._put(step)
        self._close_until(step.index + 1)
        if sum(len(p.at) for p in self.done) >= TOGETHER:
            yield self._joined()

    def rest(self) -> Iterator[Profiles]:
        """Profiles of the windows that the sweep's end cut off, or that it never reached."""
        while self.open or self.begun < len(self.firsts):
            if not self.open:
                self._open_until(self.firsts[self.begun])
            self._close_until(self.open[-1].first + self.size)
            if sum(len(p.at) for p in self.done) >= TOGETHER:
                yield self._joined()
        if self.done:
            yield self._joined()

    def _open_until(self, index: int) -> None:
        while self.begun < len(self.firsts) and self.firsts[self.begun] <= index:
            pixels = slice(self.starts[self.begun], self.starts[self.begun + 1])
            self.open.append(_Group(self.firsts[self.begun], pixels, self.size, self.view.full))
            self.begun += 1

    def _close_until(self, index: int) -> None:
        """Close the groups whose window ends before a frame."""
        while self.open and self.open[0].first + self.size <= index:
            self.done.append(self._profiles(self.open.popleft()))

    def _joined(self) -> Profiles:
        parts, self.done = self.done, []
        if len(parts) == 1:
            return parts[0]
        return Profiles(**{f.name: torch.cat([getattr(p, f.name) for p in parts], -1) for f in fields(Profiles)})

    def _put(self, step: Step) -> None:
        """Pixels stand in the order of their windows: those whose window holds this frame stand together."""
        begin, end = self.open[0].pixels.start, self.open[-1].pixels.stop
        at = self.at[begin:end]
        values = step.values.flatten(1)[:, at]
        root = signed_root(values, self.view.n_d)
        clipped = None if step.saturated is None else step.saturated.flatten(1)[:, at]
        for group in self.open:
            row, own = step.index - group.first, slice(group.pixels.start - begin, group.pixels.stop - begin)
            group.root[row] = root[:, own]
            group.present[row] = not step.lost
            if clipped is not None:
                group.clipped(row, clipped[:, own])

    def _profiles(self, group: _Group) -> Profiles:
        band, at = self.view.band, self.at[group.pixels]
        offset = group.first + torch.arange(self.size)[:, None] - self.centre[group.pixels]
        present = group.present[:, None].expand(-1, len(at))
        lit = _lit(band, group, offset, at)
        return Profiles(
            root=group.root,
            offset=offset,
            present=present,
            lit=lit,
            saturated=group.saturated,
            at=at,
        )


class _Group:
    """Pixels whose windows begin with the same frame."""

    def __init__(self, first: int, pixels: slice, size: int, full: Tensor) -> None:
        self.first, self.pixels = first, pixels
        count = pixels.stop - pixels.start
        self.root = full.new_zeros((size, len(full), count))
        self.present = torch.zeros(size, dtype=torch.bool)
        self.saturated = torch.zeros((), dtype=torch.bool).expand(self.root.shape)

    def clipped(self, row: int, values: Tensor) -> None:
        """Take note of what is saturated in a frame: memory for it only where something is."""
        if values.any():
            if self.saturated.stride(0) == 0:
                self.saturated = torch.zeros(self.root.shape, dtype=torch.bool)
            self.saturated[row] = values


def _lit(band: LitBand, group: _Group, offset: Tensor, at: Tensor) -> Tensor:
    """A doubtful pixel is lit only if its own frames outshine the others: in a shadow those beside it do."""
    lit = band.lit.flatten()[at]
    some = (lit & band.doubtful.flatten()[at]).nonzero()[:, 0]
    if len(some):
        every = slice(None) if len(some) == len(at) else some
        value, hole = group.root[:, :, every], offset[:, every].abs() <= band.half + band.edge
        value = value[:, 0] if value.shape[1] == 1 else value.mean(1)
        beside = value.masked_fill(hole | ~group.present[:, None], 0.0).amax(0)
        # Only the rows in the middle may be the pixel's own.
        reach, inner = len(offset) // 2, math.ceil(band.half + 0.5)
        rows = slice(max(0, reach - inner), reach + inner + 1)
        own = (offset[rows, every].abs() <= band.half) & group.present[rows, None]
        mean = (value[rows] * own).sum(0) / own.sum(0).clamp(min=1)
        lit[some] = ~(own.any(0) & (mean < OUTSHINE * beside))
    return lit
