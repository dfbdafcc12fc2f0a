"""Every pixel's own minimum, the globals held."""

from __future__ import annotations

from dataclasses import dataclass, replace

from jaxtyping import Float, Int, Int8
from torch import Tensor

from reflectsep.kernel.compiling import Speed, accelerated, side_by_side
from reflectsep.kernel.problem import Lobe, PixelProblem, pack_constants
from reflectsep.kernel.queue import Ends, Queue, run_through
from reflectsep.kernel.step import FOUR, Stop, two_iterations

BLOCK = 1 << 14
SMALL_BLOCK = 1 << 11


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
    ends = Ends.of(start)
    form = problem.form(lobe.n_d)

    def work(part: slice) -> int:
        own = problem.take(part) if which is None else problem
        queue = Queue(own.maps, start[:, part], None if which is None else which[part])
        entries = queue.start.shape[1]
        step = accelerated(two_iterations, (form, stop), entries, speed, start)
        constants, size = pack_constants(own, lobe), speed.block(entries, block, start)
        return run_through(lambda s, m: step(s, m, constants), queue, ends.at(part), FOUR, size, SMALL_BLOCK)[0]

    total = sum(side_by_side(work, speed.parts(start.shape[1])))
    return PixelSolution(local=ends.local, cost=ends.cost, status=ends.status, iterations=total)
