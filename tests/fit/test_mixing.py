"""Refined alphas: what they are, what they leave alone, and that they come back."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.errors import FitError
from reflectsep.fit.mixing import mixing
from reflectsep.fit.options import FitOptions
from reflectsep.fit.problem import ALPHA, pixel_residual, refined, shared_residual
from reflectsep.fit.reflectance import fit_reflectance
from reflectsep.separation import separate

from .test_derivatives import LIGHTS, random_case

numbers = st.floats(-0.1, 0.1)


def unit_lights(count, seed=0):
    g = torch.Generator().manual_seed(seed)
    vectors = torch.randn(count, 3, generator=g, dtype=torch.float64) * 0.3 + torch.tensor([0.0, 0.0, 1.0])
    vectors = torch.nn.functional.normalize(vectors, dim=-1)
    return vectors, vectors @ torch.linalg.inv(vectors[:3])


@given(st.lists(numbers, min_size=12, max_size=12), st.floats(0.5, 2.0))
def test_length_is_intensity_and_the_rest_direction(delta, longer):
    vectors, alpha = unit_lights(7)
    delta = torch.tensor(delta, dtype=torch.float64)
    found = mixing(alpha, delta, vectors[:3])
    beta = alpha[3:] + delta.view(-1, 3)
    torch.testing.assert_close((found.alpha[3:] @ vectors[:3]).norm(dim=-1), torch.ones(4, dtype=torch.float64))
    torch.testing.assert_close(found.alpha[3:] * found.intensity[3:, None], beta)
    # A light that is only stronger is the same mix.
    stronger = mixing(alpha, (longer * beta - alpha[3:]).flatten(), vectors[:3])
    torch.testing.assert_close(stronger.alpha, found.alpha)
    torch.testing.assert_close(stronger.intensity[3:], longer * found.intensity[3:])


def test_the_basis_stays_and_nothing_added_changes_nothing():
    vectors, alpha = unit_lights(6)
    found = mixing(alpha, torch.zeros(9, dtype=torch.float64), vectors[:3])
    torch.testing.assert_close(found.alpha, alpha)
    torch.testing.assert_close(found.intensity, torch.ones(6, dtype=torch.float64))
    moved = mixing(alpha, torch.full((9,), 0.1, dtype=torch.float64), vectors[:3])
    assert torch.equal(moved.alpha[:3], alpha[:3])
    assert torch.equal(moved.intensity[:3], torch.ones(3, dtype=torch.float64))


def test_unknown_directions_have_no_intensity():
    _, alpha = unit_lights(5)
    delta = torch.linspace(-0.1, 0.1, 6, dtype=torch.float64)
    found = mixing(alpha, delta, None)
    torch.testing.assert_close(found.alpha[3:], alpha[3:] + delta.view(2, 3))
    assert torch.equal(found.intensity, torch.ones(5, dtype=torch.float64))


def test_a_refined_light_is_as_if_it_had_been_stated_so():
    """Stated 3 % brighter and turned, or refined to that: the same residuals of its pictures, in its own units."""
    obs, priors, local, shared = random_case()
    vectors, alpha = unit_lights(LIGHTS)
    obs = replace(obs, alpha=alpha, normal_map=torch.linalg.inv(vectors[:3]))
    other, new = unit_lights(LIGHTS, seed=1)[0][3], alpha.clone()
    new[3] = torch.nn.functional.normalize(vectors[3] + 0.05 * other, dim=-1) @ torch.linalg.inv(vectors[:3])
    delta = torch.zeros(LIGHTS - 3, 3, dtype=torch.float64)
    delta[0] = 1.03 * new[3] - alpha[3]
    images, weight, s = obs.images.clone(), obs.weight.clone(), obs.s.clone()
    images[..., 3], weight[..., 3] = images[..., 3] / 1.03, weight[..., 3] * 1.03
    s[..., 3] = s[..., 3] + obs.s_basis @ (new[3] - alpha[3])
    stated = replace(obs, alpha=new, images=images, weight=weight, s=s)
    torch.testing.assert_close(
        pixel_residual(local, torch.cat([shared, delta.flatten()]), obs, priors),
        pixel_residual(local, shared, stated, priors),
    )


def test_scattering_of_a_light_with_its_own_sweep_stays_as_measured():
    obs, _, _, shared = random_case(swept=(True, True, True, True, False, False, False))
    moved = torch.cat([shared, torch.full((12,), 0.1, dtype=torch.float64)])
    assert torch.equal(refined(obs, moved).s[..., 3], obs.s[..., 3])
    assert float((refined(obs, moved).s - obs.s)[..., 4:].abs().amin()) > 0
    assert refined(obs, shared) is obs


def test_they_are_held_to_what_was_stated():
    obs, priors, _, shared = random_case(alphas=True)
    rows = shared_residual(shared, obs.cosine, replace(priors, alpha_sd=0.05))[-12:]
    torch.testing.assert_close(rows, shared[ALPHA:] / 0.05)


def perturbed(case, size, seed=0):
    """The stack with lights beside the basis stated wrongly: `size` of their vectors' length in a random direction."""
    g = torch.Generator().manual_seed(seed)
    off = size / 3**0.5 * torch.randn(case.stack.alpha.shape, generator=g)
    off[:3] = 0.0
    vectors = case.stack.light_vectors + off
    return replace(case.stack, light_vectors=vectors, alpha=vectors @ torch.linalg.inv(vectors[:3]))


def test_wrong_alphas_come_back_and_relighting_gains(paper_case):
    case = paper_case(size=16, lights=7)
    stack = perturbed(case, 0.02)
    quick = FitOptions(globals_pixels=60, max_iterations=4, scattering_sd=0.0, lobe="single")
    held = fit_reflectance(stack, case.scattering, quick)
    freed = fit_reflectance(stack, case.scattering, replace(quick, alpha_sd=0.02))
    assert held.alpha is None
    assert freed.alpha is not None
    before = float((stack.alpha - case.stack.alpha).square().mean().sqrt())
    after = float((freed.alpha - case.stack.alpha).square().mean().sqrt())
    assert after < 0.3 * before
    assert case.psnr(freed) > case.psnr(held) + 3.0
    assert freed.global_names[5:8] == tuple(f"alpha_{stack.names[3]}_{name}" for name in stack.names[:3])
    assert freed.alpha_sd is not None
    assert float(freed.alpha_sd[3:].amax()) < 0.02  # the pictures say more than was stated
    assert not bool(freed.alpha_sd[:3].any())


def test_a_result_has_the_refined_alphas_and_vectors(paper_case):
    case = paper_case(size=12)
    quick = FitOptions(globals_pixels=40, max_iterations=2, scattering_sd=0.0, lobe="single", prior="none")
    fit = fit_reflectance(case.stack, case.scattering, quick)
    alpha = case.stack.alpha.clone()
    alpha[3] = torch.tensor([0.5, 0.3, 0.2])
    result = separate(case.stack, case.scattering, replace(fit, alpha=alpha), {})
    assert torch.equal(result.alpha, alpha)
    torch.testing.assert_close(result.light_vectors[3], alpha[3] @ case.stack.light_vectors[:3])
    assert torch.equal(result.light_vectors[:3], case.stack.light_vectors[:3])


def test_only_the_joint_fit_refines_them(paper_case):
    case = paper_case(size=12)
    with pytest.raises(FitError, match="two_step"):
        fit_reflectance(case.stack, case.scattering, FitOptions(method="two_step", alpha_sd=0.02))
