import json
import math

import numpy as np
import pytest
import torch

from reflectsep.data import Light
from reflectsep.errors import LightError, SettingsError
from reflectsep.io.capture import load_capture
from reflectsep.io.exr import read_channels
from reflectsep.io.pictures import read_picture
from reflectsep.synth.paper import PaperObject, paper_alpha, paper_picture, paper_rig, paper_truth, simulate_paper


def planes(folder, file, name):
    channels = read_channels(folder / "truth" / file)
    return np.stack([channels[f"{name}.{c}"] for c in ("RGB" if f"{name}.R" in channels else "Y")]).astype(np.float64)


def light_vectors(folder):
    manifest = json.loads((folder / "capture.json").read_text())["lights"]
    manifest |= json.loads((folder / "heldout.json").read_text())["lights"]
    return {name: np.array(entry["direction"]) * entry.get("intensity", 1.0) for name, entry in manifest.items()}


def scalar(value, exponent):
    return value**exponent if value > 0 else 0.0


@pytest.mark.parametrize(("channels", "n_d"), [(1, 1.0), (3, 1.0), (1, 0.8), (1, 1.3)])
def test_pictures_are_the_formula_at_every_pixel(tmp_path, channels, n_d):
    obj = PaperObject(size=12, channels=channels, n_d=n_d)
    out = simulate_paper(obj, paper_rig(6), tmp_path / "c", seed=0)
    facts = json.loads((out / "truth/parameters.json").read_text())
    lights = light_vectors(out)
    basis = np.array([lights[name] for name in ("L1", "L2", "L3")])
    d, s = (np.stack([planes(out, "parameters.exr", f"{p}{k}") for k in (1, 2, 3)]) for p in "ds")
    B = planes(out, "parameters.exr", "B")
    a = [facts["C_1"] * vector[2] for vector in basis]
    assert facts["a"] == pytest.approx(a)
    assert max(a) < 0 < facts["C_2"]
    for name, vector in lights.items():
        alpha = np.linalg.solve(basis.T, vector)
        assert facts["alpha"][name] == pytest.approx(alpha, abs=1e-9)
        file = out / ("full" if int(name[1:]) <= 6 else "heldout") / f"{name}.exr"
        picture = read_picture(file)[0].numpy()
        for c, row, column in [(0, 0, 0), (channels - 1, 3, 7), (0, 11, 2), (0, 6, 6), (channels - 1, 11, 11)]:
            here = [(float(d[k, c, row, column]), float(s[k, c, row, column])) for k in range(3)]
            b = float(B[c, row, column])
            base = sum(alpha[k] * (here[k][0] + here[k][1]) for k in range(3))
            lobe = sum(alpha[k] * (a[k] + b * here[k][0]) for k in range(3))
            expected = scalar(base, n_d) + scalar(lobe, facts["n_s"])
            assert picture[c, row, column] == pytest.approx(expected, rel=2e-5, abs=1e-6)


@pytest.mark.parametrize("lights", [6, 12, 50])
def test_the_scene_is_one_that_can_be_recovered(lights):
    rig = paper_rig(lights)
    truth = paper_truth(PaperObject(), rig)
    alpha = paper_alpha((*rig.lights, *rig.heldout))
    made = [paper_picture(truth, mix) for mix in alpha]
    assert 0.9 < max(float(picture.full.max()) for picture in made) < 1.2
    seen = (torch.stack([picture.specular for picture in made[:lights]]) > 0.02).sum(0)
    assert (seen >= 2).double().mean() > 0.7
    assert len(rig.heldout) == 3
    assert (alpha[lights:] > 0).all()
    tilts = [math.degrees(math.acos(light.direction[2])) for light in rig.lights]
    assert min(tilts) >= 15 - 1e-9
    assert max(tilts) <= 30 + 1e-9
    spread = (truth.B * truth.d.mean(0)).log().std()
    assert 0.02 < spread < 0.25
    assert truth.s.min() > 0


def test_d_is_negative_where_the_surface_faces_away():
    steep = paper_rig(6)
    low = (Light(name="L1", direction=(0.0, 0.996, 0.087)), *steep.lights[1:])
    truth = paper_truth(PaperObject(size=24), type(steep)(name="low", lights=low))
    facing = torch.einsum("x,xhw->hw", torch.tensor(low[0].direction, dtype=torch.float64), truth.surface.normals)
    assert (facing < 0).any()
    assert torch.equal(truth.d[0, 0] < 0, facing < 0)
    mix = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    assert paper_picture(truth, mix).local_diffuse[0][facing < 0].max() == 0


@pytest.mark.parametrize("n_d", [1.0, 0.7])
def test_roots_of_frames_sum_to_the_root_of_the_picture(tmp_path, n_d):
    out = simulate_paper(PaperObject(size=16, n_d=n_d), paper_rig(6, sweeps=3), tmp_path / "c", seed=0)
    capture = load_capture(out)
    assert len(capture.sweeps) == 3
    for sweep in capture.sweeps:
        frames = [read_picture(out / sweep.frames.format(i))[0].double() for i in range(sweep.count)]
        total = sum(frame ** (1 / n_d) for frame in frames)
        full = read_picture(out / f"full/{sweep.light}.exr")[0].double()
        assert total == pytest.approx(2 * full ** (1 / n_d), rel=1e-5)
        assert min(float(frame.min()) for frame in frames) > 0
        # Where no slab is, a frame is a part of the scattering.
        s = torch.from_numpy(planes(out, "scattering.exr", sweep.light))
        assert (frames[0] ** (1 / n_d) < s).all()
        # Most of the scattering arrives while the pixel is not lit (its two brightest frames): it can be measured.
        measured = (total - (torch.stack(frames) ** (1 / n_d)).topk(2, dim=0).values.sum(0)) / 2
        assert (measured < s).all()
        assert (measured > 0.5 * s).all()


def test_the_scattering_is_written_for_every_light(tmp_path):
    out = simulate_paper(PaperObject(size=12), paper_rig(7), tmp_path / "c", seed=0)
    alpha = json.loads((out / "truth/parameters.json").read_text())["alpha"]
    roots = [planes(out, "parameters.exr", f"s{k}") for k in (1, 2, 3)]
    for name in (f"L{k}" for k in range(1, 8)):
        mixed = sum(weight * root for weight, root in zip(alpha[name], roots, strict=True))
        assert planes(out, "scattering.exr", name) == pytest.approx(mixed, abs=1e-6)


def test_noise_is_of_its_sigma_and_only_in_the_capture(tmp_path):
    quiet, noisy = (
        simulate_paper(PaperObject(), paper_rig(6, sigma=sigma), tmp_path / str(sigma), seed=5) for sigma in (0.0, 0.01)
    )
    error = [read_picture(noisy / f"full/L{k}.exr")[0] - read_picture(quiet / f"full/L{k}.exr")[0] for k in range(1, 7)]
    assert float(torch.stack(error).std()) == pytest.approx(0.01, rel=0.03)
    assert abs(float(torch.stack(error).mean())) < 5 * 0.01 / math.sqrt(6 * 64 * 64)
    for file in ("heldout/L7.exr", "truth/parameters.exr", "truth/L1.exr"):
        assert (quiet / file).read_bytes() == (noisy / file).read_bytes()


def test_coplanar_basis_lights_are_refused():
    lights = tuple(Light(name=f"L{k}", direction=(0.1 * k, 0.0, 1.0)) for k in range(3))
    with pytest.raises(LightError, match=r"condition number .* coplanar"):
        paper_alpha(lights)


@pytest.mark.parametrize("change", [{"n_s": -1.0}, {"C_1": 0.5}, {"n_d": 0.0}, {"scattering": -0.1}, {"size": 4}])
def test_impossible_models_are_refused(change):
    with pytest.raises(SettingsError, match="paper object"):
        PaperObject(**change)
