"""One Levenberg-Marquardt iteration of every pixel of a block, each by its own clock.

The state holds cost, gradient and matrix at the present place, so that an iteration evaluates once, at the trial
place, and then selects. A pixel that has just come in has cost infinity: its step is zero and its trial is the start.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from reflectsep.kernel.linear import factorise, scales, solve
from reflectsep.kernel.problem import Bounds, Constants, Data, Form, quadratic, read_constants, read_data

ACTIVE, CONVERGED, EXHAUSTED, FAILED, EMPTY = range(5)
"""Status of a slot; FAILED: not finite at its start."""
PLACE, COST, DAMPING, COUNT, STATUS, MATRIX, GRADIENT = slice(0, 4), 4, 5, 6, 7, slice(8, 18), slice(18, 22)
STATE_ROWS = 22
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-9, 1e9
SOFTEN, HARDEN = 0.2, 5.0


@dataclass(frozen=True, kw_only=True)
class Stop:
    """When a pixel is finished."""

    tolerance: float = 1e-6
    """Of the relative decrease of the cost that the next step promises."""
    floor: float = 1e-12
    """Costs below this count as zero."""
    max_iterations: int = 50


def pinned(x: Sequence[Tensor], g: list[Tensor], V: list[Tensor], bounds: Bounds) -> tuple[list[Tensor], list[Tensor]]:
    """G and V with unknowns that press against their bound taken out of the system."""
    g, V = list(g), list(V)
    borders = ((1, 2, 3), (1, 5, 6), (2, 5, 8), (3, 6, 8))
    for k in range(4):
        low, high = bounds.lower[k], bounds.upper[k]
        if low == -float("inf") and high == float("inf"):
            continue
        held = ((x[k] <= low) & (g[k] > 0)) | ((x[k] >= high) & (g[k] < 0))
        g[k] = torch.where(held, 0.0, g[k])
        for at in borders[k]:
            V[at] = torch.where(held, 0.0, V[at])
    return g, V


def iterate(state: list[Tensor], data: Data, constants: Constants, form: Form, stop: Stop) -> list[Tensor]:
    """The state one iteration on; finished pixels stay as they are."""
    here, cost, mu, count, status = state[PLACE], state[COST], state[DAMPING], state[COUNT], state[STATUS]
    fresh = cost == float("inf")
    g, V = pinned(here, state[GRADIENT], state[MATRIX], form.bounds)
    scale = scales(V)
    x = solve(factorise(V, [mu * s for s in scale]), g)
    # -g.step - step V step / 2 for (V + mu D) step = -g
    promised = 0.5 * sum(x[k] * (g[k] + mu * scale[k] * x[k]) for k in range(4))
    trial = []
    for k in range(4):
        place = torch.where(fresh, here[k], here[k] - x[k])
        low, high = form.bounds.lower[k], form.bounds.upper[k]
        trial.append(place if (low, high) == (-float("inf"), float("inf")) else place.clamp(low, high))
    new = quadratic(trial, data, constants, form)
    better = new.cost < cost
    active = status == ACTIVE
    moves = better & active
    mu = torch.where(fresh, FIRST_DAMPING, torch.where(better, (mu * SOFTEN).clamp_min(LEAST_DAMPING), mu * HARDEN))
    count = count + torch.where(active & ~fresh, 1.0, 0.0)
    done = (promised <= stop.tolerance * cost + stop.floor) | (mu > MOST_DAMPING)
    end = torch.where(count >= stop.max_iterations, float(EXHAUSTED), float(ACTIVE))
    end = torch.where(done, float(CONVERGED), end)
    end = torch.where(fresh, torch.where(better, float(ACTIVE), float(FAILED)), end)
    choose = lambda a, b: torch.where(moves, a, b)  # noqa: E731
    return [
        *(choose(t, old) for t, old in zip(trial, here, strict=True)),
        choose(new.cost, cost),
        mu,
        count,
        torch.where(active, end, status),
        *(choose(n, old) for n, old in zip(new.V, state[MATRIX], strict=True)),
        *(choose(n, old) for n, old in zip(new.gradient, state[GRADIENT], strict=True)),
    ]


def two_iterations(state: Tensor, maps: Tensor, packed: Tensor, form: Form, stop: Stop) -> Tensor:
    """(STATE_ROWS, block) and (rows, block) to the state two iterations on: halves what a call costs."""
    data, constants = read_data(maps.unbind(0), form), read_constants(packed, form)
    rows = list(state.unbind(0))
    for _ in range(2):
        rows = iterate(rows, data, constants, form, stop)
    return torch.stack(rows)
