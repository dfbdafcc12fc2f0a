"""Every pixel's own minimum, the globals held: a block of slots that a queue keeps full.

A few stragglers would keep a chunk alive long after the others are done; so the slots of finished pixels are given to
the next ones, and what is left at the end moves to a smaller block. Which slot a pixel gets, and beside whom, makes
no difference to its result.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int, Int8
from torch import Tensor

from reflectsep.kernel.compiling import Speed, accelerated, side_by_side
from reflectsep.kernel.problem import Lobe, PixelProblem, pack_constants
from reflectsep.kernel.step import (
    ACTIVE,
    COST,
    COUNT,
    EMPTY,
    PLACE,
    STATE_ROWS,
    STATUS,
    Stop,
    two_iterations,
)

BLOCK = 1 << 14
SMALL_BLOCK = 1 << 11
REFILL = 8
"""Slots are given on once a REFILL-th of the block is finished."""


@dataclass(frozen=True, kw_only=True)
class PixelSolution:
    """Where every pixel ended."""

    local: Float[Tensor, "4 pixels"]
    cost: Float[Tensor, "pixels"]
    status: Int8[Tensor, "pixels"]
    """CONVERGED, EXHAUSTED or FAILED of `kernel.step`."""
    iterations: int
    """Of all pixels together."""

    def at(self, part: slice) -> PixelSolution:
        """Views of some of the pixels."""
        return replace(self, local=self.local[:, part], cost=self.cost[part], status=self.status[part])


Kernel = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Queue:
    """What is to be solved: entry i starts pixel `which[i]` (pixel i) at `start[:, i]`."""

    start: Float[Tensor, "4 entries"]
    which: Int[Tensor, "entries"] | None


class Block:
    """Slots with the state and the data of the pixels in them."""

    def __init__(self, size: int, rows: int, like: Tensor) -> None:
        self.state = like.new_zeros(STATE_ROWS, size)
        self.state[STATUS] = float(EMPTY)
        self.maps = like.new_zeros(rows, size)
        self.entry = torch.zeros(size, dtype=torch.int64, device=like.device)

    def put(self, slots: Tensor, problem: PixelProblem, queue: Queue, first: int) -> None:
        """Entries first, first + 1, ... of the queue into `slots`."""
        # By scatter_ and gather: advanced indexing takes four times as long.
        cut, at = slice(first, first + len(slots)), 0
        for values in problem.maps:
            new = values[:, cut] if queue.which is None else values.gather(1, queue.which[cut].expand(len(values), -1))
            self.maps[at : at + len(values)].scatter_(1, slots.expand(len(values), -1), new)
            at += len(values)
        fresh = queue.start.new_tensor([float("inf"), 1.0, 0.0, float(ACTIVE)])
        state = torch.cat([queue.start[:, cut], fresh[:, None].expand(-1, len(slots))])
        self.state[: STATUS + 1].scatter_(1, slots.expand(len(state), -1), state)
        self.entry.scatter_(0, slots, torch.arange(first, first + len(slots), device=slots.device))

    def narrowed(self, slots: Tensor, size: int) -> Block:
        """A smaller block with only `slots`."""
        small = Block(size, len(self.maps), self.maps)
        small.state[:, : len(slots)] = self.state[:, slots]
        small.maps[:, : len(slots)] = self.maps[:, slots]
        small.entry[: len(slots)] = self.entry[slots]
        return small


def solve_pixels(
    problem: PixelProblem,
    start: Float[Tensor, "4 pixels"],
    lobe: Lobe,
    stop: Stop = Stop(),  # noqa: B008  (frozen)
    *,
    speed: Speed = Speed(),  # noqa: B008  (frozen)
    which: Int[Tensor, "entries"] | None = None,
    block: int = BLOCK,
) -> PixelSolution:
    """Minimise every pixel's cost over (d_1, d_2, d_3, log B) from `start` (Eqs. 20 to 22).

    Args:
        problem: pictures and what is known, channel first, all of one dtype and device.
        start: must be finite; a pixel whose cost is not finite there ends FAILED, at its start.
        lobe: the globals, held.
        stop: when a pixel is finished.
        speed: whether to compile.
        which: the pixel of every start, where it is not one start a pixel.
        block: slots, rounded up to a multiple of 64.

    Returns:
        Places, costs and how each pixel ended; independent of the block's size and of the pixels' order.
    """
    entries = start.shape[1]
    found = PixelSolution(
        local=start.clone(),
        cost=start.new_full((entries,), float("inf")),
        status=torch.full((entries,), EMPTY, dtype=torch.int8, device=start.device),
        iterations=0,
    )

    def work(part: slice) -> int:
        own = problem.take(part) if which is None else problem
        queue = Queue(start[:, part], None if which is None else which[part])
        return _solve_queue(own, queue, lobe, stop, speed, block, found.at(part))

    total = sum(side_by_side(work, speed.parts(entries)))
    return replace(found, iterations=total)


def _solve_queue(
    problem: PixelProblem, queue: Queue, lobe: Lobe, stop: Stop, speed: Speed, block: int, found: PixelSolution
) -> int:
    """Fill `found` with the results of a queue's entries; returns their iterations."""
    start, local, cost, status = queue.start, found.local, found.cost, found.status
    pixels, form = start.shape[1], problem.form(lobe.n_d)
    constants = pack_constants(problem, lobe)
    kernel = accelerated(two_iterations, (form, stop), pixels, speed, problem.images)
    size = speed.block(pixels, block, problem.images)
    slots = Block(size, form.rows, problem.images)
    slots.put(torch.arange(min(size, pixels), device=start.device), problem, queue, 0)
    following, total = min(size, pixels), 0
    while True:
        slots.state = kernel(slots.state, slots.maps, constants)
        finished = slots.state[STATUS] != ACTIVE
        number = int(finished.sum())
        left = pixels - following
        if number < size and number * REFILL < size:
            continue
        at = (finished & (slots.state[STATUS] != EMPTY)).nonzero()[:, 0]
        if len(at):
            total += harvest(slots, at, local, cost, status)
        new = at[:left] if left else at[:0]
        if len(new):
            slots.put(new, problem, queue, following)
            following += len(new)
        elif left == 0:
            active = (slots.state[STATUS] == ACTIVE).nonzero()[:, 0]
            if len(active) == 0:
                break
            if len(active) <= SMALL_BLOCK < size:
                size = SMALL_BLOCK
                slots = slots.narrowed(active, size)
    return total


def harvest(slots: Block, at: Tensor, local: Tensor, cost: Tensor, status: Tensor) -> int:
    """Write the results of slots `at` to their pixels and empty them; returns their iterations."""
    entry, state = slots.entry[at], slots.state[: STATUS + 1].gather(1, at.expand(STATUS + 1, -1))
    local.scatter_(1, entry.expand(4, -1), state[PLACE])
    cost.scatter_(0, entry, state[COST])
    status.scatter_(0, entry, state[STATUS].to(torch.int8))
    slots.state[STATUS].index_fill_(0, at, float(EMPTY))
    return int(state[COUNT].sum())
