"""Many pixels through a block of slots that a queue keeps full.

A few stragglers would keep a chunk alive long after the others are done; so the slots of finished pixels are given to
the next ones, and what is left at the end moves to a smaller block. Which slot a pixel gets, and beside whom, makes
no difference to its result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, Int8
from torch import Tensor

from reflectsep.kernel.step import ACTIVE, EMPTY, Layout

REFILL = 8
"""Slots are given on once a REFILL-th of the block is finished."""


@dataclass(frozen=True)
class Queue:
    """What is to be solved: entry i starts pixel `which[i]` (pixel i) at `start[:, i]`."""

    maps: Sequence[Float[Tensor, "rows pixels"]]
    """All data of a pixel."""
    start: Float[Tensor, "unknowns entries"]
    which: Int[Tensor, "entries"] | None = None


@dataclass(frozen=True)
class Ends:
    """Where every entry ended, to be filled in."""

    local: Float[Tensor, "unknowns entries"]
    cost: Float[Tensor, "entries"]
    status: Int8[Tensor, "entries"]

    @classmethod
    def of(cls, start: Float[Tensor, "unknowns entries"]) -> Ends:
        """Nothing is finished yet."""
        entries = start.shape[1]
        status = torch.full((entries,), EMPTY, dtype=torch.int8, device=start.device)
        return cls(start.clone(), start.new_full((entries,), float("inf")), status)

    def at(self, part: slice) -> Ends:
        """Views of some of the entries."""
        return Ends(self.local[:, part], self.cost[part], self.status[part])


class Block:
    """Slots with the state and the data of the pixels in them."""

    def __init__(self, size: int, rows: int, layout: Layout, like: Tensor) -> None:
        self.layout = layout
        self.state = like.new_zeros(layout.rows, size)
        self.state[layout.status] = float(EMPTY)
        self.maps = like.new_zeros(rows, size)
        self.entry = torch.zeros(size, dtype=torch.int64, device=like.device)

    def put(self, slots: Tensor, queue: Queue, first: int) -> None:
        """Entries first, first + 1, ... of the queue into `slots`."""
        # By scatter_ and gather: advanced indexing takes four times as long.
        cut, at = slice(first, first + len(slots)), 0
        for values in queue.maps:
            new = values[:, cut] if queue.which is None else values.gather(1, queue.which[cut].expand(len(values), -1))
            self.maps[at : at + len(values)].scatter_(1, slots.expand(len(values), -1), new)
            at += len(values)
        fresh = queue.start.new_tensor([float("inf"), 1.0, 0.0, float(ACTIVE)])
        state = torch.cat([queue.start[:, cut], fresh[:, None].expand(-1, len(slots))])
        self.state[: self.layout.head].scatter_(1, slots.expand(len(state), -1), state)
        self.entry.scatter_(0, slots, torch.arange(first, first + len(slots), device=slots.device))

    def harvest(self, at: Tensor, ends: Ends) -> Float[Tensor, "some"]:
        """Write the results of slots `at` to their entries and empty them; returns their iterations."""
        layout, entry = self.layout, self.entry[at]
        state = self.state[: layout.head].gather(1, at.expand(layout.head, -1))
        ends.local.scatter_(1, entry.expand(layout.unknowns, -1), state[layout.place])
        ends.cost.scatter_(0, entry, state[layout.cost])
        ends.status.scatter_(0, entry, state[layout.status].to(torch.int8))
        self.state[layout.status].index_fill_(0, at, float(EMPTY))
        return state[layout.count]

    def narrowed(self, slots: Tensor, size: int) -> Block:
        """A smaller block with only `slots`."""
        small = Block(size, len(self.maps), self.layout, self.maps)
        small.state[:, : len(slots)] = self.state[:, slots]
        small.maps[:, : len(slots)] = self.maps[:, slots]
        small.entry[: len(slots)] = self.entry[slots]
        return small


def run_through(
    kernel: Callable[[Tensor, Tensor], Tensor], queue: Queue, ends: Ends, layout: Layout, size: int, small: int
) -> tuple[int, int]:
    """Fill `ends` with the results of a queue's entries; returns their iterations, all together and at most.

    Args:
        kernel: (state, maps) of a block to its state some iterations on.
        queue: the entries.
        ends: of as many entries.
        layout: of the state.
        size: slots.
        small: slots of the block for what is left at the end; `size` for none.
    """
    entries = queue.start.shape[1]
    slots = Block(size, sum(len(values) for values in queue.maps), layout, queue.start)
    following, total, longest = min(size, entries), 0, 0
    slots.put(torch.arange(following, device=queue.start.device), queue, 0)
    while True:
        slots.state = kernel(slots.state, slots.maps)
        status = slots.state[layout.status]
        finished = status != ACTIVE
        number, left = int(finished.sum()), entries - following
        if number < size and number * REFILL < size:
            continue
        at = (finished & (status != EMPTY)).nonzero()[:, 0]
        if len(at):
            count = slots.harvest(at, ends)
            total, longest = total + int(count.sum()), max(longest, int(count.max()))
        new = at[:left] if left else at[:0]
        if len(new):
            slots.put(new, queue, following)
            following += len(new)
        elif left == 0:
            active = (slots.state[layout.status] == ACTIVE).nonzero()[:, 0]
            if len(active) == 0:
                break
            if len(active) <= small < size:
                size = small
                slots = slots.narrowed(active, size)
    return total, longest
