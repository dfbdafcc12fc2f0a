"""The value that the steps of a fit hand on."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.fit.problem import Observations, Priors
from reflectsep.fit.solution import Effort, LocalFit
from reflectsep.solve.joint import JointSolution


@dataclass(frozen=True, kw_only=True)
class State:
    """A fit under way."""

    obs: Observations
    priors: Priors
    mask: Bool[Tensor, "height width"]
    effort: Effort
    robust: float | None
    sigma: float
    shared: Float[Tensor, "G"]
    free: Bool[Tensor, "G"]
    body: Float[Tensor, "pixels channels 3"]
    """Robust whole diffuse root, from before any lobe was fitted."""
    found: LocalFit
    joint: JointSolution | None = None
    scales: tuple[tuple[float, float], ...] = ()
    """Neighbourhoods that had a say in the lobes: width and spread."""
