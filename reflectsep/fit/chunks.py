"""Whole pictures a few pixels at a time, where what is in between is many times larger than what comes out."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from torch import Tensor

from reflectsep import room

AT_ONCE = 1 << 15
"""Pixels: some ten megabytes of what is in between."""


def cuts(pixels: int) -> Iterator[slice]:
    """0 .. pixels - 1, `AT_ONCE` at a time."""
    return room.cuts(pixels, AT_ONCE)


def in_chunks(pixels: int, work: Callable[[slice], Tensor]) -> Tensor:
    """What `work` gives for the pixels of every cut, in their order; for work on each pixel by itself."""
    return room.by_rows(pixels, AT_ONCE, work)


def taken(values: Tensor, index: Tensor) -> Tensor:
    """Rows `index` of `values`, which may be most of them."""
    return in_chunks(len(index), lambda cut: values[index[cut]])
