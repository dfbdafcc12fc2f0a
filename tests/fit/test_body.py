from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.fit.body import extend_into_shadow, robust_body

NOISE = 1e-3


def some_alpha(lights=7):
    g = torch.Generator().manual_seed(2)
    mixes = torch.rand(lights - 3, 3, generator=g, dtype=torch.float64)
    return torch.cat([torch.eye(3, dtype=torch.float64), mixes / mixes.sum(1, keepdim=True)])


def pictures(b, n_d=1.0):
    return (b @ some_alpha().mT).clamp_min(0) ** n_d


def bodies(pixels=40, channels=2, low=0.2):
    g = torch.Generator().manual_seed(9)
    return low + 0.6 * torch.rand(pixels, channels, 3, generator=g, dtype=torch.float64)


def fitted(images, n_d=1.0):
    return robust_body(images, torch.full_like(images, 1 / NOISE), some_alpha(), n_d)


@pytest.mark.parametrize("n_d", [1.0, 1.4])
def test_clean_pictures_give_the_root_back(n_d):
    b = bodies()
    assert float((fitted(pictures(b, n_d), n_d) - b).abs().max()) < 1e-4


@pytest.mark.parametrize("light", [0, 3, 6])
def test_one_highlight_is_set_aside(light):
    b = bodies()
    images = pictures(b)
    images[..., light] += 0.5
    error = (fitted(images) - b).abs().amax((1, 2))
    assert float(error.median()) < 5 * NOISE
    plain = images @ torch.linalg.pinv(some_alpha()).mT
    assert float(error.median()) < 0.05 * float((plain - b).abs().amax((1, 2)).median())


def test_a_patch_that_faces_away_has_a_negative_root():
    b = bodies()
    b[..., 0] = -0.1
    assert (pictures(b)[..., 0] == 0).all()
    assert (pictures(b)[..., 3:] > 0).sum(-1).min() >= 3
    error = (fitted(pictures(b)) - b).abs()
    assert float(error.median()) < 2 * NOISE
    assert float(error.amax((1, 2)).quantile(0.9)) < 0.02


def test_a_picture_that_a_highlight_hides_from_the_first_guess_is_heard_again():
    b = bodies(400, 1, low=0.02)
    b[..., 1] *= 0.2  # so dim that the guess puts the second light behind the horizon
    images = pictures(b)
    images[..., 0] += 2.0
    assert float((fitted(images) - b).abs().amax((1, 2)).median()) < 10 * NOISE


def test_within_the_noise_it_is_least_squares_by_the_pictures_weights():
    g = torch.Generator().manual_seed(3)
    images = pictures(bodies())
    images += 0.3 * NOISE * torch.randn(images.shape, generator=g, dtype=torch.float64)
    weight = (0.1 + 0.9 * torch.rand(images.shape, generator=g, dtype=torch.float64)) / NOISE
    found = robust_body(images, weight, some_alpha(), 1.0)
    rows = weight[..., None] * some_alpha()
    expected = torch.linalg.lstsq(rows, (weight * images)[..., None]).solution[..., 0]
    torch.testing.assert_close(found, expected, rtol=0, atol=0.03 * NOISE)


def test_a_pixel_does_not_depend_on_the_others():
    images = pictures(bodies())
    images[::3, :, 1] += 0.4
    assert torch.equal(fitted(images)[7:9], fitted(images[7:9]))


def test_brighter_light_is_a_larger_root():
    images = pictures(bodies())
    images[..., 4] += 0.3
    weight = torch.full_like(images, 1 / NOISE)
    once = robust_body(images, weight, some_alpha(), 1.0)
    twice = robust_body(2 * images, weight / 2, some_alpha(), 1.0)
    torch.testing.assert_close(twice, 2 * once)


@given(st.lists(st.floats(0.01, 1), min_size=3, max_size=3), st.floats(0.5, 1))
def test_lit_patches_keep_what_was_measured(s, least):
    body = torch.tensor([[[1.0, least, 0.8]]], dtype=torch.float64)
    measured = torch.tensor([[s]], dtype=torch.float64)
    assert torch.equal(extend_into_shadow(measured, body), measured)


@given(st.floats(0.01, 0.9), st.floats(-1, 0))
def test_beyond_the_edge_scattering_keeps_its_share_of_the_body(share, dark):
    body = torch.tensor([[[1.0, 0.7, dark]]], dtype=torch.float64)
    measured = share * body.clamp_min(0.0) + torch.tensor([0.0, 0.0, 0.05], dtype=torch.float64)
    extended = extend_into_shadow(measured, body)
    torch.testing.assert_close(extended, share * body)


def test_the_extension_is_continuous_across_the_edge():
    dark = torch.linspace(-0.5, 1, 1501, dtype=torch.float64)
    body = torch.stack([torch.ones_like(dark), torch.full_like(dark, 0.8), dark], -1)[:, None]
    measured = torch.tensor([0.3, 0.2, 0.15], dtype=torch.float64).expand_as(body)
    extended = extend_into_shadow(measured, body)
    assert float(extended.diff(dim=0).abs().max()) < 2e-3


def test_no_light_at_all_makes_no_scattering_up():
    nothing = torch.zeros(2, 1, 3, dtype=torch.float64)
    assert torch.equal(extend_into_shadow(nothing, nothing), nothing)
    assert extend_into_shadow(nothing + 0.1, nothing - 0.5).isfinite().all()
