"""The damped step of every pixel from the parts of its matrix, which is never put together.

In the symbols of `fit/lines.py`: s_c is eliminated for itself, three unknowns with eight right sides, and what is left,
of d and log B, is small:

    D'_c = D_c - X_c^T S_c^-1 X_c,    N'_c = N_c - X_c^T S_c^-1 N_c,    T' = T - sum_c N_c S_c^-1 N_c

    d_c with d_e     [c = e] D'_c + B / C (N'_c + N'_e^T) + (B / C)^2 T' + e e^T
    d_c with log B   N'_c z + B / C T' z + w e          log B with log B   z^T T' z + w^2

q q^T, which alone would fill the matrix, comes back by the formula of Sherman and Morrison. In colour the matrix is
one of 10 x 10 instead of 19 x 19.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from reflectsep.fit.lines import (
    AT,
    Line,
    Place,
    Square,
    System,
    Triple,
    added,
    dot,
    over_channels,
    times,
    transposed_times,
)
from reflectsep.kernel.linear import factorise, solve

LEAST = 1e-12
"""Of the sum of the diagonal: an unknown that nothing feels must not make the system singular."""


@dataclass(frozen=True)
class Vector:
    """A number for every unknown of a pixel."""

    d: Triple
    s: Triple
    """Empty where s is held."""
    log_B: Line  # noqa: N815

    def __mul__(self, other: Vector) -> Line:
        """Inner product."""
        parts = [over_channels(dot(self.d, other.d)), self.log_B * other.log_B]
        return added([*parts, over_channels(dot(self.s, other.s))] if self.s else parts)

    def map(self, function: Callable[..., Line], *others: Vector) -> Vector:
        """`function` of every number, with those of the others."""
        parts = zip(*((v.d, v.s) for v in (self, *others)), strict=True)
        d, s = ([function(*k) for k in zip(*part, strict=True)] for part in parts)
        return Vector(d, s, function(self.log_B, *(v.log_B for v in others)))

    def rows(self) -> Tensor:
        """In the solver's order, (P, pixels)."""
        each = lambda part: torch.stack(list(part), 1).flatten(0, 1)  # noqa: E731
        return torch.cat([each(self.d), self.log_B[None], *([each(self.s)] if self.s else [])])


def damped_step(system: System, at: Place, mu: Line, w: Line) -> tuple[Vector, Line]:
    """-(V + mu diag V)^-1 gradient, and by how much the undamped model says that it lowers the cost.

    `w` is the weight of the row shape.
    """
    by_d = [k + at.share * z + e * system.shape for k, z, e in zip(system.by_d, system.by_z, system.e, strict=True)]
    own = Vector(by_d, system.by_s, dot(system.by_z, at.z) + w * system.shape)
    tie = Vector(system.tie_d, system.tie_s, torch.zeros_like(at.share))
    scale = scale_of(system, at, tie, w)
    x, y = eliminated(system, at, scale.map(lambda k: mu * k), w)
    # V is what was eliminated and tie tie^T, and the gradient is `own` and `ratio` times tie.
    back = (system.ratio - tie * x) / (1.0 + tie * y)
    step = x.map(lambda a, b: -(a + back * b), y)
    gradient = own.map(lambda a, b: a + system.ratio * b, tie)
    return step, 0.5 * (step * step.map(lambda k, g, h: mu * h * k - g, gradient, scale))


def scale_of(system: System, at: Place, tie: Vector, w: Line) -> Vector:
    """The diagonal as damping sees it."""
    on = lambda matrix: [matrix[AT[k][k]] for k in range(3)]  # noqa: E731
    by_z = [at.share * (2.0 * N + at.share * T) for N, T in zip(on(system.N), on(system.T), strict=True)]
    d = [a + b + e * e + q * q for a, b, e, q in zip(on(system.D), by_z, system.e, tie.d, strict=True)]
    s = [a + q * q for a, q in zip(on(system.S), tie.s, strict=True)] if tie.s else []
    log_B = dot(times(system.T, at.z), at.z) + w * w
    least = LEAST * added([over_channels(added([*d, *s])), log_B]) + 1e-30
    return Vector(d, s, log_B).map(lambda k: torch.maximum(k, least))


@dataclass(frozen=True)
class Reduced:
    """What s leaves of the system once it is eliminated: D', N' and T', and the right sides."""

    D: Square
    N: Sequence[Triple]
    T: Square
    sides: Sequence[tuple[Triple, Triple]]
    """By d_c, but for what goes by way of z, and by z: those of the gradient and of q."""
    by_X: Sequence[Triple] = ()  # noqa: N815
    by_N: Sequence[Triple] = ()  # noqa: N815
    by_side: Sequence[Triple] = ()
    """S_c^-1 X_c and S_c^-1 N_c, column by column, and S_c^-1 of the right sides."""

    def s(self, side: int, d: Triple, moved: Triple) -> list[Line]:
        """The solution's s, given its d and by how much that moves z."""
        if not self.by_side:
            return []
        back = zip(self.by_side[side], transposed_times(self.by_X, d), transposed_times(self.by_N, moved), strict=True)
        return [own - by_d - by_z for own, by_d, by_z in back]


def without_s(system: System, damping: Triple) -> Reduced:
    """s_c eliminated, if it is free."""
    zero = torch.zeros_like(system.ratio)
    N, sides = [[system.N[AT[i][k]] for k in range(3)] for i in range(3)], (system.by_z, [zero] * 3)
    of_d = (system.by_d, system.tie_d)
    if not system.S:
        return Reduced(system.D, N, system.T, list(zip(of_d, sides, strict=True)))
    X = [[row[k] for row in system.X] for k in range(3)]
    factor = factorise(system.S, damping)
    by_X, by_N = [solve(factor, column) for column in X], [solve(factor, row) for row in N]
    by_side = [solve(factor, side) for side in (system.by_s, system.tie_s)]
    upper = [(i, k) for i in range(3) for k in range(i, 3)]
    return Reduced(
        D=[system.D[AT[i][k]] - dot(X[i], by_X[k]) for i, k in upper],
        N=[[N[i][k] - dot(X[i], by_N[k]) for k in range(3)] for i in range(3)],
        T=[system.T[AT[i][k]] - over_channels(dot(N[i], by_N[k])) for i, k in upper],
        sides=[
            (
                [d[k] - dot(X[k], solved) for k in range(3)],
                [z[k] - over_channels(dot(N[k], solved)) for k in range(3)],
            )
            for d, z, solved in zip(of_d, sides, by_side, strict=True)
        ],
        by_X=by_X,
        by_N=by_N,
        by_side=by_side,
    )


def eliminated(system: System, at: Place, damping: Vector, w: Line) -> tuple[Vector, Vector]:
    """The solutions for the gradient and for q as right sides, of all but the row ratio."""
    reduced, share, z = without_s(system, damping.s), at.share, at.z
    factor = factorise(put_together(reduced, at, system.e, w), [*in_order(damping.d), damping.log_B])
    results, shapes = [], (system.shape, torch.zeros_like(share))
    for i, ((by_d, by_z), shape) in enumerate(zip(reduced.sides, shapes, strict=True)):
        whole = [own + (share * on_z + k * shape) for own, on_z, k in zip(by_d, by_z, system.e, strict=True)]
        solved = solve(factor, [*in_order(whole), dot(by_z, z) + w * shape])
        d, log_B = [torch.stack(solved[k:-1:3]) for k in range(3)], solved[-1]
        moved = [share * over_channels(d[k]) + z[k] * log_B for k in range(3)]
        results.append(Vector(d, reduced.s(i, d, moved), log_B))
    return results[0], results[1]


def in_order(lines: Triple) -> list[Line]:
    """Lines of all channels as one a number, in the solver's order."""
    return [line for channel in zip(*(k.unbind(0) for k in lines), strict=True) for line in channel]


def put_together(reduced: Reduced, at: Place, e: Triple, w: Line) -> list[Line]:
    """The matrix of d and log B, the upper triangle row by row."""
    share, z, T = at.share, at.z, reduced.T
    turned = times(T, z)
    common = [[share * share * T[AT[i][k]] + e[i] * e[k] for k in range(3)] for i in range(3)]
    moved = [[(share * k).unbind(0) for k in row] for row in reduced.N]
    own = [k.unbind(0) for k in reduced.D]
    border = [(dot(reduced.N[i], z) + (share * turned[i] + w * e[i])).unbind(0) for i in range(3)]
    unknowns, entries = [(c, i) for c in range(len(own[0])) for i in range(3)], []
    for row, (c, i) in enumerate(unknowns):
        for b, k in unknowns[row:]:
            entry = moved[i][k][c] + moved[k][i][b] + common[i][k]
            entries.append(entry + own[AT[i][k]][c] if b == c else entry)
        entries.append(border[i][c])
    return [*entries, dot(turned, z) + w * w]
