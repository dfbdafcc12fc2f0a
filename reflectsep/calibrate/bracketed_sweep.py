"""A sweep at several exposures: merged frame by frame into one linear sweep as it is read.

What lights a pixel is many times what scatters into it, so a frame that shows scattering well clips where it is lit,
and one that does not clip drowns scattering in noise. Every frame is merged as a bracket of full pictures is
(`bracket.merge`): weights are exposures, 0 where clipped, and only what every exposure clips counts as clipped. One
frame of each exposure is held at a time. A frame that one exposure lost is that of the others.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from reflectsep.calibrate.bracket import merge
from reflectsep.data import Frame, FrameStream, Sweep
from reflectsep.errors import CaptureError
from reflectsep.io.ahead import frames_of

DISAGREE = 0.35
"""Mean difference of two exposures over their mean, where neither is clipped, beyond which they do not show the slab at
the same places; noise apart, frames half a step apart differ by more."""
BRIGHT = 0.2
"""Of a frame's brightest unclipped value: what is compared stands out of the noise."""


@dataclass(frozen=True, kw_only=True)
class BracketedStream:
    """The developed frames of several exposures as one sweep."""

    streams: tuple[FrameStream, ...]
    """Of every exposure, in the capture's units."""
    where: str
    """Names the capture in errors."""

    @property
    def sweep(self) -> Sweep:
        """The first exposure's; lost are the frames that all of them lost."""
        each = [stream.sweep for stream in self.streams]
        lost = frozenset.intersection(*(sweep.lost for sweep in each))
        return replace(each[0], lost=lost, bracket=tuple(each[1:]))

    def __len__(self) -> int:
        return len(self.streams[0])

    def __iter__(self) -> Iterator[Frame]:
        with ExitStack() as open_streams:
            yield from self._merged([open_streams.enter_context(frames_of(stream)) for stream in self.streams])

    def _merged(self, passing: list[Iterator[Frame]]) -> Iterator[Frame]:
        heads = [next(frames, None) for frames in passing]
        agreement = [_Agreement() for _ in self.streams]
        while any(head is not None for head in heads):
            index = min(head.index for head in heads if head is not None)
            here = [i for i, head in enumerate(heads) if head is not None and head.index == index]
            frames = [head for head in (heads[i] for i in here) if head is not None]
            for i, frame in zip(here, frames, strict=True):
                if i and here[0] == 0:
                    agreement[i].add(frames[0], frame)
            yield _merged(index, frames, [self._exposure_s(i) for i in here])
            for i in here:
                heads[i] = next(passing[i], None)
        for i, found in enumerate(agreement):
            self._require(i, found)

    def _exposure_s(self, i: int) -> float:
        exposure_s = self.streams[i].sweep.exposure_s
        assert exposure_s is not None  # or it would be no bracket
        return exposure_s

    def _require(self, i: int, found: _Agreement) -> None:
        if found.share > DISAGREE:
            sweep = self.streams[i].sweep
            raise CaptureError(
                f"{self.where}: sweeps of {sweep.light} along {sweep.direction} at {self._exposure_s(0):g} and "
                f"{self._exposure_s(i):g} s differ by {found.share:.0%} where neither is clipped, expected the same "
                "frames at two exposures; were the exposures or the slab's positions others?"
            )


class _Agreement:
    """How far two exposures are apart, over the frames that have passed."""

    def __init__(self) -> None:
        self.apart = self.size = 0.0

    def add(self, a: Frame, b: Frame) -> None:
        both = ~(_bad(a) | _bad(b))
        if not bool(both.any()):
            return
        x, y = a.values[both].double(), b.values[both].double()
        mean = 0.5 * (x + y)
        bright = mean > BRIGHT * float(mean.max())
        self.apart += float((x - y).abs()[bright].sum())
        self.size += float(mean[bright].sum())

    @property
    def share(self) -> float:
        return self.apart / self.size if self.size > 0 else 0.0


def _bad(frame: Frame) -> Tensor:
    return torch.zeros_like(frame.values, dtype=torch.bool) if frame.saturated is None else frame.saturated


def _merged(index: int, frames: list[Frame], exposures_s: list[float]) -> Frame:
    values, clipped = merge([frame.values for frame in frames], [_bad(frame) for frame in frames], exposures_s)
    return Frame(index=index, values=values, saturated=clipped)
