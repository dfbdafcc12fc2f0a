"""What lights and noise leave uncertain of a typical lobe: the expected split."""

from __future__ import annotations

import torch
from torch import Tensor

from reflectsep.checking.findings import Finding, graded
from reflectsep.data import PhotometricStack
from reflectsep.model import Globals, reflectance
from reflectsep.scatter.gains import fine_noise

SPLIT = (0.15, 0.5)
NOMINAL_A = -0.91
NOMINAL_N_S = 10.0
"""A typical lobe (paper's wax and the simulated objects), for what a fit may expect of these lights and this noise."""
SPLIT_PIXELS = 2000


def expected_split(stack: PhotometricStack) -> Finding:
    """What these lights and this noise leave uncertain of a typical lobe, at the object's own shading."""
    noise = max(float(torch.tensor([fine_noise(picture, stack.mask) for picture in stack.images]).median()), 1e-9)
    values = stack.images.mean(1)[:, stack.mask].double().clamp_min(0)
    values = values[:, :: max(1, values.shape[1] // SPLIT_PIXELS)]
    bright = float(values.flatten().kthvalue(max(1, int(0.99 * values.numel()))).values)
    d = values[:3].mT
    lit = d.min(1).values > 0.05 * bright
    if int(lit.sum()) < 16:
        return Finding(
            subject="expected split",
            value="too few pixels are lit by all three basis lights",
            verdict="bad",
            advice="choose basis lights nearer to the view",
        )
    relative, seen = _nominal_split(d[lit], stack.alpha.double(), noise, bright)
    verdict = graded(relative, SPLIT)
    return Finding(
        subject="expected split",
        value=f"noise alone leaves a typical lobe uncertain by {relative:.1%} of itself; {seen:.0%} of the object "
        "would show it in two pictures or more",
        verdict=verdict if seen > 0.02 else "doubtful",
        advice="" if verdict == "good" else "more lights, less noise, or lights nearer to the mirror direction",
        numbers={"relative": relative, "seen": seen},
    )


def _nominal_split(d: Tensor, alpha: Tensor, noise: float, bright: float) -> tuple[float, float]:
    """Median of sd over size of the specular root's power, and the share of pixels that see the lobe twice."""
    B = -2 * NOMINAL_A / d.mean(1)
    shared = Globals(
        a=torch.full((3,), NOMINAL_A, dtype=torch.float64),
        n_s=torch.tensor(NOMINAL_N_S, dtype=torch.float64),
        n_d=1.0,
        f=torch.tensor(1.0, dtype=torch.float64),
        softness=torch.tensor(0.0, dtype=torch.float64),
        fresnel=torch.tensor(0.0, dtype=torch.float64),
        ggx=False,
        M=torch.eye(3, dtype=torch.float64),
    )

    def pictures(theta: Tensor) -> Tensor:
        d = theta[:3, None]
        return reflectance(d, theta[3], shared, s=torch.zeros_like(d), alpha=alpha)[:, 0]

    theta = torch.cat([d, B[:, None]], 1)
    jacobian = torch.func.vmap(torch.func.jacfwd(pictures))(theta)  # (pixels, lights, 4)
    base = (NOMINAL_A + B[:, None] * d).clamp(0, 1.3)
    lobe = (base @ alpha.mT).clamp(0, 1.3) ** NOMINAL_N_S
    information = jacobian.mT @ jacobian / noise**2 + 1e-9 * torch.eye(4, dtype=d.dtype)
    covariance = torch.linalg.inv(information)
    power = NOMINAL_N_S * base ** (NOMINAL_N_S - 1)
    slope = torch.zeros(len(d), 3, 4, dtype=d.dtype)
    slope[:, range(3), range(3)] = power * B[:, None]
    slope[:, :, 3] = power * d
    sd = torch.einsum("pki,pij,pkj->pk", slope, covariance, slope).clamp_min(0).sqrt()
    size = base**NOMINAL_N_S
    shows = size > max(3 * noise, 0.02 * bright)
    relative = float((sd / size.clamp_min(1e-12))[shows].median()) if bool(shows.any()) else float("inf")
    return relative, float(((lobe > 3 * noise).sum(1) >= 2).double().mean())
