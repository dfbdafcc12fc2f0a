"""The solver of all pixels under held globals as one compiled loop: `solve/local.py` where a fit is large enough.

It takes the same steps, on the same numbers but for rounding, from five to ten times as fast. What a run pays for it,
half a minute or more, is spent once a machine and kind of capture (number of lights, channels), for the compiled loop
is kept on disk.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.fit.elimination import damped_step
from reflectsep.fit.lines import (
    Form,
    form_of,
    linearised,
    pack_constants,
    pack_data,
    pack_system,
    read_constants,
    read_data,
    read_place,
    read_system,
)
from reflectsep.fit.problem import Observations, Priors
from reflectsep.kernel.compiling import Speed, accelerated, side_by_side
from reflectsep.kernel.queue import Ends, Queue, run_through
from reflectsep.kernel.step import ACTIVE, CONVERGED, EXHAUSTED, FAILED, LEAST_DAMPING, MOST_DAMPING, Layout
from reflectsep.solve.local import WORSE, LocalSolution, Termination, relaxed

SLOTS = 1 << 8
"""Pixels under way: few enough for their state to stay in the cache."""
FIRST_DAMPING = 1e-4


def layout_of(form: Form) -> Layout:
    """Of the state of a block."""
    return Layout(form.unknowns, form.system)


def one_iteration(state: Tensor, maps: Tensor, packed: Tensor, form: Form) -> Tensor:
    """(rows of the state, block) and (rows, block) to the state an iteration on: that of `solve_local`."""
    layout, (tolerance, floor, most) = layout_of(form), packed[-3:].unbind(0)
    data, constants = read_data(maps, form), read_constants(packed[:-3], form)
    place, cost, mu = state[layout.place], state[layout.cost], state[layout.damping]
    count, status, known = state[layout.count], state[layout.status], state[layout.head :]
    fresh, active = cost == torch.inf, status == ACTIVE

    here = read_place(place, data, form)
    step, promised = damped_step(read_system(known, form), here, mu, constants.shape)
    trial = torch.where(fresh, place, place + step.rows())
    new_cost, system = linearised(read_place(trial, data, form), data, constants, form)
    better = new_cost < cost
    moves = better & active

    gain = (cost - new_cost) / promised.clamp_min(torch.finfo(cost.dtype).tiny)
    mu = torch.where(fresh, FIRST_DAMPING, mu * torch.where(better, relaxed(gain), WORSE))
    done = (promised <= tolerance * cost + floor) | (mu > MOST_DAMPING)
    count = count + torch.where(active & ~fresh, 1.0, 0.0)
    end = torch.where(count >= most, float(EXHAUSTED), float(ACTIVE))
    end = torch.where(done, float(CONVERGED), end)
    end = torch.where(fresh, torch.where(better, float(ACTIVE), float(FAILED)), end)
    head = [torch.where(moves, new_cost, cost), mu.clamp_min(LEAST_DAMPING), count, torch.where(active, end, status)]
    after = torch.where(moves, pack_system(system, form), known)
    return torch.cat([torch.where(moves, trial, place), torch.stack(head), after])


def solve_fused(
    local: Float[Tensor, "pixels P"],
    shared: Float[Tensor, "G"],
    obs: Observations,
    priors: Priors,
    robust: float | None,
    termination: Termination,
    speed: Speed,
) -> LocalSolution:
    """`solve_local` of these pixels; where each ends depends neither on the others nor on their number."""
    form, start = form_of(obs, shared), local.T.contiguous()
    ends_of = shared.new_tensor([termination.tolerance, termination.floor, termination.max_iterations])
    packed = torch.cat([pack_constants(obs, priors, shared, robust), ends_of])
    step, ends = accelerated(one_iteration, (form,), len(local), speed, local), Ends.of(start)
    maps = pack_data(obs, priors, shared)

    def work(part: slice) -> int:
        queue = Queue([maps[:, part]], start[:, part])
        return run_through(lambda s, m: step(s, m, packed), queue, ends.at(part), layout_of(form), SLOTS, SLOTS)[1]

    longest = max(side_by_side(work, speed.parts(len(local))))
    return LocalSolution(
        local=ends.local.T.contiguous(), cost=ends.cost, converged=ends.status == CONVERGED, iterations=longest
    )
