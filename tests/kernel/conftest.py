"""A surface made from the model itself, as the kernel takes it."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from reflectsep.kernel.problem import Lobe, PixelPrior, PixelProblem


@dataclass(frozen=True)
class Scene:
    problem: PixelProblem
    lobe: Lobe
    truth: Tensor
    start: Tensor


def make_scene(pixels, *, lights=6, sigma=0.0, n_d=1.0, dtype=torch.float64, extras=False, seed=0):
    """Bumpy surface under lights 15 to 30 degrees off the view; starts 15 % off the truth."""
    g = torch.Generator().manual_seed(seed)
    rand = lambda *shape: torch.rand(*shape, generator=g, dtype=torch.float64)  # noqa: E731
    normal = lambda *shape: torch.randn(*shape, generator=g, dtype=torch.float64)  # noqa: E731
    turn = 2.4 * torch.arange(lights, dtype=torch.float64) + 0.3
    tilt = torch.deg2rad(15.0 + 15.0 * ((torch.arange(lights, dtype=torch.float64) * 0.618) % 1.0))
    light = torch.stack([tilt.sin() * turn.cos(), tilt.sin() * turn.sin(), tilt.cos()], -1)
    alpha = light @ torch.linalg.inv(light[:3])
    alpha[:3] = torch.eye(3, dtype=torch.float64)
    slopes = 0.25 * normal(2, pixels)
    facing = torch.cat([slopes, torch.ones(1, pixels, dtype=torch.float64)])
    facing = facing / facing.norm(dim=0)
    q, lit = 0.25 + 0.5 * rand(pixels), (light[:3] @ facing).clamp_min(0.02)
    d, B, a = q * lit, 1.9 * facing[2] / q, -0.95 * light[:3, 2]
    s = 0.15 * lit + 0.1
    u = alpha @ (a[:, None] + B * d)
    images = (alpha @ (d + s)).clamp_min(0.0) ** n_d + u.clamp_min(0.0) ** 14
    images = images + sigma * normal(lights, pixels)
    truth = torch.cat([d, B.log()[None]])
    weight = prior = None
    if extras:
        weight = (rand(lights, pixels) > 0.1).double()
        prior = PixelPrior(
            centre=(truth + 0.01 * normal(4, pixels)).to(dtype), weight=(rand(4, pixels) * 3.0).to(dtype)
        )
        weight = weight.to(dtype)
    factor = torch.ones(lights)
    factor[3:] = 2.0
    problem = PixelProblem(
        images=images.to(dtype),
        s=(alpha @ s if extras else s).to(dtype),
        alpha=alpha.to(dtype),
        light_weight=factor.to(dtype),
        weight=weight,
        prior=prior,
    )
    start = truth + 0.15 * truth.abs() * (2.0 * rand(4, pixels) - 1.0)
    return Scene(problem, Lobe(a=a.to(dtype), n_s=14.0, n_d=n_d), truth.to(dtype), start.to(dtype))


@pytest.fixture
def scene():
    return make_scene
