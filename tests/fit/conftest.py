from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from reflectsep.data import Fit, PhotometricStack, Scattering
from reflectsep.flags import Flag, mark
from reflectsep.model import Globals, reflectance
from reflectsep.synth.paper import PaperObject, PaperTruth, paper_alpha, paper_picture, paper_rig, paper_truth


@pytest.fixture(scope="session", autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@dataclass(frozen=True)
class PaperCase:
    """Pictures made exactly by the model, their scattering, and the truth behind both."""

    stack: PhotometricStack
    scattering: Scattering
    truth: PaperTruth
    heldout: Tensor
    """(lights, 3): alpha of the lights to relight."""
    heldout_pictures: Tensor
    """(lights, channels, height, width), without noise."""

    @property
    def specular(self) -> Tensor:
        return torch.stack([paper_picture(self.truth, mix).specular for mix in self.stack.alpha.double()])

    def sees_lobe(self, sigma: float) -> Tensor:
        """Pixels whose highlight stands well above `sigma` in two pictures or more."""
        return (self.specular.mean(1) > 3 * sigma).sum(0) >= 2

    def relit(self, fit: Fit) -> Tensor:
        """Pictures of the held-out lights by the fit; basis lights are of unit intensity in these rigs."""
        shared = Globals(a=fit.a, n_s=fit.n_s, n_d=float(fit.n_d), softness=fit.softness, crest=fit.crest)
        alpha = self.heldout.float()
        d, s = fit.d.permute(2, 3, 1, 0), fit.s[:3].permute(2, 3, 1, 0)
        width = fit.softness * s.mean(-1, keepdim=True)
        picture = reflectance(d, fit.B.mean(0), shared, s=s @ alpha.mT, alpha=alpha, width=width)
        return picture.permute(3, 2, 0, 1)

    def psnr(self, fit: Fit) -> float:
        """Of the relit held-out pictures against a peak of 1, in dB."""
        error = (self.relit(fit) - self.heldout_pictures.float())[..., self.stack.mask]
        return float(-10 * error.square().mean().log10())


def make_paper_case(
    *,
    size: int = 32,
    lights: int = 6,
    sigma: float = 0.0,
    n_d: float = 1.0,
    channels: int = 1,
    measured: int = 3,
    seed: int = 0,
) -> PaperCase:
    """`measured`: how many of the three basis lights have a scattering of their own; the root is truth's anyway."""
    rig = paper_rig(lights, sigma=sigma)
    truth = paper_truth(PaperObject(size=size, n_d=n_d, channels=channels), rig)
    everything = paper_alpha((*rig.lights, *rig.heldout))
    alpha, heldout = everything[:lights], everything[lights:]
    clean = torch.stack([paper_picture(truth, mix).full for mix in alpha])
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(seed), dtype=clean.dtype)
    vectors = torch.tensor([light.direction for light in rig.lights], dtype=torch.float64)
    mask = truth.surface.mask
    stack = PhotometricStack(
        names=tuple(light.name for light in rig.lights),
        images=(clean + sigma * noise).float(),
        saturated=torch.zeros(clean.shape, dtype=torch.bool),
        mask=mask,
        alpha=alpha.float(),
        light_vectors=vectors.float(),
        view=torch.tensor([0.0, 0.0, 1.0]),
        flags=mark(torch.zeros(mask.shape, dtype=torch.int32), ~mask, Flag.OUTSIDE_MASK),
    )
    scattering = Scattering(
        root=torch.einsum("li,ichw->lchw", alpha, truth.s).float(),
        measured=tuple(k < measured for k in range(lights)),
        n_d=n_d,
        n_d_sd=0.0,
        n_d_source="fixed",
        flags=torch.zeros(mask.shape, dtype=torch.int32),
    )
    pictures = torch.stack([paper_picture(truth, mix).full for mix in heldout])
    return PaperCase(stack, scattering, truth, heldout, pictures)


@pytest.fixture(scope="session")
def paper_case() -> Callable[..., PaperCase]:
    return make_paper_case


@pytest.fixture(scope="session")
def small_case() -> PaperCase:
    """Noise-free, 24 x 24, six lights."""
    return make_paper_case(size=24)


@pytest.fixture(scope="session")
def without_vectors() -> Callable[[PaperCase], PhotometricStack]:
    """The stack of a case as if only alpha were known."""
    return lambda case: replace(case.stack, light_vectors=None)
