import math
from dataclasses import replace

import pytest
import torch

from reflectsep.calibrate.alpha import report_alpha
from reflectsep.calibrate.stack import build_stack, calibrate_stack, without
from reflectsep.data import Encoding
from reflectsep.errors import CaptureError, LightError
from reflectsep.flags import Flag
from reflectsep.io.pictures import write_picture

from .conftest import ANGLES, SIZE, direction, radiance


def test_stack_of_a_plain_capture(folder):
    stack, report = calibrate_stack(folder.standard().load())
    assert stack.names == tuple(ANGLES)
    torch.testing.assert_close(stack.images[3], radiance(direction(*ANGLES["L4"])))
    vectors = torch.tensor([direction(*angles) for angles in ANGLES.values()])
    torch.testing.assert_close(stack.light_vectors, vectors, atol=1e-6, rtol=0)
    torch.testing.assert_close(stack.alpha @ vectors[:3], vectors, atol=1e-6, rtol=0)
    assert bool(stack.mask.all())
    assert int(stack.flags.abs().max()) == 0
    assert max(a.angle_deg for a in report.agreement) < 0.05
    assert report.source == ("basis",) * 3 + ("vectors",) * 4


def test_response_dark_and_exposure_bring_every_picture_to_one_scale(folder):
    truth = {name: radiance(direction(*angles)) for name, angles in ANGLES.items()}
    folder.standard()
    folder.images = []
    folder.encoding = Encoding(kind="gamma", gamma=2.2)
    for index, (name, linear) in enumerate(truth.items()):
        long = 2.0 if index % 2 else 1.0
        folder.picture(name, (long * linear + 0.04 * long) ** (1 / 2.2), exposure_s=0.01 * long)
    for long in (1.0, 2.0):
        stored = torch.full((1, SIZE, SIZE), 0.04 * long) ** (1 / 2.2)
        folder.dark(stored, exposure_s=0.01 * long, file=f"dark{long:g}.exr")
    stack = build_stack(folder.load())
    torch.testing.assert_close(stack.images, torch.stack(list(truth.values())), atol=2e-6, rtol=1e-5)


def test_scalar_intensity_goes_into_vector_and_alpha(folder):
    folder.standard()
    folder.lights["L5"] = replace(folder.lights["L5"], intensity=(3.0,))
    folder.edit("L5", lambda stored: 3.0 * stored)
    stack, report = calibrate_stack(folder.load())
    assert float(stack.light_vectors[4].norm()) == pytest.approx(3.0, rel=1e-5)
    torch.testing.assert_close(stack.images[4], 3.0 * radiance(direction(*ANGLES["L5"])))
    assert abs(report.agreement[1].magnitude_percent) < 0.5


def test_coloured_intensity_is_divided_out(folder):
    folder.channels = 3
    folder.standard()
    colour = torch.tensor([1.0, 2.0, 4.0])
    folder.lights["L4"] = replace(folder.lights["L4"], intensity=(1.0, 2.0, 4.0))
    folder.edit("L4", lambda stored: stored * colour[:, None, None])
    stack = build_stack(folder.load())
    torch.testing.assert_close(stack.images[3], radiance(direction(*ANGLES["L4"]), 3))
    assert float(stack.light_vectors[3].norm()) == pytest.approx(1.0, rel=1e-5)


def test_a_pixel_that_is_not_finite_is_zero_flagged_and_left_out(folder):
    folder.standard()

    def spoil(stored):
        stored[0, 5, 6] = math.nan
        stored[0, 7, 8] = math.inf
        return stored

    folder.edit("L6", spoil)
    stack = build_stack(folder.load())
    bad = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    bad[5, 6] = bad[7, 8] = True
    assert bool(((stack.flags & int(Flag.INVALID_INPUT)) > 0).eq(bad).all())
    assert bool(stack.mask.eq(~bad).all())
    assert bool((stack.images[:, :, bad] == 0).all())
    assert bool(torch.isfinite(stack.images).all())


def test_clipped_and_outside_pixels_are_flagged(folder):
    folder.standard()
    folder.images = []
    mask = torch.ones(1, SIZE, SIZE)
    mask[:, :4] = 0
    write_picture(folder.path / "mask.png", mask)
    folder.mask = "mask.png"
    for name, angles in ANGLES.items():
        stored = radiance(direction(*angles))
        stored[0, 10, 10] = 2.0 if name == "L2" else 0.3
        stored[0, 0, 0] = 2.0
        file = f"full/{name}.png"
        write_picture(folder.path / file, stored, bits=16)
        folder.picture(name, stored)
        folder.images[-1] = replace(folder.images[-1], file=file)
    stack = build_stack(folder.load())
    assert int(stack.flags[10, 10]) == int(Flag.SATURATED)
    assert bool(stack.saturated[1, 0, 10, 10])
    assert int(stack.saturated[:, 0, 10, 10].sum()) == 1
    assert int(stack.flags[0, 0]) == int(Flag.OUTSIDE_MASK)
    assert int(stack.flags[20, 20]) == 0
    assert bool(stack.mask.eq(mask[0] > 0).all())


def test_dropped_lights_are_out_of_the_stack(folder):
    capture = folder.standard().load()
    stack = build_stack(capture, drop=["L5"])
    assert stack.names == ("L1", "L2", "L3", "L4", "L6", "L7")


def test_dropped_pictures_are_not_read(folder):
    capture = folder.standard().load()
    (folder.path / "full/L5.exr").unlink()
    build_stack(capture, drop=["L5"])


@pytest.mark.parametrize(
    ("drop", "message"),
    [
        (["L2"], "L2 is of the basis"),
        (["l4"], "no full picture of light l4; did you mean L4"),
        (["L5", "L6"], "5 full pict"),
    ],
)
def test_wrong_drops(folder, drop, message):
    with pytest.raises(LightError, match=message):
        build_stack(folder.standard().load(), drop=drop)


def test_number_of_pictures_is_an_argument(folder):
    capture = folder.standard().load()
    with pytest.raises(LightError, match=r"7 full pictures \(L1.*expected at least 8"):
        build_stack(capture, minimum=8)
    assert len(build_stack(capture, drop=["L4", "L5"], minimum=5).names) == 5


def test_sweeps_and_darks_survive_a_drop(folder):
    folder.standard().dark(torch.zeros(1, SIZE, SIZE))
    capture = without(folder.load(), ["L7"])
    assert [picture.kind for picture in capture.images].count("dark") == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda stored: stored.index_fill(1, torch.arange(2, SIZE), math.nan), r"L3\.exr: not one finite value on"),
        (lambda stored: torch.full_like(stored, 0.01), r"L3\.exr: nothing on the object is brighter"),
    ],
)
def test_pictures_that_say_nothing(folder, change, message):
    folder.standard().dark(torch.full((1, SIZE, SIZE), 0.02))
    for name in ANGLES:
        folder.edit(name, lambda stored: stored + 0.02)
    folder.edit("L3", change)
    mask = torch.ones(1, SIZE, SIZE)
    mask[:, :2] = 0
    write_picture(folder.path / "mask.png", mask)
    folder.mask = "mask.png"
    with pytest.raises(CaptureError, match=message) as caught:
        build_stack(folder.load())
    assert "\n" not in str(caught.value)


def test_bad_pixels_everywhere_but_never_together(folder):
    folder.standard()
    folder.edit("L1", lambda stored: stored.index_fill(1, torch.arange(20), math.nan))
    folder.edit("L2", lambda stored: stored.index_fill(1, torch.arange(20, SIZE), math.nan))
    with pytest.raises(CaptureError, match="no pixel of the object is finite in all 7"):
        build_stack(folder.load())


def test_coplanar_basis_is_refused(folder):
    folder.standard()
    folder.lights["L3"] = replace(folder.lights["L3"], direction=direction(10, 90))
    folder.lights["L2"] = replace(folder.lights["L2"], direction=direction(20, 270))
    with pytest.raises(LightError, match="condition number"):
        build_stack(folder.load())


def test_unknown_lights_come_from_the_pictures(folder):
    folder.standard().forget("L5")
    stack, report = calibrate_stack(folder.load())
    assert report.source[4] == "pictures"
    expected = torch.tensor(direction(*ANGLES["L5"]))
    torch.testing.assert_close(stack.light_vectors[4], expected, atol=5e-3, rtol=0)
    folder.forget("L1")
    assert build_stack(folder.load()).light_vectors is None


def test_the_report_can_be_had_again_from_the_stack(folder):
    capture = folder.standard().load()
    stack, report = calibrate_stack(capture)
    again = report_alpha(stack, list(capture.lights.values()))
    assert again.agreement == report.agreement
    torch.testing.assert_close(again.alpha, report.alpha)
