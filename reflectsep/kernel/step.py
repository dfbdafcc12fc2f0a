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
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-9, 1e9
SOFTEN, HARDEN = 0.2, 5.0


@dataclass(frozen=True)
class Layout:
    """Rows of the state of a block."""

    unknowns: int
    system: int
    """Rows of what is known of the cost at the present place, beside its value: gradient and matrix."""

    @property
    def place(self) -> slice:
        """The unknowns."""
        return slice(0, self.unknowns)

    @property
    def cost(self) -> int:
        """At the present place."""
        return self.unknowns

    @property
    def damping(self) -> int:
        """Of the next step."""
        return self.unknowns + 1

    @property
    def count(self) -> int:
        """Iterations so far."""
        return self.unknowns + 2

    @property
    def status(self) -> int:
        """`ACTIVE` or how it ended."""
        return self.unknowns + 3

    @property
    def head(self) -> int:
        """Rows up to here are what a pixel comes and goes with; then follows the system."""
        return self.unknowns + 4

    @property
    def rows(self) -> int:
        """All of them."""
        return self.head + self.system


FOUR = Layout(4, system=14)
MATRIX, GRADIENT = slice(8, 18), slice(18, 22)


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
    here, cost, mu = state[FOUR.place], state[FOUR.cost], state[FOUR.damping]
    count, status = state[FOUR.count], state[FOUR.status]
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
    """(rows of the state, block) and (rows, block) to the state two iterations on: halves what a call costs."""
    data, constants = read_data(maps.unbind(0), form), read_constants(packed, form)
    rows = list(state.unbind(0))
    for _ in range(2):
        rows = iterate(rows, data, constants, form, stop)
    return torch.stack(rows)
