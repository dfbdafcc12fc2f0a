"""How a capture is aligned, and from when on a motion is undone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from torch import Tensor
from torch.nn.functional import max_pool2d

from reflectsep.calibrate.motion import MODELS, Model, Motion, displacement
from reflectsep.calibrate.register import Registration

LEAST_PX = 0.05
"""Motions smaller than this are left alone: resampling would cost more than they do."""
MARGIN_PX = 6
"""Of background round the object that counts, and no less than the motion that is looked for."""


@dataclass(frozen=True, kw_only=True)
class AlignOptions:
    """How a capture is aligned."""

    scope: Literal["all", "same_light"] = "all"
    """`same_light`: sweeps against full pictures alone."""
    richest: Model = "homography"
    """The richest model that the evidence may choose."""
    n_d: float = 1.0
    """Exponent of the roots that are summed; 1 in linear light."""

    @property
    def models(self) -> tuple[Model, ...]:
        """Models to choose from."""
        return MODELS[: MODELS.index(self.richest) + 1]


def judged(found: Registration, mask: Tensor) -> Motion:
    """The motion as it is used: not at all where it is below what resampling is worth."""
    still = displacement(found.matrix, mask)
    drift = (found.velocity[0] ** 2 + found.velocity[1] ** 2) ** 0.5
    whole = (still**2 + drift**2 / 3) ** 0.5
    motion = Motion(
        matrix=found.matrix,
        model=found.model + (" and drift" if drift > 0 else ""),
        velocity=found.velocity,
        displacement_px=whole,
        sd_px=found.sd_px,
        trust=found.trust,
        gain=found.gain,
    )
    if found.model == "identity" and drift == 0:
        return replace(motion, reason="no motion beyond chance")
    if whole < LEAST_PX:
        return replace(motion, reason=f"below {LEAST_PX:g} px")
    agreement = f"unseen pixels agree {100 * found.gain_in_agreement:.0f} % better ({found.significance:.1f} sd)"
    return replace(motion, applied=True, reason=agreement)


def grown(mask: Tensor, pixels: int) -> Tensor:
    """The mask and what lies within so many pixels of it."""
    return max_pool2d(mask[None, None].float(), 2 * pixels + 1, stride=1, padding=pixels)[0, 0] > 0
