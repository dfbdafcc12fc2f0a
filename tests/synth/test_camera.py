import numpy as np
import pytest
import torch

from reflectsep.io.pictures import read_picture
from reflectsep.synth.camera import exposed, noise, store
from reflectsep.synth.rig import SimulatedCamera

RAMP = torch.linspace(0, 1.2, 64 * 64, dtype=torch.float64).reshape(1, 64, 64)


def taken(camera, values, exposure_s=0.01, **rest):
    return exposed(camera, values, exposure_s, **({"sigma": 0.0, "rng": noise(0, "p")} | rest))


def test_a_perfect_camera_gives_what_is_there():
    assert torch.equal(taken(SimulatedCamera(), RAMP), RAMP)


def test_exposure_scales_light_and_ambient_but_not_the_dark_level():
    camera = SimulatedCamera(full_exposure_s=0.01, slab_exposure_s=0.04, dark_level=0.05, ambient_per_s=2.0)
    assert taken(camera, RAMP, 0.04) == pytest.approx(4 * RAMP + 0.05 + 0.08)
    assert taken(camera, 0 * RAMP, 0.01) == pytest.approx(0 * RAMP + 0.05 + 0.02)


@pytest.mark.parametrize("level", [0.0, 0.02, 0.3, 0.9])
def test_shot_and_read_noise_have_their_mean_and_variance(level):
    camera = SimulatedCamera(full_well_e=2000.0, read_sigma=0.004, dark_level=0.1)
    picture = taken(camera, torch.full((1, 400, 400), level, dtype=torch.float64)).numpy()
    variance = level / 2000 + 0.004**2
    count = picture.size
    assert picture.mean() == pytest.approx(level + 0.1, abs=5 * np.sqrt(variance / count))
    # The variance of a sample variance: 2 s^4 / n, plus the Poisson kurtosis, under s^4 / (n rate) here.
    assert picture.var() == pytest.approx(variance, rel=5 * np.sqrt(2.2 / count))


def test_gaussian_noise_is_a_share_of_the_peak_at_every_exposure():
    camera = SimulatedCamera(peak=0.5, slab_exposure_s=0.08)
    picture = taken(camera, torch.zeros(1, 300, 300, dtype=torch.float64), 0.08, sigma=0.01)
    assert float(picture.std()) == pytest.approx(0.005, rel=0.02)


def test_averaged_darks_are_quieter():
    camera = SimulatedCamera(read_sigma=0.01)
    nothing = torch.zeros(1, 200, 200, dtype=torch.float64)
    assert float(taken(camera, nothing, average=16).std()) == pytest.approx(0.0025, rel=0.03)


def test_noise_belongs_to_seed_and_picture():
    first, same, other, reseeded = (
        noise(*key).standard_normal(4).tolist() for key in ((1, "a"), (1, "a"), (1, "b"), (2, "a"))
    )
    assert first == same
    assert first != other
    assert first != reseeded


@pytest.mark.parametrize(("bits", "levels"), [(8, 255), (12, 4095), (16, 65535), (5, 31)])
def test_stored_integers_are_within_half_a_code(tmp_path, bits, levels):
    camera = SimulatedCamera(bits=bits)
    path = store(camera, tmp_path / "picture", taken(camera, RAMP))
    values, clipped = read_picture(path)
    expected = RAMP.clamp_max(1)
    # A code of 5 or 12 bits is kept as the nearest one of 8 or 16.
    kept = 0.5 / (255 if bits <= 8 else 65535) if bits in (5, 12) else 0.0
    assert (values - expected).abs().max() <= 0.5 / levels + kept + 1e-6
    assert torch.equal(clipped, (expected * levels).round() == levels)


@pytest.mark.parametrize("bits", [None, 8, 12])
def test_a_gamma_camera_is_undone_by_its_gamma(tmp_path, bits):
    camera = SimulatedCamera(bits=bits, gamma=2.2)
    values, _ = read_picture(store(camera, tmp_path / "picture", taken(camera, RAMP)))
    step = {None: 1e-6, 8: 0.5 / 255 + 1e-6, 12: 0.5 / 4095 + 0.5 / 65535 + 1e-6}[bits]
    expected = RAMP if bits is None else RAMP.clamp_max(1)
    assert (values - expected ** (1 / 2.2)).abs().max() <= step


def test_a_float_camera_keeps_noise_below_black_and_an_integer_one_does_not(tmp_path):
    nothing = torch.zeros(1, 50, 50, dtype=torch.float64)
    assert taken(SimulatedCamera(read_sigma=0.01), nothing).min() < 0
    assert taken(SimulatedCamera(read_sigma=0.01, bits=12), nothing).min() == 0
    encoded, _ = read_picture(store(SimulatedCamera(gamma=2.0), tmp_path / "p", nothing - 0.04))
    assert encoded == pytest.approx(torch.full((1, 50, 50), -0.2))


def test_saturation_clips():
    assert taken(SimulatedCamera(saturation=0.7), RAMP).max() == 0.7
    assert taken(SimulatedCamera(saturation=0.7, dark_level=0.1), RAMP).max() == 0.7
