"""A sweep's frames in the reference's place, each resampled once as it is read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from reflectsep.calibrate.bracketed_sweep import BracketedStream
from reflectsep.calibrate.motion import Motion, warp
from reflectsep.data import Frame, FrameStream, Sweep
from reflectsep.io.ahead import frames_of


@dataclass(frozen=True, kw_only=True)
class AlignedStream:
    """A stream of developed frames, each resampled once into the reference as it is read."""

    stream: FrameStream
    motion: Motion

    @property
    def sweep(self) -> Sweep:
        """What is streamed."""
        return self.stream.sweep

    def __len__(self) -> int:
        return len(self.stream)

    def __iter__(self) -> Iterator[Frame]:
        last = max(1, len(self.stream) - 1)
        with frames_of(self.stream) as frames:
            for frame in frames:
                # Where nothing is clipped, nothing of that is resampled.
                clipped = None if frame.saturated is None or not frame.saturated.any() else frame.saturated
                values, saturated, _ = warp(frame.values, self.motion.at(2 * frame.index / last - 1), clipped)
                yield Frame(index=frame.index, values=values, saturated=saturated)


def aligned_stream(stream: FrameStream, motion: Motion, exposures: Sequence[Motion] = ()) -> FrameStream:
    """`stream` as the reference sees it; itself where nothing moved.

    Args:
        stream: developed frames.
        motion: of the sweep, of a bracket its first exposure.
        exposures: of a bracket's further exposures against the first.
    """
    if isinstance(stream, BracketedStream) and any(own.applied for own in exposures):
        # Every exposure by its whole motion, and merged then: nothing is resampled twice.
        still = Motion(reason="the first exposure")
        whole = [after(motion, own) for own in (still, *exposures)]
        return replace(stream, streams=tuple(aligned_stream(*one) for one in zip(stream.streams, whole, strict=True)))
    return AlignedStream(stream=stream, motion=motion) if motion.applied else stream


def after(motion: Motion, own: Motion) -> Motion:
    """An exposure's motion against the reference: its own against the first exposure, after the sweep's."""
    if not own.applied:
        return motion
    if not motion.applied:
        return own
    shift = own.matrix[:2, :2] @ motion.matrix.new_tensor(motion.velocity)
    return replace(motion, matrix=own.matrix @ motion.matrix, velocity=(float(shift[0]), float(shift[1])))
