"""Flat fields."""

from dataclasses import replace

import pytest
import torch

from reflectsep.calibrate.develop import linear_response
from reflectsep.calibrate.exposure import developed_stream
from reflectsep.calibrate.flat import flat_of
from reflectsep.calibrate.stack import calibrate_stack
from reflectsep.data import Frame, Picture, Region, Sweep
from reflectsep.errors import CaptureError
from reflectsep.io.pictures import write_picture

from .conftest import ANGLES, SIZE, direction, radiance


def falling():
    """Light that falls to a half across the field, mean 1."""
    field = torch.linspace(1.4, 0.6, SIZE)[None, None].expand(1, SIZE, SIZE)
    return field / field.mean()


def uneven(folder, light=None, level=0.7, pedestal=0.0):
    """A capture under the falling light, with a flat that shows it."""
    folder.standard()
    for name in ANGLES:
        folder.edit(name, lambda picture: picture * falling())
    write_picture(folder.path / "flat.exr", level * falling() + pedestal)
    folder.images.append(Picture(kind="flat", file="flat.exr", light=light))
    return folder


def test_uneven_light_is_divided_out(folder):
    stack, _ = calibrate_stack(uneven(folder).load())
    true = torch.stack([radiance(direction(*ANGLES[name])) for name in stack.names])
    inner = (..., slice(8, -8), slice(8, -8))
    torch.testing.assert_close(stack.images[inner], true[inner], rtol=2e-3, atol=1e-4)


def test_a_light_s_own_flat_goes_before_the_shared_one(folder):
    capture = uneven(folder, light="L2").load()
    assert flat_of(capture, "L1", linear_response) is None
    field = flat_of(capture, "L2", linear_response)
    assert field is not None
    assert float(field.mean()) == pytest.approx(1.0, abs=1e-3)


def test_its_dark_picture_is_subtracted(folder):
    uneven(folder, pedestal=0.2)
    folder.dark(torch.full((1, SIZE, SIZE), 0.2))
    field = flat_of(folder.load(), "L1", linear_response)
    assert field is not None
    torch.testing.assert_close(field[..., 8:-8], falling()[..., 8:-8], rtol=2e-3, atol=1e-4)


def test_frames_are_divided_as_well(folder):
    uneven(folder)
    folder.sweeps.append(Sweep(light="L1", frames="{}.exr", count=1))
    write_picture(folder.path / "0.exr", 0.3 * falling())
    capture = folder.load()

    class One:
        sweep = capture.sweeps[0]

        def __len__(self):
            return 1

        def __iter__(self):
            yield Frame(index=0, values=0.3 * falling())

    (frame,) = developed_stream(capture, One())
    torch.testing.assert_close(frame.values[..., 8:-8], torch.full((1, SIZE, SIZE - 16), 0.3), rtol=2e-3, atol=0)


def test_a_dark_flat_is_refused_by_name(folder):
    capture = uneven(folder, level=0.0, pedestal=0.0).load()
    with pytest.raises(CaptureError, match=r"flat\.exr: a flat field that is dark on the object"):
        flat_of(capture, "L1", linear_response)


def test_a_flat_with_a_black_corner_is_refused(folder):
    folder.standard()
    flat = torch.ones(1, SIZE, SIZE)
    flat[:, :12, :12] = 0
    write_picture(folder.path / "flat.exr", flat)
    folder.images.append(Picture(kind="flat", file="flat.exr"))
    with pytest.raises(CaptureError, match=r"flat\.exr: a flat field of 0\.0% of its mean somewhere on the object"):
        calibrate_stack(folder.load())


def test_the_flat_of_a_window_is_a_part_of_that_of_the_whole(folder):
    capture = uneven(folder, light="L2").load()
    whole = flat_of(capture, "L2", linear_response)
    region = Region(x=5, y=2, width=10, height=12)
    part = flat_of(replace(capture, region=region), "L2", linear_response)
    assert whole is not None
    assert part is not None
    assert torch.equal(part, whole[:, 2:14, 5:15])
