import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.calibrate.develop import develop
from reflectsep.calibrate.exposure import (
    colour_of,
    developed_stream,
    exposure_ratio,
    gamma_response,
    linear_response,
    missing_darks,
    response_of,
    table_response,
)
from reflectsep.data import Encoding, Light, Sweep
from reflectsep.errors import CaptureError
from reflectsep.io.frames import open_sweep
from reflectsep.io.pictures import write_picture

from .conftest import SIZE, radiance

rising = st.lists(st.floats(0.01, 1.0), min_size=2, max_size=8)


@given(gamma=st.floats(0.4, 3.0), value=st.floats(1e-3, 2.0))
def test_gamma_is_undone_on_both_sides_of_zero(gamma, value):
    stored = torch.tensor([value, -value], dtype=torch.float64) ** 1.0
    curved = torch.sign(stored) * stored.abs() ** (1 / gamma)
    torch.testing.assert_close(gamma_response(gamma)(curved), stored)


@given(steps=rising, rises=rising, where=st.floats(-0.5, 1.5))
def test_table_meets_its_rows_and_rises_beyond_them(steps, rises, where):
    count = min(len(steps), len(rises))
    values = torch.tensor(steps[:count], dtype=torch.float64).cumsum(0)
    radiances = torch.tensor(rises[:count], dtype=torch.float64).cumsum(0)
    response = table_response(values, radiances)
    torch.testing.assert_close(response(values), radiances)
    pair = torch.tensor([where, where + 0.01], dtype=torch.float64)
    low, high = response(pair)
    assert low < high


def test_table_is_linear_between_its_rows():
    response = table_response(torch.tensor([0.0, 0.5, 1.0]), torch.tensor([0.0, 1.0, 5.0]))
    stored = torch.tensor([[0.25, 0.75], [-0.5, 1.25]])
    torch.testing.assert_close(response(stored), torch.tensor([[0.5, 3.0], [-1.0, 7.0]]))


def test_the_dark_picture_is_linearised_before_it_is_subtracted():
    light, dark = torch.full((1, 2, 2), 0.6), torch.full((1, 2, 2), 0.2)
    found = develop((light + dark) ** (1 / 2.2), gamma_response(2.2), dark ** (1 / 2.2), 3.0)
    torch.testing.assert_close(found, torch.full((1, 2, 2), 1.8))


def test_noise_below_the_dark_picture_stays_negative():
    noise = 0.01 * torch.randn(1, 100, 100, generator=torch.Generator().manual_seed(0))
    found = develop(0.1 + noise, linear_response, torch.full_like(noise, 0.1), 2.0)
    torch.testing.assert_close(found, 2 * noise, atol=1e-6, rtol=0)
    assert float(found.min()) < 0


def test_ratio_is_one_where_an_exposure_is_unknown(folder):
    capture = folder.standard().load()
    assert exposure_ratio(capture, 0.5) == 1.0
    first = replace(capture.images[0], exposure_s=0.01)
    known = replace(capture, images=(first, *capture.images[1:]))
    assert exposure_ratio(known, 0.16) == pytest.approx(1 / 16)
    assert exposure_ratio(known, None) == 1.0


def test_encoding_chooses_the_response(folder):
    capture = folder.standard().load()
    (folder.path / "curve.csv").write_text("value,radiance\n0,0\n0.5,0.1\n1,1\n")
    half = torch.tensor([0.5])
    found = [
        float(response_of(replace(capture, encoding=encoding))(half))
        for encoding in (
            Encoding(),
            Encoding(kind="gamma", gamma=2.0),
            Encoding(kind="response", response="curve.csv"),
        )
    ]
    assert found == pytest.approx([0.5, 0.25, 0.1])


@pytest.mark.parametrize("response", ["missing.csv", "../outside.csv"])
def test_bad_response_table_is_named(folder, response):
    capture = replace(folder.standard().load(), encoding=Encoding(kind="response", response=response))
    with pytest.raises(CaptureError, match=response.removeprefix("../").removesuffix(".csv")):
        response_of(capture)


def test_colour_of_lights():
    assert colour_of(Light(name="a", intensity=(2.0,)), 3) is None
    found = colour_of(Light(name="a", intensity=(2.0, 3.0, 4.0)), 3)
    torch.testing.assert_close(found, torch.tensor([2.0, 3.0, 4.0])[:, None, None])
    for intensity in ((1.0, 2.0), (1.0, 0.0, 1.0)):
        with pytest.raises(CaptureError, match="light a: intensity"):
            colour_of(Light(name="a", intensity=intensity), 3)


def sweep_of(folder, **changes):
    """Three gamma-encoded frames, exposed 16 times longer, with a dark picture of their own."""
    folder.encoding = Encoding(kind="gamma", gamma=2.2)
    folder.standard()
    folder.images = [replace(picture, exposure_s=0.01) for picture in folder.images]
    truth = [radiance((0.0, 0.0, 1.0), folder.channels) * level for level in (0.01, 0.02, 0.03)]
    for index, linear in enumerate(truth):
        if index != 1:
            write_picture(folder.path / f"sweep/{index:04d}.exr", (16 * linear + 0.05) ** (1 / 2.2))
    write_picture(folder.path / "dark_sweep.exr", torch.full_like(truth[0], 0.05) ** (1 / 2.2))
    sweep = Sweep(light="L1", exposure_s=0.16, frames="sweep/{:04d}.exr", count=3, lost=frozenset({1}))
    folder.sweeps = [replace(sweep, dark="dark_sweep.exr", position_mm=(0.0, None, 1.0), **changes)]
    return truth


def test_stream_is_developed_with_its_own_dark_and_exposure_as_often_as_wanted(folder):
    truth = sweep_of(folder)
    capture = folder.load()
    stream = developed_stream(capture, open_sweep(capture, capture.sweeps[0]))
    assert len(stream) == 3
    assert stream.sweep == capture.sweeps[0]
    for _ in range(2):
        frames = list(stream)
        assert [frame.index for frame in frames] == [0, 2]
        for frame in frames:
            torch.testing.assert_close(frame.values, truth[frame.index], atol=1e-6, rtol=1e-5)


def test_stream_of_a_coloured_light_is_divided_by_it(folder):
    folder.channels = 3
    truth = sweep_of(folder)
    folder.lights["L1"] = replace(folder.lights["L1"], intensity=(1.0, 2.0, 4.0))
    capture = folder.load()
    frame = next(iter(developed_stream(capture, open_sweep(capture, capture.sweeps[0]))))
    expected = truth[0] / torch.tensor([1.0, 2.0, 4.0])[:, None, None]
    torch.testing.assert_close(frame.values, expected, atol=1e-6, rtol=1e-5)


def test_a_frame_with_nan_is_named(folder):
    truth = sweep_of(folder)
    bad = truth[2].clone()
    bad[0, 3, 4] = math.nan
    write_picture(folder.path / "sweep/0002.exr", bad)
    capture = folder.load()
    with pytest.raises(CaptureError, match=r"sweep/0002\.exr: 1 values are not finite"):
        list(developed_stream(capture, open_sweep(capture, capture.sweeps[0])))


def test_a_dark_picture_of_other_channels_is_refused(folder):
    sweep_of(folder)
    write_picture(folder.path / "dark_sweep.exr", torch.zeros(3, SIZE, SIZE))
    capture = folder.load()
    with pytest.raises(CaptureError, match=r"sweep/0000\.exr.*dark picture \(3, 40, 40\)"):
        list(developed_stream(capture, open_sweep(capture, capture.sweeps[0])))


def test_a_sweep_without_a_dark_picture_of_its_exposure_is_told(folder):
    sweep_of(folder)
    assert missing_darks(folder.load()) == ()
    folder.sweeps = [replace(folder.sweeps[0], dark=None)]
    assert missing_darks(folder.load()) == ()  # a capture without any dark picture
    folder.dark(torch.zeros(1, SIZE, SIZE), exposure_s=0.01)
    (line,) = missing_darks(folder.load())
    assert "L1" in line
    assert "0.16 s" in line
