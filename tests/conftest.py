"""Settings of all tests, and results made from the model itself."""

import dataclasses

import pytest
import torch
from hypothesis import settings

from reflectsep.data import Fit, PhotometricStack
from reflectsep.flags import Flag
from reflectsep.separation import separate
from reflectsep.synth.paper import PaperObject, paper_alpha, paper_rig, paper_truth

# How long an example takes on a busy machine is no property of the code.
settings.register_profile("reflectsep", deadline=None)
settings.load_profile("reflectsep")


def make_result(*, size=64, channels=3, n_d=1.2, softness=0.1, fresnel=0.5, f=0.7, known=True, unit=1.0, ggx=True):
    """A result whose parameters are those of a bumpy surface; a disc of it is the object.

    `unit` scales the pictures, as another camera's units would. Where the lights are unknown (`known`) the lobe is the
    paper's power and there is no Fresnel term.
    """
    rig = paper_rig(6)
    truth = paper_truth(PaperObject(size=size, channels=channels, n_d=n_d), rig)
    row, column = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    mask = (row - size / 2) ** 2 + (column - size / 2) ** 2 < (0.48 * size) ** 2
    flags = torch.where(mask, int(Flag.HOLE_FILLED), int(Flag.OUTSIDE_MASK)).to(torch.int32)
    flags[mask & (column < size // 2)] |= int(Flag.UNDEREXPOSED) | int(Flag.FAINT_LOBE)
    intensity = torch.tensor([1.0, 0.8, 1.3, 1.0, 1.0, 1.0])
    vectors = torch.tensor([light.direction for light in rig.lights]) * intensity[:, None]
    alpha = torch.linalg.solve(vectors[:3].mT, vectors.mT).mT if known else paper_alpha(rig.lights).float()
    root = unit ** (1.0 / n_d)
    # The lobe turns with the mean of the channels' d.
    B = (1.0 / (1.0 / truth.B).mean(0)).float()
    residual = 0.01 * unit * torch.randn(6, channels, size, size, generator=torch.Generator().manual_seed(1)) * mask
    stack = PhotometricStack(
        names=tuple(light.name for light in rig.lights),
        images=torch.zeros(6, channels, size, size),
        saturated=torch.zeros(6, channels, size, size, dtype=torch.bool),
        mask=mask,
        alpha=alpha,
        light_vectors=vectors if known else None,
        view=torch.tensor([0.0, 0.0, 1.0]),
        flags=flags,
    )
    s = torch.cat([truth.s, torch.zeros_like(truth.s)]).float() * root * mask
    fit = Fit(
        a=truth.a.float() * unit ** (1.0 / truth.n_s),
        n_s=torch.tensor(truth.n_s),
        n_d=torch.tensor(n_d),
        f=torch.tensor(f),
        softness=torch.tensor(softness),
        fresnel=torch.tensor(fresnel if known else 0.0),
        ggx=ggx and known,
        materials=torch.tensor([[1.0, truth.n_s]]),
        material=torch.zeros(size, size, dtype=torch.int32),
        global_names=("a_1",),
        covariance=torch.eye(1),
        d=truth.d.float() * root * mask,
        s=s,
        B=B * unit ** (1.0 / truth.n_s) / root * mask,
        d_sd=torch.zeros_like(truth.d).float(),
        B_sd=torch.zeros_like(B),
        residual=residual,
        intensity=intensity if known else torch.ones(6),
        flags=flags,
        noise=0.01,
        cost=1.0,
        iterations=3,
    )
    document = {"object": "bumps", "model": "Wu & Tang", "warnings": ["a warning"], "n_d_source": "fixed"}
    made = separate(stack, None, fit, document)
    pictures = torch.stack([made.relight(made.alpha[i]) + residual[i] for i in range(6)])
    return separate(dataclasses.replace(stack, images=pictures), None, fit, document)


@pytest.fixture(scope="session")
def result():
    """`make_result`, to make results with."""
    return make_result
