"""Registration of pictures of the same thing, against known motions."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from reflectsep.calibrate.motion import displacement, shifted
from reflectsep.calibrate.register import register
from reflectsep.calibrate.register_options import RegisterOptions
from reflectsep.errors import CaptureError
from reflectsep.synth.drift import moved

SIZE = 128
NOISE = 0.01


def scene(size=SIZE):
    """A disc with a print on it, soft at a pixel's scale, 0 to 1."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, size), torch.linspace(-1, 1, size), indexing="ij")
    x, y = x.double(), y.double()
    disc = torch.sigmoid((0.8 - (x**2 + y**2).sqrt()) * size / 4)
    text = 0.25 * torch.sign(torch.sin(23 * x + 4 * y)) * torch.sign(torch.cos(17 * y - 3 * x))
    soft = torch.nn.functional.avg_pool2d(text[None, None], 3, 1, 1)[0, 0]
    return disc * (0.6 + 0.2 * x + soft)


@pytest.fixture(scope="module")
def still():
    return scene()


def noisy(picture, seed, sigma=NOISE):
    return picture + sigma * torch.randn(picture.shape, generator=torch.Generator().manual_seed(seed)).double()


def everywhere(picture):
    return torch.ones(picture.shape, dtype=torch.bool)


def centre(picture):
    return ((picture.shape[1] - 1) / 2, (picture.shape[0] - 1) / 2)


@pytest.mark.parametrize(("pixels", "degrees"), [(0.3, 0.1), (1.0, -0.3), (2.0, 0.6), (4.0, 1.0)])
def test_rigid_motions_are_found_within_a_twentieth_of_a_pixel(still, pixels, degrees):
    way = 40.0 * pixels
    true = shifted(pixels * math.cos(way), pixels * math.sin(way), degrees, centre(still))
    # The moving picture is a sum of frames: noisier, and C = 2 times as bright.
    moving = 2.0 * noisy(moved(still[None], true)[0], 1, 0.02)
    found = register(moving, noisy(still, 2), usable=everywhere(still))
    assert found.model == "rigid"
    assert displacement(true @ torch.linalg.inv(found.matrix), everywhere(still)) < 0.05
    turn = math.degrees(math.atan2(float(found.matrix[1, 0]), float(found.matrix[0, 0])))
    assert turn == pytest.approx(degrees, abs=0.03)
    assert found.gain == pytest.approx(2.0, rel=0.01)
    assert found.sd_px < 0.05


@settings(max_examples=5)
@given(st.integers(0, 10_000))
def test_no_motion_is_found_where_there_is_none(seed):
    still = scene(64)
    found = register(noisy(still, seed), noisy(still, seed + 1), usable=everywhere(still))
    assert found.model == "identity"
    assert torch.equal(found.matrix, torch.eye(3, dtype=torch.float64))


def test_uncertainty_is_that_of_repeated_draws():
    still = scene(64)
    true = shifted(0.8, -0.5)
    only = RegisterOptions(models=("translation",), floor_px=0.0)
    errors, stated = [], []
    for seed in range(20):
        moving = noisy(moved(still[None], true)[0], 2 * seed, 0.03)
        found = register(moving, noisy(still, 2 * seed + 1, 0.03), usable=everywhere(still), options=only)
        errors.append((found.matrix[:2, 2] - true[:2, 2]).square().sum())
        stated.append(found.sd_px)
    actual = float(torch.stack(errors).mean().sqrt())
    assert 0.5 < (sum(stated) / len(stated)) / actual < 2.0


def test_affine_motion_is_told_from_a_rigid_one(still):
    true = torch.tensor([[1.012, 0.0, -0.7], [0.0, 0.996, 0.3], [0.0, 0.0, 1.0]], dtype=torch.float64)
    found = register(noisy(moved(still[None], true)[0], 1), noisy(still, 2), usable=everywhere(still))
    assert found.model == "affine"
    assert displacement(true @ torch.linalg.inv(found.matrix), everywhere(still)) < 0.05


def test_drift_along_a_passage_is_found(still):
    time = torch.linspace(-1, 1, SIZE)[None].repeat(SIZE, 1)
    slices = [moved(still[None], shifted(0.5 + t, 0.6 * t))[0] for t in torch.linspace(-1, 1, SIZE).tolist()]
    # Each column as it lay when the slab passed it.
    moving = torch.stack([picture[:, i] for i, picture in enumerate(slices)], 1)
    found = register(
        noisy(moving, 1),
        noisy(still, 2),
        usable=everywhere(still),
        time=time,
        options=RegisterOptions(drift=True),
    )
    assert found.velocity == pytest.approx((1.0, 0.6), abs=0.05)
    assert found.matrix[0, 2] == pytest.approx(0.5, abs=0.05)


def test_outliers_do_not_pull(still):
    true = shifted(1.2, 0.7)
    moving = noisy(moved(still[None], true)[0], 1)
    moving[30:60, 30:60] += 0.8  # a highlight that the other picture has not
    found = register(moving, noisy(still, 2), usable=everywhere(still))
    assert displacement(true @ torch.linalg.inv(found.matrix), everywhere(still)) < 0.05


def test_clipped_values_do_not_count(still):
    true = shifted(1.2, 0.7)
    moving = moved(still[None], true)[0].clamp(max=0.6)
    found = register(noisy(moving, 1), noisy(still, 2), usable=still < 0.6, moving_usable=moving < 0.6)
    assert displacement(true @ torch.linalg.inv(found.matrix), everywhere(still)) < 0.05


def test_too_few_pixels_are_refused(still):
    few = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    few[:5, :5] = True
    with pytest.raises(CaptureError, match="25 pixels can be compared, expected at least 64"):
        register(still, still, usable=few)
