from __future__ import annotations

import pytest
import torch

from reflectsep.fit.body import robust_body

NOISE = 1e-3


def some_alpha(lights=7):
    g = torch.Generator().manual_seed(2)
    mixes = torch.rand(lights - 3, 3, generator=g, dtype=torch.float64)
    return torch.cat([torch.eye(3, dtype=torch.float64), mixes / mixes.sum(1, keepdim=True)])


def pictures(b, n_d=1.0):
    return torch.einsum("ji,icn->jcn", some_alpha(), b).clamp_min(0) ** n_d


def bodies(pixels=40, channels=2, low=0.2):
    g = torch.Generator().manual_seed(9)
    return low + 0.6 * torch.rand(3, channels, pixels, generator=g, dtype=torch.float64)


def fitted(images, n_d=1.0):
    return robust_body(images, NOISE, some_alpha(), n_d, iterations=60)


@pytest.mark.parametrize("n_d", [1.0, 1.4])
def test_clean_pictures_give_the_root_back(n_d):
    b = bodies()
    assert float((fitted(pictures(b, n_d), n_d) - b).abs().max()) < 1e-4


@pytest.mark.parametrize("light", [0, 3, 6])
def test_one_highlight_is_set_aside(light):
    b = bodies()
    images = pictures(b)
    images[light] += 0.5
    error = (fitted(images) - b).abs().amax((0, 1))
    assert float(error.median()) < 5 * NOISE
    plain = torch.einsum("ij,jcn->icn", torch.linalg.pinv(some_alpha()), images)
    assert float(error.median()) < 0.05 * float((plain - b).abs().amax((0, 1)).median())


def test_a_patch_that_faces_away_has_a_negative_root():
    b = bodies()
    b[0] = -0.1
    assert (pictures(b)[0] == 0).all()
    assert (pictures(b)[3:] > 0).sum(0).min() >= 3
    error = (fitted(pictures(b)) - b).abs()
    assert float(error.median()) < 2 * NOISE
    assert float(error.amax((0, 1)).quantile(0.9)) < 0.02


def test_a_picture_that_a_highlight_hides_from_the_first_guess_is_heard_again():
    b = bodies(400, 1, low=0.02)
    b[1] *= 0.2  # so dim that the guess puts the second light behind the horizon
    images = pictures(b)
    images[0] += 2.0
    assert float((fitted(images) - b).abs().amax((0, 1)).median()) < 10 * NOISE


def test_within_the_noise_it_is_least_squares():
    g = torch.Generator().manual_seed(3)
    images = pictures(bodies())
    images += 0.3 * NOISE * torch.randn(images.shape, generator=g, dtype=torch.float64)
    expected = torch.einsum("ij,jcn->icn", torch.linalg.pinv(some_alpha()), images)
    torch.testing.assert_close(fitted(images), expected, rtol=0, atol=0.03 * NOISE)


def test_a_pixel_does_not_depend_on_the_others():
    images = pictures(bodies())
    images[1, :, ::3] += 0.4
    torch.testing.assert_close(fitted(images)[..., 7:9], fitted(images[..., 7:9]), rtol=1e-9, atol=1e-12)


def test_brighter_light_is_a_larger_root():
    images = pictures(bodies())
    images[4] += 0.3
    twice = robust_body(2 * images, 2 * NOISE, some_alpha(), 1.0, iterations=60)
    torch.testing.assert_close(twice, 2 * fitted(images))
