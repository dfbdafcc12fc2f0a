"""Work on blocks chunk by chunk, alone or shared among the processes of one run.

Every process knows the whole problem; chunks go to the processes in turn, and what each finds is handed to all of
them. Results stand in the order of the chunks and sums are formed from those of the chunks in that order, so that N
processes give the same numbers as one, bit for bit: along a flat valley, rounding alone would lead them apart. For the
same reason the cuts depend on the number of blocks alone, never on that of the processes.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import torch
from torch import Tensor

from reflectsep.errors import ReflectsepError, SaidElsewhereError, WorkerError
from reflectsep.room import empty
from reflectsep.room import rows as rows_of

SHARES = 4
"""Several chunks come in multiples of so many: three for two processes would keep one of them waiting."""
ALIGNED = 64
"""Blocks."""
PATIENCE = timedelta(minutes=30)
"""How long a process waits for the others. One that dies is noticed at once; this is for one that hangs."""


@dataclass(frozen=True)
class Workers:
    """The processes of this run, and which of them this is."""

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether this is the process that writes and speaks."""
        return self.rank == 0


_ALONE = Workers()
_workers: ContextVar[Workers] = ContextVar("workers", default=_ALONE)


def workers() -> Workers:
    """The processes that share chunks here; within a chunk, and unless `shared_work` says so, this one alone."""
    return _workers.get()


@contextmanager
def shared_work(environment: Mapping[str, str] = os.environ) -> Iterator[Workers]:
    """Share chunks among the processes that `torchrun` has started; just this one where it has started none.

    Raises:
        WorkerError: another process is gone, or does not answer.
        SaidElsewhereError: instead of any other error of ours, in all processes but the one that is to say it.
    """
    if int(environment.get("WORLD_SIZE", "1")) == 1:
        yield _ALONE
        return
    import torch.distributed as dist
    from torch.distributed.rendezvous import rendezvous

    store, rank, count = next(rendezvous("env://", timeout=PATIENCE))
    dist.init_process_group("gloo", store=store, rank=rank, world_size=count, timeout=PATIENCE)
    token = _workers.set(Workers(rank, count))
    try:
        yield _workers.get()
    except ReflectsepError as error:
        if _said(store):
            raise SaidElsewhereError(str(error)) from error
        raise
    finally:
        _workers.reset(token)
        dist.destroy_process_group()


def _said(store: Any) -> bool:
    """Whether another process has begun to say what stopped the run; the one that asks first has not."""
    try:
        return store.add("errors", 1) > 1
    except RuntimeError:  # the process that kept the count is gone
        return False


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch keeps to one thread: several cores are for several processes.

    Work on a chunk is many operations, each too short to be shared out. Torch's own threads wait for each other, and
    take three times as long on two cores as one on one; threads with a chunk each wait for Python's lock.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def by_chunks(count: int, chunk: int, work: Callable[[slice], tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
    """What `work` gives for every chunk of 0 .. count - 1, joined along the first dimension in the chunks' order.

    Args:
        count: blocks in all, at least one.
        chunk: blocks at once, at most.
        work: from a chunk to tensors; the same number of them, with the same trailing shapes, for all chunks.

    Raises:
        WorkerError: another process of the run is gone.
    """
    cuts = cuts_of(count, chunk)
    crew = workers()
    if crew.count > len(cuts):
        crew = _ALONE  # not one for each: then everybody does all of it, which is as quick
    token = _workers.set(_ALONE)
    try:
        if crew.count == 1:
            return _joined(count, cuts, work)
        own = [work(cut) for cut in cuts[crew.rank :: crew.count]]
    finally:
        _workers.reset(token)
    return tuple(_gather(list(parts), crew, len(cuts)) for parts in zip(*own, strict=True))


def _joined(count: int, cuts: list[slice], work: Callable[[slice], tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
    """What `work` gives for every chunk; values of single blocks go to their places at once."""
    columns: list[Tensor | list[Tensor]] = []
    for i, cut in enumerate(cuts):
        parts = work(cut)
        if i == 0:
            of_blocks = [len(part) == cut.stop - cut.start and len(part) != 1 for part in parts]
            columns = [rows_of(count, part) if each else [] for part, each in zip(parts, of_blocks, strict=True)]
        for column, part in zip(columns, parts, strict=True):
            if isinstance(column, list):
                column.append(part)
            else:
                column[cut] = part
    return tuple(torch.cat(column) if isinstance(column, list) else column for column in columns)


def cuts_of(count: int, chunk: int) -> list[slice]:
    """0 .. count - 1 in chunks of `chunk` at most, all but the last of one length; one chunk, or `SHARES` or more."""
    number = -(-count // chunk)
    if number > 1:
        even = -(-count // (SHARES * -(-number // SHARES)))
        # Whole vectors of the processor, where they fit.
        chunk = min(chunk, -(-even // ALIGNED) * ALIGNED) if even >= ALIGNED else even
    return [slice(i, min(i + chunk, count)) for i in range(0, count, chunk)]


def by_items(count: int, work: Callable[[int], Any], *, at_once: int = 1) -> list[Any]:
    """What `work` gives for every item 0 .. count - 1, in their order, the items shared like chunks.

    Args:
        count: items in all.
        work: from an item to plain values, those that JSON has.
        at_once: items that a process that is alone works on side by side, each on one of torch's threads: for items
            whose operations are long. `work` must bear that.

    Raises:
        WorkerError: another process of the run is gone.
    """
    if workers().count == 1 or count == 0:
        if min(at_once, count) < 2:
            return [work(i) for i in range(count)]
        with one_thread(), ThreadPoolExecutor(min(at_once, count)) as pool:
            return list(pool.map(work, range(count)))

    def line(cut: slice) -> tuple[Tensor]:
        text = json.dumps(work(cut.start)) + "\n"
        return (torch.frombuffer(bytearray(text.encode()), dtype=torch.uint8),)

    text = by_chunks(count, 1, line)[0].numpy().tobytes().decode()
    return [json.loads(entry) for entry in text.splitlines()]


def by_turns(count: int, work: Callable[[int], Mapping[str, Tensor]]) -> list[dict[str, Tensor]]:
    """What `work` gives for every item 0 .. count - 1, in their order; item i is worked out by process i modulo all.

    For few and large items: each tensor goes from the process that made it straight into its place in the others.

    Args:
        count: items in all.
        work: from an item to tensors by name, of any shapes, on the processor.

    Raises:
        WorkerError: another process of the run is gone.
    """
    crew = workers()
    token = _workers.set(_ALONE)
    try:
        own = {i: dict(work(i)) for i in range(count) if i % crew.count == crew.rank}
    finally:
        _workers.reset(token)
    if crew.count == 1:
        return [own[i] for i in range(count)]
    try:
        return [_handed_out(own.pop(i, None), i % crew.count) for i in range(count)]
    except RuntimeError as error:
        raise _gone(error) from error


def _handed_out(own: dict[str, Tensor] | None, source: int) -> dict[str, Tensor]:
    """An item's tensors on all processes; `own` is None on those that did not make them."""
    import torch.distributed as dist

    made = own or {}
    header = json.dumps([[name, str(part.dtype).split(".")[-1], list(part.shape)] for name, part in made.items()])
    text = torch.frombuffer(bytearray(header.encode()), dtype=torch.uint8)
    length = torch.tensor([len(text)])
    dist.broadcast(length, source)
    if own is None:
        text = torch.empty(int(length), dtype=torch.uint8)
    dist.broadcast(text, source)
    result: dict[str, Tensor] = {}
    for name, kind, shape in json.loads(text.numpy().tobytes()):
        dtype = getattr(torch, kind)
        part = empty(*shape, dtype=dtype) if own is None else own[name].contiguous()
        # One byte each, but no kind that processes exchange.
        dist.broadcast(part.view(torch.uint8) if dtype == torch.bool else part, source)
        result[name] = part
    return result


def _gather(own: list[Tensor], crew: Workers, chunks: int) -> Tensor:
    """Every chunk's tensor, in order, on all processes."""
    import torch.distributed as dist

    rows = torch.zeros(chunks, dtype=torch.int64)
    rows[crew.rank :: crew.count] = torch.tensor([len(part) for part in own])
    mine = torch.cat(own)
    kind = mine.dtype
    if kind == torch.bool:
        mine = mine.to(torch.uint8)
    try:
        dist.all_reduce(rows)
        totals = [int(rows[rank :: crew.count].sum()) for rank in range(crew.count)]
        padded = mine.new_zeros(max(totals), *mine.shape[1:])
        padded[: len(mine)] = mine
        gathered = [torch.empty_like(padded) for _ in totals]
        dist.all_gather(gathered, padded)
    except RuntimeError as error:
        raise _gone(error) from error
    result = mine.new_empty(int(rows.sum()), *mine.shape[1:])
    starts = [0, *rows.cumsum(0).tolist()]
    for rank, part in enumerate(gathered):
        at = 0
        for i in range(rank, chunks, crew.count):
            length = starts[i + 1] - starts[i]
            result[starts[i] : starts[i + 1]] = part[at : at + length]
            at += length
    return result.to(kind)


def _gone(error: RuntimeError) -> WorkerError:
    """What is said when processes cannot exchange anything any more."""
    return WorkerError(f"another process of this run is gone or does not answer ({_reason(error)})")


def _reason(error: RuntimeError) -> str:
    """What broke, without the library's place in its own source and its advice."""
    text = str(error)
    if text.startswith("["):  # [FILE:LINE] what broke. Advice.
        text = text.split("] ", 1)[-1]
    return text.split(". ")[0].split("\n")[0] or type(error).__name__
