"""Whole pictures a few pixels at a time, where what is in between is many times larger than what comes out."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from torch import Tensor

AT_ONCE = 1 << 15
"""Pixels: some ten megabytes of what is in between."""


def cuts(pixels: int) -> Iterator[slice]:
    """0 .. pixels - 1, `AT_ONCE` at a time; one empty cut where there are none."""
    for start in range(0, max(pixels, 1), AT_ONCE):
        yield slice(start, min(start + AT_ONCE, pixels))


def in_chunks(pixels: int, work: Callable[[slice], Tensor]) -> Tensor:
    """What `work` gives for the pixels of every cut, in their order; for work on each pixel by itself."""
    result: Tensor | None = None
    for cut in cuts(pixels):
        part = work(cut)
        if result is None:
            result = part.new_empty(pixels, *part.shape[1:])
        result[cut] = part
    assert result is not None  # there is a cut, if only an empty one
    return result
