"""Reading ahead: threads decode the next files while those before them are worked on, only so many at a time.

The codecs let go of Python's lock, so that decoding and tensor work share the cores. What comes out is the same, in
the same order, whatever the number of threads; an error comes out where its file would have. The threads are gone when
the iterator ends, fails or is closed, so whoever may stop half-way goes through frames inside `frames_of`.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import torch

from reflectsep.data import Frame, FrameStream

MOST_THREADS = 4
MOST_BYTES = 512 * 2**20
"""Of frames that wait: few large ones, many small ones."""

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True)
class Lead:
    """How far reading runs ahead."""

    threads: int
    """0: not at all."""
    held: int
    """Results at most that are being made, or wait, while the caller is at work on another."""


NO_LEAD = Lead(threads=0, held=0)


def lead_for(frame_bytes: int) -> Lead:
    """As far ahead as cores and memory allow.

    Args:
        frame_bytes: of a decoded frame.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if cores == 1:
        return NO_LEAD
    room = max(1, MOST_BYTES // max(1, frame_bytes))
    threads = min(cores, MOST_THREADS, room)
    return Lead(threads=threads, held=min(2 * threads, room))


def in_order(make: Callable[[Item], Result], items: Iterable[Item], lead: Lead) -> Iterator[Result]:
    """`make(item)` of every item, in order, made by threads that run ahead.

    Args:
        make: called in a thread; what it raises is raised here, after the results before it.
        items: gone through in the caller's thread.
        lead: how far ahead; without threads everything happens in the caller's.
    """
    if not lead.threads:
        yield from map(make, items)
        return
    pool = ThreadPoolExecutor(lead.threads, thread_name_prefix="reading ahead")
    waiting: deque[Future[Result]] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(make, item))
            if len(waiting) > lead.held:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def frames_of(stream: FrameStream) -> Iterator[Iterator[Frame]]:
    """The frames of a stream, its threads and files closed when the block is left, however it is left."""
    frames = iter(stream)
    try:
        yield frames
    finally:
        close = getattr(frames, "close", None)
        if close is not None:
            close()


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch keeps to one thread: the other cores decode.

    Work on a frame is many short operations. Shared out they wait for each other, and for the decoding threads: ten
    times as long in all on two busy cores.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
