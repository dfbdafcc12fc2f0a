"""The pixels that everyone solves: a bumpy surface made from the model itself, lights 15 to 30 degrees off the view."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from reflectsep.kernel.problem import Lobe, PixelProblem
from reflectsep.model import positive_power

N_S = 14.0
TOLERANCE, FLOOR, ITERATIONS = 1e-6, 1e-12, 50
"""Relative decrease of the cost at which everyone may stop, cost that counts as zero, and iterations at most."""
WITHIN = 1e-3
"""Success: a cost within this share of the best that any solver or start reaches on the pixel."""


@dataclass(frozen=True)
class Case:
    """One problem in single precision."""

    problem: PixelProblem
    lobe: Lobe
    truth: Tensor
    start: Tensor
    """20 % off the truth, each unknown on its own."""

    def head(self, pixels: int) -> Case:
        """The first pixels alone."""
        cut = slice(0, pixels)
        part = self.problem.take(cut)
        part = PixelProblem(
            images=part.images.contiguous(),
            s=part.s.contiguous(),
            alpha=part.alpha,
            light_weight=part.light_weight,
        )
        return Case(part, self.lobe, self.truth[:, cut].contiguous(), self.start[:, cut].contiguous())


def make_case(pixels: int, *, lights: int = 6, sigma: float = 0.005, seed: int = 0) -> Case:
    """Pictures with noise of standard deviation `sigma` against a peak of about 1."""
    g = torch.Generator().manual_seed(seed)
    turn = 2.4 * torch.arange(lights, dtype=torch.float64) + 0.3
    tilt = torch.deg2rad(15.0 + 15.0 * ((torch.arange(lights, dtype=torch.float64) * 0.618) % 1.0))
    light = torch.stack([tilt.sin() * turn.cos(), tilt.sin() * turn.sin(), tilt.cos()], -1)
    alpha = light @ torch.linalg.inv(light[:3])
    alpha[:3] = torch.eye(3)
    alpha, light = alpha.float(), light.float()
    facing = torch.cat([0.25 * torch.randn(2, pixels, generator=g), torch.ones(1, pixels)])
    facing /= facing.norm(dim=0)
    q = 0.25 + 0.5 * torch.rand(pixels, generator=g)
    lit = (light[:3] @ facing).clamp_min(0.02)
    d, s, log_B, a = q * lit, 0.15 * lit + 0.1, (1.9 * facing[2] / q).log(), -0.95 * light[:3, 2]
    images = (alpha @ (d + s)).clamp_min(0.0)
    images += positive_power(alpha @ (a[:, None] + log_B.exp() * d), N_S)
    images += sigma * torch.randn(images.shape, generator=g)
    truth = torch.cat([d, log_B[None]])
    off = 0.4 * torch.rand(4, pixels, generator=g) - 0.2
    start = torch.cat([d * (1.0 + off[:3]), (log_B + off[3])[None]])
    weight = torch.ones(lights)
    weight[3:] = 2.0
    problem = PixelProblem(images=images, s=s, alpha=alpha, light_weight=weight)
    return Case(problem, Lobe(a=a, n_s=N_S), truth, start)


def true_cost(case: Case, local: Tensor, lobe: Lobe | None = None) -> Tensor:
    """Cost of every pixel at `local` (4, pixels), in double precision, by the plain formula."""
    p, lobe = case.problem, lobe or case.lobe
    alpha, x, parts = p.alpha.double(), local.double(), []
    for at in range(0, x.shape[1], 1 << 18):
        cut = slice(at, at + (1 << 18))
        d, B = x[:3, cut], x[3, cut].exp()
        u = alpha @ (lobe.a.double()[:, None] + B * d)
        model = (alpha @ (d + p.s[:, cut].double())).clamp_min(0.0) + positive_power(u, lobe.n_s)
        r = model - p.images[:, cut].double()
        parts.append(0.5 * (p.light_weight.double()[:, None] * r.square()).sum(0))
    return torch.cat(parts).nan_to_num(nan=torch.inf)
