import json
import math
from dataclasses import dataclass

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from reflectsep.data import Light
from reflectsep.errors import LightError, ResultError
from reflectsep.io.exr import read_channels
from reflectsep.relight import (
    MARKER,
    LightMix,
    alphas_for,
    orbit,
    outside_basis,
    place_of,
    relight_to_folder,
    safe_name,
)

BASIS = torch.tensor([[0.0, 0.5, 0.9], [-0.5, -0.3, 0.8], [0.5, -0.3, 0.8]])


@dataclass
class Ramp:
    """Picture of alpha: its first number in every channel times the channel's index from 1, and the pixel's index."""

    channels: int = 3
    largest_batch: int = 0

    def relight(self, alpha):
        self.largest_batch = max(self.largest_batch, alpha.shape[0])
        pixels = torch.arange(6.0).reshape(2, 3) + 1
        scale = torch.arange(1.0, self.channels + 1)
        return alpha[..., :1, None, None] * scale[:, None, None] * pixels


@given(
    x=st.floats(-1, 1), y=st.floats(-1, 1), z=st.floats(0.1, 1), scale=st.floats(0.2, 5), intensity=st.floats(0, 100)
)
@settings(deadline=None, max_examples=50)
def test_alpha_rebuilds_direction_times_intensity(x, y, z, scale, intensity):
    basis = scale * BASIS
    mix = alphas_for([Light(name="a", direction=(x, y, z), intensity=(intensity,))], basis)["a"]
    vector = torch.tensor([x, y, z]) / math.sqrt(x * x + y * y + z * z)
    rebuilt = torch.tensor(mix.alpha) @ basis
    torch.testing.assert_close(rebuilt, intensity * vector, rtol=1e-4, atol=1e-4)


def test_a_basis_light_is_itself():
    unit = BASIS / BASIS.norm(dim=1, keepdim=True)
    lights = [Light(name=str(i), direction=tuple(map(float, unit[i]))) for i in range(3)]
    mixes = alphas_for(lights, unit)
    torch.testing.assert_close(torch.tensor([mixes[str(i)].alpha for i in range(3)]), torch.eye(3))


def test_a_coloured_light_mixes_as_a_white_one_and_colours_the_picture():
    white, coloured = (
        alphas_for([Light(name="a", direction=(0.1, 0.2, 0.9), intensity=i)], BASIS)["a"]
        for i in ((1.0,), (1.0, 2.0, 3.0))
    )
    assert coloured.alpha == white.alpha
    assert (white.colour, coloured.colour) == (None, (1.0, 2.0, 3.0))


def test_orbit_closes_and_stands_at_its_elevation():
    lights = orbit(8, 60.0, intensity=2.0)
    assert len({light.name for light in lights}) == 8
    vectors = torch.tensor([light.direction for light in lights])
    torch.testing.assert_close(vectors.norm(dim=1), torch.ones(8))
    torch.testing.assert_close(vectors[:, 2], torch.full((8,), math.sin(math.radians(60))))
    torch.testing.assert_close(vectors.mean(0)[:2], torch.zeros(2), atol=1e-6, rtol=0)
    torch.testing.assert_close(vectors[2], torch.tensor([0.0, 0.5, math.sin(math.pi / 3)]), atol=1e-6, rtol=0)
    assert lights[0].intensity == (2.0,)


@pytest.mark.parametrize(("count", "elevation"), [(0, 45), (3, -10), (3, 91), (3, math.nan)])
def test_impossible_orbit(count, elevation):
    with pytest.raises(LightError, match="orbit"):
        orbit(count, elevation)


@pytest.mark.parametrize(
    ("light", "basis", "message"),
    [
        (Light(name="a"), BASIS, "a: has no direction"),
        (Light(name="a", direction=(0, 0, 0)), BASIS, "zero or not finite"),
        (Light(name="a", direction=(0, math.nan, 1)), BASIS, "zero or not finite"),
        (Light(name="a", direction=(0, 0, 1), intensity=(-1.0,)), BASIS, "intensity"),
        (Light(name="a", direction=(0, 0, 1), intensity=(math.inf,)), BASIS, "intensity"),
        (Light(name="a", direction=(0, 0, 1)), None, "give alpha instead"),
        (Light(name="a", direction=(0, 0, 1)), torch.ones(3, 3), "coplanar"),
        (Light(name="../a", direction=(0, 0, 1)), BASIS, "cannot name a file"),
    ],
)
def test_lights_that_mean_nothing(light, basis, message):
    with pytest.raises(LightError, match=message):
        alphas_for([light], basis)


def test_no_lights_and_twins():
    with pytest.raises(LightError, match="at least one"):
        alphas_for([], BASIS)
    twins = [Light(name=n, direction=(0, 0, 1)) for n in ("a", "A")]
    with pytest.raises(LightError, match="twice"):
        alphas_for(twins, BASIS)


@pytest.mark.parametrize(
    "name", ["", ".", "..", "a/b", "a\\b", "../a", ".hidden", "a\n", "a\0b", "C:x", "x" * 121, "a."]
)
def test_names_that_leave_the_folder_or_are_no_files(name):
    with pytest.raises(LightError, match="cannot name a file"):
        safe_name(name)


@pytest.mark.parametrize("name", ["L7", "0001", "key light", "north-west_2.5", "µ"])
def test_ordinary_names_pass(name):
    assert safe_name(name) == name


@pytest.mark.parametrize(("channels", "names"), [(1, ["Y"]), (3, ["R", "G", "B"])])
def test_folder_of_pictures(tmp_path, channels, names):
    heard = []
    lights = {f"L{i}": LightMix(alpha=(0.5 * i, 0.0, 0.0)) for i in range(7)}
    subject = Ramp(channels=channels)
    files = relight_to_folder(subject, lights, tmp_path / "out", progress=lambda *a: heard.append(a), chunk=3)
    assert [f.name for f in files] == [f"L{i}.exr" for i in range(7)]
    assert subject.largest_batch == 3
    assert heard == [("relight", i, 7) for i in range(1, 8)]
    found = read_channels(files[5])
    assert sorted(found) == sorted(names)
    for index, name in enumerate(names):
        assert found[name].dtype == "float32"
        assert found[name][1, 2] == pytest.approx(5 * 0.5 * (index + 1) * 6)
    assert json.loads((tmp_path / "out" / MARKER).read_text())["lights"]["L2"] == {"alpha": [1.0, 0, 0]}


def test_values_are_not_rounded_to_half(tmp_path):
    (file,) = relight_to_folder(Ramp(channels=1), {"a": [1.0001, 0, 0]}, tmp_path / "o")
    assert read_channels(file)["Y"][0, 0] == pytest.approx(1.0001, abs=1e-7)


def test_coloured_light_scales_each_channel(tmp_path):
    (file,) = relight_to_folder(Ramp(), {"a": LightMix(alpha=(1.0, 0, 0), colour=(1.0, 2.0, 3.0))}, tmp_path / "o")
    found = read_channels(file)
    assert [found[c][0, 0] for c in "RGB"] == [1.0, 4.0, 9.0]


def test_colour_on_a_grey_result_is_refused_with_nothing_written(tmp_path):
    lights = {"a": LightMix(alpha=(1.0, 0, 0)), "b": LightMix(alpha=(1.0, 0, 0), colour=(1.0, 2.0, 3.0))}
    with pytest.raises(LightError, match="3 values for a picture of 1"):
        relight_to_folder(Ramp(channels=1), lights, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_existing_folder_is_kept_unless_told(tmp_path):
    out = tmp_path / "out"
    relight_to_folder(Ramp(), {"a": [1.0, 0, 0]}, out)
    with pytest.raises(ResultError, match="out"):
        relight_to_folder(Ramp(), {"b": [1.0, 0, 0]}, out)
    assert (out / "a.exr").exists()
    relight_to_folder(Ramp(), {"b": [1.0, 0, 0]}, out, overwrite=True)
    assert sorted(p.name for p in out.iterdir()) == ["b.exr", MARKER]


def test_a_foreign_folder_is_never_replaced(tmp_path):
    (tmp_path / "precious.txt").write_text("x")
    with pytest.raises(ResultError):
        relight_to_folder(Ramp(), {"a": [1.0, 0, 0]}, tmp_path, overwrite=True)
    assert (tmp_path / "precious.txt").read_text() == "x"


@pytest.mark.parametrize(
    ("lights", "message"),
    [
        ({}, "at least one"),
        ({"a": [1.0, 0]}, "2 numbers"),
        ({"a": [1.0, 0, math.nan]}, "finite"),
        ({"a/b": [1.0, 0, 0]}, "cannot name a file"),
        ({"a": [1.0, 0, 0], "A": [1.0, 0, 0]}, "share a name"),
        ({"a": LightMix(alpha=(3e38, 0, 0))}, "not finite"),
    ],
)
def test_bad_requests_write_nothing(tmp_path, lights, message):
    with pytest.raises(LightError, match=message):
        relight_to_folder(Ramp(), lights, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("direction", "words"),
    [
        ((0.0, 0.0, 1.0), "0° off the view, between the basis lights"),
        ((math.sin(math.radians(60)), 0.0, 0.5), "60° off the view, outside the basis lights"),
        ((0.0, 0.0, -1.0), "180° off the view, outside the basis lights"),
    ],
)
def test_a_light_is_said_to_be_between_the_basis_lights_or_outside(direction, words):
    up = math.sqrt(0.75)
    basis = torch.tensor([[0.5, 0.0, up], [-0.25, 0.433, up], [-0.25, -0.433, up]])
    alpha = alphas_for([Light(name="A", direction=direction, intensity=(1.0,))], basis)["A"].alpha
    assert place_of(alpha, basis, torch.tensor([0.0, 0.0, 1.0])) == words
    assert not outside_basis((1.0, 0.0, 0.0))
