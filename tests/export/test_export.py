"""Exports, read back by small decoders written from the formats' descriptions."""

from __future__ import annotations

import json
import math
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.config import ExportJob
from reflectsep.errors import LightError, ResultError
from reflectsep.export.harmonics import evaluated, fit_terms, hsh_terms, ptm_terms, quantised
from reflectsep.export.lights import cap, mixes, screen_picture
from reflectsep.export.textures import rendered, textures_of
from reflectsep.io.exr import read_channels
from reflectsep.io.rti import write_ptm
from reflectsep.jobs import run_export
from reflectsep.report.tone import white_point


def decoded_ptm(path: Path):
    """A `.ptm` as a function of (u, v), by the description of PTM 1.2 (Malzbender et al., 2001)."""
    data = path.read_bytes()
    lines, at = [], 0
    while len(lines) < 6:
        end = data.index(b"\n", at)
        lines.append(data[at:end].decode())
        at = end + 1
    assert lines[0] == "PTM_1.2"
    width, height = int(lines[2]), int(lines[3])
    scale, bias = (np.array([float(word) for word in line.split()]) for line in lines[4:])
    block = 6 * width * height

    def polynomials(start):
        codes = np.frombuffer(data[start : start + block], np.uint8).reshape(height, width, 6)[::-1]
        return (codes.astype(float) - bias) * scale

    def value(terms, u, v):
        return np.clip(terms @ np.array([u * u, v * v, u * v, u, v, 1.0]), 0, 255)

    if lines[1] == "PTM_FORMAT_RGB":
        assert len(data) == at + 3 * block
        colours = [polynomials(at + k * block) for k in range(3)]
        return lambda u, v: np.stack([value(c, u, v) for c in colours]) / 255
    assert lines[1] == "PTM_FORMAT_LRGB"
    rgb = np.frombuffer(data[at + block :], np.uint8).reshape(height, width, 3)[::-1]
    terms = polynomials(at)
    return lambda u, v: (value(terms, u, v)[..., None] * rgb / 255).transpose(2, 0, 1) / 255


def decoded_relight(folder: Path):
    """`info.json` and its planes as a function of a direction, by the description of the Relight format."""
    info = json.loads((folder / "info.json").read_text())
    assert info["colorspace"] == "rgb"
    assert info["format"] == "jpg"
    count = info["nplanes"] // 3
    scale, bias = (np.array(info["materials"][0][key]).reshape(count, 3) for key in ("scale", "bias"))
    planes = [imagecodecs.jpeg8_decode((folder / f"plane_{k}.jpg").read_bytes()) / 255.0 for k in range(count)]
    assert planes[0].shape == (info["height"], info["width"], 3)

    def weights(x, y, z):
        if info["type"] == "ptm":
            return [1, x, y, x * x, x * y, y * y]
        phi, c = math.atan2(y, x), z
        g = math.sqrt(max(0.0, c - c * c))
        return [
            1 / math.sqrt(2 * math.pi),
            math.sqrt(6 / math.pi) * math.cos(phi) * g,
            math.sqrt(3 / (2 * math.pi)) * (-1 + 2 * c),
            math.sqrt(6 / math.pi) * g * math.sin(phi),
            math.sqrt(30 / math.pi) * math.cos(2 * phi) * (-c + c * c),
            math.sqrt(30 / math.pi) * math.cos(phi) * (-1 + 2 * c) * g,
            math.sqrt(5 / (2 * math.pi)) * (1 - 6 * c + 6 * c * c),
            math.sqrt(30 / math.pi) * (-1 + 2 * c) * g * math.sin(phi),
            math.sqrt(30 / math.pi) * (-c + c * c) * math.sin(2 * phi),
        ]

    def picture(direction):
        total = sum(
            w * (p - bias[k]) * scale[k] for k, (w, p) in enumerate(zip(weights(*direction), planes, strict=True))
        )
        return np.clip(total, 0, 1).transpose(2, 0, 1)

    return picture


@pytest.fixture(scope="module")
def saved(tmp_path_factory, result):
    folder = tmp_path_factory.mktemp("export")
    for name, channels in (("colour", 3), ("grey", 1)):
        result(size=40, channels=channels, n_d=1.0).save(folder / name)
    return folder


def relit(folder, direction):
    from reflectsep.separation import load

    separation = load(folder)
    white = white_point(separation.highlight_free + separation.specular, separation.mask)
    return screen_picture(separation, mixes(separation, direction[None])[0], white).numpy(), separation.mask.numpy()


def psnr(found, expected, mask):
    return -10 * math.log10(np.mean((found - expected)[:, mask] ** 2))


@pytest.mark.parametrize("name", ["colour", "grey"])
@pytest.mark.parametrize("kind", ["ptm", "relight_ptm", "relight_hsh"])
def test_a_decoder_of_the_format_sees_what_the_export_says(saved, tmp_path, name, kind):
    said = run_export(ExportJob(result=str(saved / name), format=kind, out=str(tmp_path / "out"), tilt_deg=40.0))
    record = json.loads((tmp_path / "out" / "relit.json").read_text())
    picture = decoded_relight(tmp_path / "out") if kind != "ptm" else decoded_ptm(tmp_path / "out" / f"{name}.ptm")
    errors = []
    for direction in cap(16, 40.0):
        found = picture(direction.tolist()) if kind != "ptm" else picture(*direction[:2].tolist())
        expected, mask = relit(saved / name, direction)
        errors.append(np.mean((found - expected)[:, mask] ** 2))
    assert -10 * math.log10(np.mean(errors)) == pytest.approx(record["distance_db"]["all_db"], abs=0.02)
    assert f"{record['distance_db']['all_db']:.1f} dB up to 40 degrees" in said
    assert record["distance_db"]["all_db"] > 20


def test_the_round_trip_of_a_ptm_is_its_quantisation(tmp_path):
    g = torch.Generator().manual_seed(2)
    coefficients = torch.rand(6, 3, 9, 11, generator=g, dtype=torch.float64) - 0.4
    codes, scales, biases = quantised(coefficients)
    write_ptm(tmp_path / "x.ptm", codes.numpy(), scales=scales, biases=biases)
    picture = decoded_ptm(tmp_path / "x.ptm")
    for direction in cap(8, 60.0):
        expected = evaluated(coefficients, "ptm", direction).numpy()
        # half a step of every term
        assert np.abs(picture(*direction[:2].tolist()) - expected).max() < 6 * 0.5 * max(scales) / 255


@given(st.integers(0, 2**31), st.floats(1e-3, 1e3))
def test_quantised_zero_is_zero_and_values_are_half_a_step_off(seed, size):
    plane = size * torch.randn(2, 1, 4, 5, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    plane[0, 0, 0, 0] = 0.0
    codes, scales, biases = quantised(plane)
    for k in range(2):
        back = (codes[k].double() / 255 - biases[k]) * scales[k]
        assert float((back - plane[k]).abs().max()) <= 0.5001 * scales[k] / 255
        assert round(255 * biases[k]) == pytest.approx(255 * biases[k], abs=1e-9)
    assert float((codes[0, 0, 0, 0].double() / 255 - biases[0]) * scales[0]) == pytest.approx(0.0, abs=1e-12)


def test_the_functions_are_orthonormal_over_the_hemisphere():
    directions = cap(200_000, 90.0)
    terms = hsh_terms(directions)
    gram = 2 * math.pi * terms.mT @ terms / len(directions)
    assert torch.allclose(gram, torch.eye(9, dtype=torch.float64), atol=2e-3)


def test_pictures_that_are_a_polynomial_are_fitted_exactly(result):
    class Polynomial:
        def __getattr__(self, name):
            return getattr(separation, name)

        def relight(self, alpha):
            direction = torch.nn.functional.normalize(alpha @ separation.light_vectors[:3], dim=-1)
            value = ptm_terms(direction.double()[None])[0] @ coefficients
            # undo the screen's curve, which the fit goes through
            linear = ((value + 0.055) / 1.055) ** 2.4
            return linear * torch.ones_like(separation.d[0]).double()

    separation = result(size=12)
    coefficients = torch.tensor([0.5, 0.1, -0.08, 0.05, 0.04, -0.06], dtype=torch.float64)
    found = fit_terms(Polynomial(), "ptm", white=1.0, tilt_deg=50.0)
    assert torch.allclose(found[:, 0, 5, 5], coefficients, atol=1e-6)


def test_textures_of_a_lambertian_object_render_as_relit(result):
    """With d = q N.L and no lobe beyond it the textures carry everything."""
    separation = result(size=32, n_d=1.0, softness=0.0, fresnel=0.0, ggx=False, channels=3)
    import dataclasses

    flat = dataclasses.replace(separation, s=torch.zeros_like(separation.s))
    white = white_point(flat.relight(torch.eye(3)), flat.mask)
    textures = textures_of(flat, white=white)
    direction = torch.tensor([0.1, 0.05, 0.99])
    direction = direction / direction.norm()
    expected = screen_picture(flat, mixes(flat, direction[None].double())[0], white)
    found = rendered(textures, direction)
    assert psnr(found.numpy(), expected.numpy(), flat.mask.numpy()) > 38
    assert textures.roughness == pytest.approx((2 / (4 * 14.0 + 2)) ** 0.25)


def test_texture_files_and_their_note(saved, tmp_path):
    said = run_export(ExportJob(result=str(saved / "colour"), format="textures", out=str(tmp_path / "t")))
    names = {path.name for path in (tmp_path / "t").iterdir()}
    assert {
        "base_colour.exr",
        "base_colour.png",
        "specular.exr",
        "normal.png",
        "scattering_colour.png",
        "README.txt",
    } < names
    text = (tmp_path / "t" / "README.txt").read_text()
    assert "What they cannot carry" in text
    inside = json.loads((tmp_path / "t" / "relit.json").read_text())["distance_db"]["inside_db"]
    assert f"{inside:.1f} dB" in text
    assert f"{inside:.1f} dB" in said
    assert set(read_channels(tmp_path / "t" / "base_colour.exr")) == {"R", "G", "B"}
    normal = imagecodecs.png_decode((tmp_path / "t" / "normal.png").read_bytes()) / 65535 * 2 - 1
    assert np.allclose(np.linalg.norm(normal, axis=-1), 1, atol=1e-3)
    with pytest.raises(ResultError, match="exists"):
        run_export(ExportJob(result=str(saved / "colour"), format="textures", out=str(tmp_path / "t")))


def test_without_directions_nothing_is_written(result, tmp_path):
    result(size=12, known=False).save(tmp_path / "r")
    for kind in ("relight_hsh", "textures"):
        with pytest.raises(LightError, match="no directions"):
            run_export(ExportJob(result=str(tmp_path / "r"), format=kind, out=str(tmp_path / "out")))
    assert [path.name for path in tmp_path.iterdir()] == ["r"]
