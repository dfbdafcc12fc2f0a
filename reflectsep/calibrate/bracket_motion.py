"""Motion between the exposures of a bracketed sweep.

All exposures show the same light and the same slab, so their sums are pictures of the same thing. What one of them
clips is left out of both sums, and so are the frames next to it: where the camera has moved, the other exposure is lit
a frame sooner or later, and what is lit outshines what scatters.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack

import torch
from jaxtyping import Bool
from torch import Tensor

from reflectsep.calibrate.align_options import MARGIN_PX, AlignOptions, grown, judged
from reflectsep.calibrate.bracketed_sweep import BracketedStream
from reflectsep.calibrate.motion import Motion
from reflectsep.calibrate.register import RegisterOptions, register
from reflectsep.calibrate.sweep_sum import roots_of
from reflectsep.data import Frame, FrameStream
from reflectsep.errors import CaptureError
from reflectsep.io.ahead import frames_of

BESIDE = 2
"""Frames beside a clipped one that are left out as well."""
FEWEST_FRAMES = 3
"""Of a pixel that count."""


def bracket_motions(
    stream: FrameStream, mask: Bool[Tensor, "height width"], options: AlignOptions
) -> tuple[Motion, ...]:
    """Motion of every further exposure of a sweep against its first; nothing for a sweep of one exposure.

    Args:
        stream: developed frames; of a bracket, the first exposure is read once for each of the others.
        mask: the object in the first exposure.
        options: settings of the alignment.
    """
    if not isinstance(stream, BracketedStream):
        return ()
    first, *others = stream.streams
    return tuple(_motion(first, other, mask, options) for other in others)


def _motion(first: FrameStream, other: FrameStream, mask: Tensor, options: AlignOptions) -> Motion:
    still, moving, count = _sums(first, other, options.n_d)
    seen = count >= FEWEST_FRAMES
    try:
        found = register(
            moving,
            still,
            usable=grown(mask, MARGIN_PX) & seen,
            moving_usable=seen,
            options=RegisterOptions(models=options.models),
        )
    except CaptureError as error:
        return Motion(reason=str(error))
    return judged(found, mask)


def _sums(first: FrameStream, other: FrameStream, n_d: float) -> tuple[Tensor, Tensor, Tensor]:
    """Means of both exposures' n_d-roots over the frames that neither clips, and how many these are."""
    total: Tensor | None = None
    with ExitStack() as passing:
        pairs = _pairs(*(passing.enter_context(frames_of(stream)) for stream in (first, other)))
        for a, b, sound in _sound(pairs):
            parts = [torch.where(sound, roots_of(frame.values, n_d).mean(0), 0.0).double() for frame in (a, b)]
            part = torch.stack([*parts, sound.double()])
            total = part if total is None else total + part
    if total is None:
        raise CaptureError(f"sweep of {first.sweep.light} along {first.sweep.direction}: no frame at two exposures")
    still, moving, count = total
    return still / count.clamp_min(1.0), moving / count.clamp_min(1.0), count


def _pairs(first: Iterator[Frame], other: Iterator[Frame]) -> Iterator[tuple[Frame, Frame]]:
    """Frames that both exposures have."""
    a, b = next(first, None), next(other, None)
    while a is not None and b is not None:
        if a.index == b.index:
            yield a, b
        behind = min(a.index, b.index)
        a, b = (next(first, None) if a.index == behind else a), (next(other, None) if b.index == behind else b)


def _sound(pairs: Iterator[tuple[Frame, Frame]]) -> Iterator[tuple[Frame, Frame, Tensor]]:
    """Every pair with the pixels that neither frame clips, nor those up to `BESIDE` before and after."""
    waiting: deque[tuple[Frame, Frame]] = deque()
    clipped: deque[Tensor] = deque(maxlen=2 * BESIDE + 1)
    for pair in pairs:
        waiting.append(pair)
        clipped.append(_clipped(pair[0]) | _clipped(pair[1]))
        if len(waiting) > BESIDE:
            yield *waiting.popleft(), ~torch.stack(tuple(clipped)).any(0)
    while waiting:
        # Of the last ones those that have passed out of reach count too: it only leaves out a little more.
        yield *waiting.popleft(), ~torch.stack(tuple(clipped)).any(0)


def _clipped(frame: Frame) -> Tensor:
    bad = ~torch.isfinite(frame.values)
    return (bad if frame.saturated is None else bad | frame.saturated).any(0)
