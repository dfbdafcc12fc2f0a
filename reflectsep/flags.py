"""Quality bits: every pixel that is not simply good can name its reasons."""

from collections.abc import Mapping
from enum import IntFlag

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor


class Flag(IntFlag):
    """One bit a reason; a good pixel has none."""

    OUTSIDE_MASK = 1 << 0
    """Not on the object; parameters are zero there."""
    SATURATED = 1 << 1
    """Clipped in at least one full picture; those values enter the fit as lower bounds."""
    INVALID_INPUT = 1 << 2
    """Not a finite number in at least one picture; the pixel is not fitted."""
    HOLE_FILLED = 1 << 3
    """Part of its scattering was filled in, not measured (every pixel that a slab lit)."""
    NO_SWEEP_COVERAGE = 1 << 4
    """At least one sweep never lit it: its scattering is a lower bound."""
    SWEEP_SATURATED = 1 << 5
    """Clipped in slab frames other than those that light it."""
    FAINT_LOBE = 1 << 6
    """The highlight never rises above the noise: B comes from the prior."""
    NOT_CONVERGED = 1 << 7
    """The solver stopped at its iteration limit."""
    AMBIGUOUS = 1 << 8
    """Two solutions of nearly equal cost; only results of versions before 0.2 have it."""
    ATTACHED_SHADOW = 1 << 9
    """Faces away from at least one basis light (d < 0 there)."""
    SHADOW_OR_OUTLIER = 1 << 10
    """At least one picture disagrees beyond noise and was weighed down (cast shadow, inter-reflection)."""
    UNDEREXPOSED = 1 << 11
    """Below the noise floor in every basis picture."""
    MOVED_OUT = 1 << 12
    """Outside the frame of at least one picture once the camera's drift is undone; the pixel is not fitted."""
    FAILED = 1 << 13
    """The solver found no finite cost, or no step that lowers it."""


WORDS: Mapping[str, str] = {
    "OUTSIDE_MASK": "not on the object",
    "SATURATED": "clipped in at least one picture",
    "INVALID_INPUT": "not a number in at least one picture",
    "HOLE_FILLED": "its scattering was partly filled in where the slab lit it",
    "NO_SWEEP_COVERAGE": "a sweep never lit it: its scattering is a lower bound",
    "SWEEP_SATURATED": "clipped in slab frames",
    "FAINT_LOBE": "no highlight seen here: B comes from the prior",
    "NOT_CONVERGED": "the solver stopped at its limit",
    "AMBIGUOUS": "two solutions of nearly equal cost",
    "ATTACHED_SHADOW": "faces away from a basis light",
    "SHADOW_OR_OUTLIER": "a picture disagrees here: cast shadow or inter-reflection",
    "UNDEREXPOSED": "below the noise in every basis picture",
    "MOVED_OUT": "out of the frame of a picture once the camera's drift is undone",
    "FAILED": "the solver failed here",
}
"""What each flag means, for people."""


def decode(value: int) -> list[str]:
    """Names of the bits set in `value`, lowest first.

    Raises:
        ValueError: `value` has a bit that no flag names.
    """
    return [str(flag.name) for flag in Flag if flag & Flag(value)]


def count(flags: Int[Tensor, "height width"]) -> dict[str, int]:
    """Number of pixels that carry each flag, every flag named, absent ones as 0."""
    bits = flags.detach().cpu().to(torch.int64).numpy()
    return {str(flag.name): int(np.count_nonzero(bits & flag.value)) for flag in Flag}


def mark(flags: Int[Tensor, "height width"], where: Tensor, flag: Flag) -> Int[Tensor, "height width"]:
    """`flags` with `flag` added at the true pixels of `where` (height, width)."""
    return torch.where(where, flags | int(flag), flags)
