"""Strengths of lights whose directions are known, jointly from the pictures.

Alpha from the pictures holds intensities (Eq. 15): t_j L_j = sum_i alpha_ij t_i L_i for unit directions L. Three linear
equations a light in the strengths t of all; their scale is free, so t_1 = 1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.data import Vector
from reflectsep.errors import LightError


def joint_intensities(
    names: Sequence[str], directions: Mapping[str, Vector], alpha: Float[Tensor, "lights 3"]
) -> tuple[dict[str, float], float]:
    """Strengths by light, the first 1, and what they leave unexplained.

    Args:
        names: of the lights, the basis first; four or more.
        directions: unit vectors of all of them.
        alpha: from the pictures; rows 0 to 2 are the identity.

    Returns:
        Strengths, and the RMS of the equations' residual over the mean strength.

    Raises:
        LightError: fewer than four lights, or directions that contradict the pictures (a strength below zero).
    """
    if len(names) < 4:
        raise LightError(f"intensities: {len(names)} lights, expected 4 or more to compare strengths")
    unit = torch.tensor([directions[name] for name in names], dtype=torch.float64)
    unit = unit / unit.norm(dim=1, keepdim=True)
    rows = torch.zeros(len(names) - 3, 3, len(names), dtype=torch.float64)
    for j in range(3, len(names)):
        rows[j - 3, :, j] = unit[j]
        rows[j - 3, :, :3] -= (alpha[j].double()[:, None] * unit[:3]).mT
    _, values, axes = torch.linalg.svd(rows.reshape(-1, len(names)))
    strengths = axes[-1] / axes[-1][0]
    if not bool((strengths > 0).all()):
        worst = names[int(strengths.argmin())]
        raise LightError(f"intensities: light {worst} would be negative; its direction contradicts the pictures")
    del values
    residual = rows.reshape(-1, len(names)) @ strengths
    return dict(zip(names, strengths.tolist(), strict=True)), float(residual.square().mean().sqrt() / strengths.mean())
