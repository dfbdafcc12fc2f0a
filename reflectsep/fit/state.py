"""Where a fit is: the problem as it stands, and what has been found of it."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from reflectsep.fit.neighbours import Smoothness
from reflectsep.fit.problem import PixelProblem
from reflectsep.fit.sample import Sample
from reflectsep.solve.joint import JointSolution


@dataclass(frozen=True)
class Sampled:
    """The sample that the globals were fitted to, and its pixels' unknowns."""

    chosen: Sample
    problem: PixelProblem
    local: Float[Tensor, "P pixels"]


@dataclass(frozen=True, kw_only=True)
class State:
    """The fit between two of its stages."""

    problem: PixelProblem
    mask: Bool[Tensor, "height width"]
    """The pixels that are fitted."""
    shared: Float[Tensor, "G"]
    free: Bool[Tensor, "G"]
    smooth: Smoothness | None
    local: Float[Tensor, "P pixels"]
    peak: float
    """The brightest values of the pictures."""
    cost: Float[Tensor, "pixels"] | None = None
    status: Int[Tensor, "pixels"] | None = None
    joint: JointSolution | None = None
    sampled: Sampled | None = None
