"""Motions that the other lights' pictures contradict."""

import math
from dataclasses import replace

import pytest
import torch

from reflectsep.calibrate import among_lights
from reflectsep.calibrate.alignment import align
from reflectsep.calibrate.among_lights import checked_among_lights, predicted
from reflectsep.calibrate.exposure import response_of
from reflectsep.calibrate.motion import Motion, displacement, shifted
from reflectsep.calibrate.stack import develop_pictures
from reflectsep.io.capture import load_capture
from reflectsep.io.stack import read_full, read_mask
from reflectsep.synth.drift import moved
from reflectsep.synth.presets import make_object
from reflectsep.synth.rig import make_rig
from reflectsep.synth.simulate import simulate

from .conftest import direction

SIZE = 48
SEED = 0
VECTORS = torch.tensor([direction(28, 120 * i) for i in range(3)] + [direction(18, 47 + 72 * i) for i in range(5)])


def dome(vectors=VECTORS):
    """A smooth dome before a black background, lit by every vector: pictures, good values and mask."""
    y, x = torch.meshgrid(*[torch.linspace(-1.3, 1.3, 2 * SIZE, dtype=torch.float64)] * 2, indexing="ij")
    mask = x.square() + 1.2 * y.square() < 1
    normal = torch.stack([0.8 * x + 0.1 * torch.sin(4 * y), 0.8 * y, torch.ones_like(x)])
    shading = torch.einsum("lc,chw->lhw", vectors.double(), normal / normal.norm(dim=0)).clamp_min(0) * mask
    fine = torch.nn.functional.avg_pool2d
    pictures = fine(shading[:, None], 2)[:, 0]
    noise = 0.002 * torch.randn(pictures.shape, generator=torch.Generator().manual_seed(0))
    return pictures + noise, torch.ones(pictures.shape, dtype=torch.bool), fine(mask[None].double(), 2)[0] > 0.5


def lies(picture, *motion):
    """The picture of a camera that moved."""
    return moved(picture[None], shifted(*motion))[0]


def test_a_picture_is_predicted_through_highlights_and_shadows_of_the_others():
    pictures, good, mask = dome()
    spoilt = pictures.clone()
    for k in range(1, 8):
        spoilt[k, 8 + 4 * k : 11 + 4 * k, 20:24] += 0.8  # a highlight that wanders
        spoilt[k, 20:24, 8 + 4 * k : 11 + 4 * k] = 0.0  # and a cast shadow
    error = (predicted(spoilt, good, VECTORS.double(), 0) - pictures[0])[mask]
    assert float(error.square().mean().sqrt()) < 0.01


def test_values_that_are_not_good_say_nothing():
    pictures, good, _ = dome()
    few = predicted(pictures[:6], good[:6], VECTORS[:6].double(), 0)
    pictures[6:], good[6:] = 50.0, False
    assert float((predicted(pictures, good, VECTORS.double(), 0) - few).abs().max()) < 1e-3


def test_only_the_picture_that_lies_elsewhere_is_moved():
    pictures, good, mask = dome()
    pictures[5] = lies(pictures[5], 0.9, -0.5)
    before = [Motion(reason="looked for") for _ in pictures]
    found = checked_among_lights(before, pictures, good, mask, VECTORS)
    assert all(new is old for k, (new, old) in enumerate(zip(found, before, strict=True)) if k != 5)
    assert found[5].applied
    assert displacement(found[5].matrix @ torch.linalg.inv(shifted(0.9, -0.5)), mask) < 0.1
    assert found[5].displacement_px == pytest.approx(math.hypot(0.9, 0.5), abs=0.1)
    assert 0.15 <= found[5].sd_px < 0.3
    assert "by the other lights' pictures" in found[5].reason


def test_a_motion_that_was_none_is_taken_back():
    pictures, good, mask = dome()
    wrong = Motion(matrix=shifted(0.4, 0.3), applied=True, model="rigid")
    found = checked_among_lights([Motion() if k != 6 else wrong for k in range(8)], pictures, good, mask, VECTORS)
    assert not found[6].applied
    assert found[6].reason.startswith("no motion beyond chance by the other lights' pictures")


def test_a_motion_that_was_found_keeps_its_rotation():
    pictures, good, mask = dome()
    middle = ((SIZE - 1) / 2, (SIZE - 1) / 2)
    pictures[4] = lies(pictures[4], 1.0, 0.0, 2.0, middle)
    off = Motion(matrix=shifted(0.5, 0.3, 2.0, middle), applied=True, model="rigid")
    found = checked_among_lights([Motion() if k != 4 else off for k in range(8)], pictures, good, mask, VECTORS)
    assert found[4].model == "rigid"
    assert found[4].rotation_deg == pytest.approx(2.0)
    assert displacement(found[4].matrix @ torch.linalg.inv(shifted(1.0, 0.0, 2.0, middle)), mask) < 0.15


@pytest.mark.parametrize("within", [0.1, 0.15])
def test_what_is_within_its_own_error_of_the_prediction_is_left(within):
    pictures, good, mask = dome()
    pictures[5] = lies(pictures[5], within, 0.0)
    before = [Motion() for _ in pictures]
    assert all(
        new is old for new, old in zip(checked_among_lights(before, pictures, good, mask, VECTORS), before, strict=True)
    )


@pytest.mark.parametrize("vectors", [None, VECTORS.flip(0)], ids=["unknown", "in another order"])
def test_lights_that_do_not_explain_the_pictures_say_nothing(vectors):
    pictures, good, mask = dome()
    pictures[5] = lies(pictures[5], 0.9, -0.5)
    before = [Motion() for _ in pictures]
    assert all(
        new is old for new, old in zip(checked_among_lights(before, pictures, good, mask, vectors), before, strict=True)
    )


def test_five_lights_are_too_few():
    pictures, good, mask = dome()
    pictures[4] = lies(pictures[4], 0.9, -0.5)
    before = [Motion() for _ in range(5)]
    found = checked_among_lights(before, pictures[:5], good[:5], mask, VECTORS[:5])
    assert all(new is old for new, old in zip(found, before, strict=True))


def test_large_pictures_are_compared_by_their_means(monkeypatch):
    pictures, good, mask = dome()
    pictures[5] = lies(pictures[5], 1.8, -1.0)
    monkeypatch.setattr(among_lights, "MOST_PIXELS", SIZE * SIZE // 4)
    found = checked_among_lights([Motion() for _ in pictures], pictures, good, mask, VECTORS)
    assert displacement(found[5].matrix @ torch.linalg.inv(shifted(1.8, -1.0)), mask) < 0.2
    assert found[5].displacement_px == pytest.approx(math.hypot(1.8, 1.0), abs=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
def test_still_wax_under_eight_lights_is_not_moved(tmp_path, known):
    """Registered against the first light's picture alone, one of the eight is moved by 0.3 px."""
    rig = make_rig("r", lights=8, basis_tilt_deg=25.0, spread_deg=(15.0, 30.0), heldout=(0, 0), sweeps=(0, 0))
    rig = replace(rig, camera=replace(rig.camera, oversample=2, bits=12, read_sigma=0.003))
    simulate(make_object("wax", size=128), rig, tmp_path / "wax", seed=SEED)
    capture = load_capture(tmp_path / "wax")
    raw = read_full(capture)
    pictures, clipped = develop_pictures(capture, raw, response_of(capture))
    if not known:
        capture = replace(
            capture, lights={name: replace(light, direction=None) for name, light in capture.lights.items()}
        )
    found = align(capture, raw.names, pictures, clipped, read_mask(capture), [])
    assert found.moved == (not known)
