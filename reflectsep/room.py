"""Room for whole pictures: memory while there is little to hold, files where there is much.

The maps of a large capture are several times what a machine has. Tensors that outlive a step are taken from here: small
ones are plain memory, large ones pages of a nameless file beside the result. These the system writes out and reads
back as it needs the memory; they are gone with the tensor, however the program ends.
"""

from __future__ import annotations

import errno
import math
import mmap
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

import torch
from torch import Tensor

LEAST_BYTES = 1 << 26
"""Of a tensor that goes into a file."""

_folder: ContextVar[Path | None] = ContextVar("folder", default=None)


@contextmanager
def room_beside(out: Path | str) -> Iterator[None]:
    """Large tensors made in here are files in the folder that `out` stands in; memory where nothing may be written."""
    folder = Path(out).absolute().parent
    while not folder.is_dir():
        folder = folder.parent
    token = _folder.set(folder if os.access(folder, os.W_OK) else None)
    try:
        yield
    finally:
        _folder.reset(token)


def empty(*shape: int, dtype: torch.dtype) -> Tensor:
    """A tensor of any content.

    Raises:
        OSError: the disk has no room for it.
    """
    folder, size = _folder.get(), math.prod(shape) * dtype.itemsize
    if folder is None or size < LEAST_BYTES:
        return torch.empty(shape, dtype=dtype)
    with tempfile.TemporaryFile(dir=folder) as file:
        try:
            # Now, because a disk that is found full while a page is written ends the program without a word.
            os.posix_fallocate(file.fileno(), 0, size)
        except OSError as error:
            reason = os.strerror(error.errno or errno.EIO)
            raise OSError(error.errno, f"no room for {size / 2**30:.1f} GiB of maps ({reason})", str(folder)) from error
        pages = mmap.mmap(file.fileno(), size)
    return torch.frombuffer(pages, dtype=dtype).view(shape)


def rows(count: int, like: Tensor) -> Tensor:
    """Room for `count` rows like those of `like`, on its device."""
    if like.device.type != "cpu":
        return like.new_empty(count, *like.shape[1:])
    return empty(count, *like.shape[1:], dtype=like.dtype)


def copied(source: Tensor) -> Tensor:
    """`source` once more."""
    result = rows(len(source), source)
    result.copy_(source)
    return result


def stacked(parts: Iterator[Tensor] | list[Tensor], count: int) -> Tensor:
    """`count` tensors of one shape as one, each let go as soon as it is in its place."""
    result: Tensor | None = None
    for i, part in enumerate(parts):
        if result is None:
            result = empty(count, *part.shape, dtype=part.dtype)
        result[i] = part
    if result is None:
        raise ValueError("nothing to stack")
    return result


def cuts(count: int, at_once: int) -> Iterator[slice]:
    """0 .. count - 1, `at_once` at a time."""
    for start in range(0, count, at_once):
        yield slice(start, min(start + at_once, count))


def by_rows(count: int, at_once: int, work: Callable[[slice], Tensor]) -> Tensor:
    """What `work` gives for rows 0 .. count - 1, `at_once` at a time; an empty cut where there are none."""
    result: Tensor | None = None
    for cut in cuts(count, at_once) if count else (slice(0, 0),):
        part = work(cut)
        if result is None:
            result = rows(count, part)
        result[cut] = part
    assert result is not None  # there is a cut, if only an empty one
    return result
