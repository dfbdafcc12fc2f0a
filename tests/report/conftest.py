"""A result made from the model itself, with its pictures."""

import pytest
import torch

from reflectsep.data import Fit, PhotometricStack
from reflectsep.separation import separate
from reflectsep.synth.paper import PaperObject, paper_alpha, paper_picture, paper_rig, paper_truth


@pytest.fixture(scope="session")
def exact():
    """Separation and stack of a surface whose pictures are the model's, without noise."""
    rig = paper_rig(6)
    truth = paper_truth(PaperObject(size=32), rig)
    alpha = paper_alpha(rig.lights)
    images = torch.stack([paper_picture(truth, mix).full for mix in alpha]).float()
    mask = truth.surface.mask
    vectors = torch.tensor([light.direction for light in rig.lights], dtype=torch.float32)
    flags = torch.zeros(mask.shape, dtype=torch.int32)
    stack = PhotometricStack(
        names=tuple(light.name for light in rig.lights),
        images=images,
        saturated=torch.zeros(images.shape, dtype=torch.bool),
        mask=mask,
        alpha=alpha.float(),
        light_vectors=vectors,
        view=torch.tensor([0.0, 0.0, 1.0]),
        flags=flags,
    )
    fit = Fit(
        a=truth.a.float(),
        n_s=torch.tensor(truth.n_s),
        n_d=torch.tensor(1.0),
        softness=torch.tensor(0.0),
        f=torch.tensor(1.0),
        fresnel=torch.tensor(0.0),
        ggx=False,
        materials=torch.tensor([[1.0, truth.n_s]]),
        material=torch.zeros_like(flags),
        global_names=("a_1",),
        covariance=torch.eye(1),
        d=truth.d.float(),
        s=torch.einsum("li,ichw->lchw", alpha, truth.s).float(),
        B=truth.B[0].float(),
        d_sd=torch.full_like(truth.d, 0.01).float(),
        B_sd=torch.full_like(truth.B[0], 0.1).float(),
        residual=torch.zeros_like(images),
        intensity=torch.ones(6),
        flags=flags,
        noise=0.01,
        cost=0.0,
        iterations=1,
    )
    return separate(stack, None, fit, {"object": "bumps", "model": "made"}), stack
