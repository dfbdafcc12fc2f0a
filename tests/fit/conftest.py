from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from reflectsep.data import Fit, PhotometricStack, Scattering
from reflectsep.fit.problem import ALPHA, Neighbours, Observations, PixelProblem
from reflectsep.flags import Flag, mark
from reflectsep.model import Globals, lobe_of, lobe_vector, mixed, reflectance
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
        vectors = self.stack.light_vectors
        M = torch.eye(3) if vectors is None else torch.linalg.inv(vectors[:3])
        shared = Globals(
            a=fit.a, n_s=fit.n_s, n_d=fit.n_d, f=fit.f, softness=fit.softness, fresnel=fit.fresnel, ggx=fit.ggx, M=M
        )
        return reflectance(fit.d, fit.B, shared, s=fit.s[:3], alpha=self.heldout.float())

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


@dataclass(frozen=True)
class ModelCase:
    """Pictures made by the model itself under known globals, noise added, and what is behind them."""

    stack: PhotometricStack
    scattering: Scattering
    shared: Globals
    d: Tensor
    B: Tensor
    specular: Tensor
    """(lights, height, width)."""
    heldout: Tensor
    heldout_pictures: Tensor
    sigma: float

    def found(self, fit: Fit) -> tuple[Globals, Tensor, Tensor, Tensor]:
        """Globals, d, s and B of a fit, in double precision."""
        g = Globals(
            a=fit.a.double(),
            n_s=fit.n_s.double(),
            n_d=float(fit.n_d),
            f=fit.f.double(),
            softness=fit.softness.double(),
            fresnel=fit.fresnel.double(),
            ggx=fit.ggx,
            M=self.shared.M,
        )
        return g, fit.d.double(), fit.s[:3].double(), fit.B.double()

    def specular_error(self, fit: Fit) -> float:
        """Of the off-specular part of all pictures, relative to its norm."""
        g, d, s, B = self.found(fit)
        off = lobe_of(lobe_vector(d, s, B, g), g, self.stack.alpha.double()) - self.specular
        return float(off.norm() / self.specular.norm())

    def psnr(self, fit: Fit) -> float:
        """Of a relit picture that the fit did not see, in dB below the brightest value."""
        g, d, s, B = self.found(fit)
        off = reflectance(d, B, g, s=s, alpha=self.heldout) - self.heldout_pictures
        return float(-10 * (off.square().mean() / self.heldout_pictures.amax().square()).log10())


def make_model_case(
    *,
    size=32,
    lights=7,
    channels=1,
    ggx=True,
    n_s=25.0,
    f=0.4,
    softness=0.08,
    fresnel=0.7,
    n_d=1.0,
    noise=0.002,
    scattering=0.19,
) -> ModelCase:
    """A bumpy surface with highlights in the mirror direction; `noise`: of the brightest value."""
    rig = paper_rig(lights)
    truth = paper_truth(PaperObject(size=size, channels=channels, n_d=n_d, scattering=scattering), rig)
    everything = paper_alpha((*rig.lights, *rig.heldout))
    alpha, heldout = everything[:lights], everything[lights:]
    vectors = torch.tensor([light.direction for light in rig.lights], dtype=torch.float64)
    number = lambda value: torch.tensor(value, dtype=torch.float64)  # noqa: E731
    shared = Globals(
        a=truth.a,
        n_s=number(n_s),
        n_d=n_d,
        f=number(f),
        softness=number(softness),
        fresnel=number(fresnel),
        ggx=ggx,
        M=torch.linalg.inv(vectors[:3]),
    )
    turned = mixed(shared.M, (truth.d + (1 - f) * truth.s).mean(1))
    B = 2 * 0.91 * turned[2] / turned.square().sum(0)
    clean = reflectance(truth.d, B, shared, s=truth.s, alpha=everything)
    sigma = noise * float(clean.max())
    rough = torch.randn(clean[:lights].shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    mask = truth.surface.mask
    stack = PhotometricStack(
        names=tuple(light.name for light in rig.lights),
        images=(clean[:lights] + sigma * rough).float(),
        saturated=torch.zeros(rough.shape, dtype=torch.bool),
        mask=mask,
        alpha=alpha.float(),
        light_vectors=vectors.float(),
        view=torch.tensor([0.0, 0.0, 1.0]),
        flags=mark(torch.zeros(mask.shape, dtype=torch.int32), ~mask, Flag.OUTSIDE_MASK),
    )
    swept = Scattering(
        root=mixed(alpha, truth.s).float(),
        measured=tuple(k < 3 for k in range(lights)),
        n_d=n_d,
        n_d_sd=0.0,
        n_d_source="fixed",
        flags=torch.zeros(mask.shape, dtype=torch.int32),
    )
    specular = lobe_of(lobe_vector(truth.d, truth.s, B, shared), shared, alpha)
    return ModelCase(stack, swept, shared, truth.d, B, specular, heldout, clean[lights:], sigma)


@pytest.fixture(scope="session")
def model_case() -> Callable[..., ModelCase]:
    """`make_model_case`."""
    return make_model_case


def make_random_problem(
    kind=PixelProblem,
    *,
    channels=1,
    n_d: float | None = 1.0,
    known=True,
    ggx=True,
    refined=False,
    clipped=0.15,
    pixels=7,
    **changes,
):
    """A problem of random pixels with every kind of rows, and unknowns somewhere; `n_d` None: it is fitted."""
    g = torch.Generator().manual_seed(0)
    rand = lambda *n: torch.rand(*n, generator=g, dtype=torch.float64)  # noqa: E731
    double = lambda values: torch.tensor(values, dtype=torch.float64)  # noqa: E731
    rows = [[0.4, 0.1, 1], [-0.3, 0.35, 1], [-0.1, -0.4, 1], [0.1, 0.1, 1], [0.3, -0.2, 1], [-0.3, 0.1, 1]]
    L = torch.nn.functional.normalize(double(rows), dim=1)
    obs = Observations(
        images=rand(6, channels, pixels),
        s=0.2 * rand(6, channels, pixels) + 0.1,
        clipped=rand(6, channels, pixels) < clipped,
        alpha=L @ torch.linalg.inv(L[:3]),
        M=torch.linalg.inv(L[:3]) if known else torch.eye(3, dtype=torch.float64),
        view=double([0.0, 0.0, 1.0]),
        cosine=L[:3, 2] if known else torch.ones(3, dtype=torch.float64),
        lights_known=known,
        ggx=ggx and known,
        fixed_n_d=n_d,
        n_d=n_d or 1.1,
        swept=(True,) * 4 + (False,) * 2,
        share=double([1.0, 1.0, 1.0, 1.4, 1.4, 1.4])[:, None, None],
    )
    near = Neighbours(vector=rand(3, pixels), R=rand(6, pixels) + 0.2)
    problem = kind(obs=obs, **{"sigma": 0.1, "height_spread": 0.5, "neighbours": near, "huber": 2.0} | changes)
    # About a mirror's lobe over normals up to 70 degrees off the view, so that every clamp is taken on both sides.
    N = torch.nn.functional.normalize(torch.cat([5.0 * rand(2, pixels) - 2.5, torch.ones(1, pixels)]), dim=0)
    q = 0.3 + 0.3 * rand(channels, pixels)
    d = q * (L[:3] @ N)[:, None] + 0.05 * rand(3, channels, pixels)
    local = problem.packed(d, (1.8 * N[2] / q.mean(0)).log() + 0.1 * rand(pixels))
    shared = torch.zeros(ALPHA + (9 if refined else 0), dtype=torch.float64)
    shared[:3] = obs.cosine.log() - double([0.05, 0.1, 0.02])
    shared[3:ALPHA] = double([2.5, 0.4, 0.1, 0.8, 0.1])
    shared[ALPHA:] = 0.02 * (rand(len(shared) - ALPHA) - 0.5)
    return problem, local, shared


@pytest.fixture(scope="session")
def random_problem():
    """`make_random_problem`."""
    return make_random_problem
