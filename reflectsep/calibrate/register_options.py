"""How two pictures are registered."""

from __future__ import annotations

from dataclasses import dataclass

from reflectsep.calibrate.motion import MODELS, Model


@dataclass(frozen=True, kw_only=True)
class RegisterOptions:
    """How two pictures are registered."""

    models: tuple[Model, ...] = MODELS
    blur_px: float = 0.8
    """Of both pictures before they are compared: interpolation and noise weigh less."""
    levels: int = 4
    """Halvings at most."""
    iterations: int = 30
    tiles: int = 8
    """Along each side, for the evidence and the standard deviation."""
    evidence: float = 3.5
    """x of the bound P(chi^2_k >= k + 2 sqrt(k x) + 2 x) <= exp(-x) that a richer model must pass."""
    unseen: float = 2.0
    """Standard errors by which a motion must predict better what it was not fitted to."""
    floor_px: float = 0.01
    """Systematic error of a motion (interpolation) that is always allowed for."""
    most_pixels: int = 150_000
    """Larger pictures are halved until they are no larger; a twentieth of a pixel is seen there too."""
    noise_floor: float = 1e-3
    """Least residual, as a share of the picture's bright end, that is told from agreement."""
    drift: bool = False
    """Whether slow drift along `time` may be found besides."""
