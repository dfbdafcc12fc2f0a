"""Frames of a sweep, checked, complete and ready to be summed.

A shadow sweep becomes its complement (slab = full - shadow). A frame that the capture lost is never invented: it passes
as a `Step` marked `lost`, whose values lie between those of its received neighbours. Whoever sums frames may use it for
pixels far from the lit band, where profiles are smooth, and must treat it as a hole near the band.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.data import Frame, FrameStream, Sweep
from reflectsep.errors import SweepError
from reflectsep.io.ahead import frames_of


@dataclass(frozen=True, kw_only=True)
class Step:
    """One step of a sweep."""

    index: int
    values: Float[Tensor, "channels height width"]
    """Of the slab, linear, in the capture's units; off the object whatever the camera saw there, but finite."""
    saturated: Bool[Tensor, "channels height width"] | None
    """None: nothing is."""
    lost: bool = False


def signed_root(values: Tensor, n_d: float) -> Tensor:
    """sign(I) |I|^(1/n_d): noise around zero stays around zero in a sum over frames."""
    return values if n_d == 1.0 else values.abs().pow_(1.0 / n_d).copysign_(values)


def name_of(sweep: Sweep) -> str:
    """A sweep as messages name it: light, direction and files."""
    files = sweep.frames or sweep.video
    return f"sweep of {sweep.light} along {sweep.direction}" + (f" ({files})" if files else "")


def steps(
    stream: FrameStream, full: Float[Tensor, "channels height width"], mask: Bool[Tensor, "height width"]
) -> Generator[Step, None, None]:
    """Every step between the first and the last received frame, in order; two frames are held at a time.

    Left half-way, it is to be closed (`contextlib.closing`), so that no thread goes on reading.

    Raises:
        SweepError: a frame of the wrong size, out of order, or with values that are no numbers.
    """
    before: Step | None = None
    with frames_of(stream) as frames:
        for frame in frames:
            step = _checked(frame, stream.sweep, full, mask)
            if before is not None:
                if step.index <= before.index:
                    raise SweepError(f"{name_of(stream.sweep)}: frame {step.index} follows frame {before.index}")
                yield from _between(before, step)
            yield step
            before = step


def _checked(frame: Frame, sweep: Sweep, full: Tensor, mask: Tensor) -> Step:
    values = frame.values
    if values.shape != full.shape:
        raise SweepError(
            f"{name_of(sweep)}, frame {frame.index}: {_size(values)}, but the full picture is {_size(full)}"
        )
    values = values.to(full.dtype)
    if sweep.kind == "shadow":
        values = full - values
    # One sum tells whether any value is no number; which ones is looked for only then.
    if not bool(torch.isfinite(values.sum())):
        bad = ~torch.isfinite(values) & mask
        if bad.any():
            raise SweepError(
                f"{name_of(sweep)}, frame {frame.index}: {int(bad.sum())} values on the object are no finite numbers"
            )
        values = torch.where(mask, values, 0.0)
    clipped = None if frame.saturated is None or not frame.saturated.any() else frame.saturated & mask
    return Step(index=frame.index, values=values, saturated=clipped)


def _between(before: Step, after: Step) -> Iterator[Step]:
    gap = after.index - before.index
    for i in range(1, gap):
        values = _interpolated(before.values, after.values, i / gap)
        clipped = _either(before.saturated, after.saturated)
        yield Step(index=before.index + i, values=values, saturated=clipped, lost=True)


def _either(a: Tensor | None, b: Tensor | None) -> Tensor | None:
    return b if a is None else a if b is None else a | b


def _interpolated(a: Tensor, b: Tensor, weight: float) -> Tensor:
    """Geometrically where both are positive, since profiles fall exponentially; else, in the noise, linearly."""
    both = (a > 0) & (b > 0)
    geometric = a.clamp(min=1e-30).pow(1 - weight) * b.clamp(min=1e-30).pow(weight)
    return torch.where(both, geometric, torch.lerp(a, b, weight))


def _size(values: Tensor) -> str:
    return "x".join(str(n) for n in reversed(values.shape))
