"""Held-out pictures: developed as the fit's were, and in their place."""

import math

import pytest
import torch

from reflectsep.calibrate.align_options import AlignOptions
from reflectsep.calibrate.heldout import held_out_pictures, still_of
from reflectsep.calibrate.motion import displacement
from reflectsep.errors import CaptureError, LightError
from reflectsep.io.stack import read_mask
from reflectsep.synth.drift import Drift, moved

from .conftest import ANGLES, SIZE, direction, radiance, simulated, truth


def test_they_are_developed_in_the_order_of_the_names(folder):
    found = held_out_pictures(folder.standard().load(), ["L5", "L1"])
    expected = torch.stack([radiance(direction(*ANGLES[n])) for n in ("L5", "L1")])
    torch.testing.assert_close(found.values, expected)
    assert found.names == ("L5", "L1")
    assert not bool(found.clipped.any())


def test_values_that_are_not_finite_count_as_clipped(folder):
    folder.standard()
    folder.edit("L5", lambda stored: stored.index_fill(2, torch.tensor([3]), math.nan))
    found = held_out_pictures(folder.load(), ["L5"])
    assert bool(found.clipped[0, 0, :, 3].all())
    assert int(found.clipped.sum()) == SIZE
    assert bool((found.values[0, 0, :, 3] == 0).all())


def test_a_picture_that_is_not_there_and_a_light_that_is_not(folder):
    capture = folder.standard().load()
    (folder.path / "full/L5.exr").unlink()
    with pytest.raises(CaptureError, match=r"L5\.exr"):
        held_out_pictures(capture, ["L5"])
    with pytest.raises(LightError, match="no full picture of light L9"):
        held_out_pictures(capture, ["L9"])
    with pytest.raises(LightError, match="no held-out lights named"):
        held_out_pictures(capture, [])


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """A printed object whose lights' pictures lie 1.5 px and 0.3 degrees apart, and the same without."""
    folder = tmp_path_factory.mktemp("held out")
    drift = Drift(across_px=1.5, across_deg=0.3)
    return simulated(folder / "drifted", drift=drift), simulated(folder / "still")


def test_they_are_put_in_the_first_pictures_place(captures):
    drifted, still = captures
    mask = read_mask(drifted)
    found = held_out_pictures(drifted, ["L5", "L6"], AlignOptions())
    left = held_out_pictures(drifted, ["L5", "L6"])
    true = held_out_pictures(still, ["L5", "L6"])
    for i, name in enumerate(found.names):
        matrix = truth(drifted, f"full/{name}").matrix
        assert displacement(matrix @ torch.linalg.inv(found.motions[i].matrix), mask) < 0.2
        inner = mask & ~found.clipped[i].any(0)
        error = [float((p.values[i] - true.values[i])[:, inner].square().mean()) for p in (found, left)]
        assert error[0] < 0.15 * error[1]  # their noise is in it


def test_what_lies_outside_the_picture_does_not_count(captures):
    drifted, _ = captures
    still = still_of(drifted, AlignOptions())
    picture = held_out_pictures(drifted, ["L1"]).values[0]
    shift = torch.eye(3, dtype=torch.float64)
    shift[0, 2] = 3.0
    values, bad, motion = still.place(moved(picture, shift), torch.zeros_like(picture, dtype=torch.bool))
    assert motion.matrix[0, 2] == pytest.approx(3.0, abs=0.05)
    assert bool(bad[..., -3:].all())
    assert not bool(bad[..., 1:-1, :-4].any())
    assert float((values - picture)[~bad].abs().max()) < 0.1 * float(picture.max())


@pytest.mark.parametrize("options", [None, AlignOptions(scope="same_light")])
def test_they_stay_where_nothing_is_registered_across_lights(captures, options):
    drifted, _ = captures
    found = held_out_pictures(drifted, ["L5"], options)
    assert not found.motions[0].applied
    assert torch.equal(found.values, held_out_pictures(drifted, ["L5"]).values)
