"""A sweep's frames added up: by Eq. 25 the full picture of its light again, up to C."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.data import FrameStream
from reflectsep.errors import CaptureError
from reflectsep.io.ahead import frames_of, one_thread
from reflectsep.progress import Progress, silent


@dataclass(frozen=True, kw_only=True)
class SweepSum:
    """A sweep's frames added up."""

    total: Float[Tensor, "height width"]
    """Sum of the n_d-roots, channel mean."""
    usable: Bool[Tensor, "height width"]
    """Not clipped in any frame, and no frame near its passage was lost."""
    time: Float[Tensor, "height width"]
    """When the slab passed: -1 at the first frame, 1 at the last."""
    clipped: Bool[Tensor, "height width"]
    clipped_frames: Float[Tensor, "height width"]
    """In how many frames."""


def add_frames(stream: FrameStream, n_d: float = 1.0, progress: Progress = silent) -> SweepSum:
    """Add a sweep's frames up; one is held at a time.

    Raises:
        CaptureError: no frame in it.
    """
    total = moment = mass = times = None
    count = max(2, len(stream))
    received = set()
    with one_thread(), frames_of(stream) as frames:
        for frame in frames:
            received.add(frame.index)
            root = roots_of(frame.values, n_d).mean(0).double()
            if total is None or moment is None or mass is None or times is None:
                total, moment, mass, times = (torch.zeros_like(root) for _ in range(4))
            total += root
            weight = root.clamp_(min=0).square_().square_()  # the frames that light a pixel outweigh all others
            mass += weight
            moment.add_(weight, alpha=frame.index)
            if frame.saturated is not None and frame.saturated.any():
                times += frame.saturated.any(0)
            progress(f"alignment {stream.sweep.light} {stream.sweep.direction}", frame.index + 1, len(stream))
    if total is None or moment is None or mass is None or times is None:
        raise CaptureError(f"sweep of {stream.sweep.light} along {stream.sweep.direction}: no frames")
    passed = moment / mass.clamp_min(1e-300)
    if stream.sweep.kind == "shadow":
        passed = torch.full_like(passed, (count - 1) / 2)  # where it is dark cannot be told from the brightest frames
    clipped = times > 0
    usable = ~clipped
    for index in set(range(count)) - received:
        usable &= (passed - index).abs() > 3
    return SweepSum(
        total=total, usable=usable, time=2 * passed / (count - 1) - 1, clipped=clipped, clipped_frames=times
    )


def roots_of(values: Tensor, n_d: float) -> Tensor:
    """Signed n_d-roots: noise around zero stays around zero in a sum."""
    return values if n_d == 1.0 else values.sign() * values.abs() ** (1.0 / n_d)
