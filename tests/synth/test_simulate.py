import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from reflectsep.data import Light
from reflectsep.errors import LightError, ResultError, SettingsError
from reflectsep.io.capture import load_capture
from reflectsep.io.exr import read_channels
from reflectsep.io.lights import read_lights
from reflectsep.io.pictures import read_picture
from reflectsep.io.stack import read_dark, read_full, read_mask, read_sweep_dark
from reflectsep.synth.presets import make_object
from reflectsep.synth.rig import RIGS, SimulatedCamera
from reflectsep.synth.simulate import illuminate, simulate
from reflectsep.synth.transport import transport

RIG = replace(RIGS["six"], slab_width_px=6.0, slab_step_px=2.0, sweep_x=("L1", "L2"), sweep_y=("L3",))


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """A colour pudding, free of noise."""
    out = tmp_path_factory.mktemp("clean") / "capture"
    return simulate(make_object("pudding", size=32, channels=3), RIG, out, seed=1)


def frames_of(folder, sweep):
    return [read_picture(folder / sweep.frames.format(i))[0].double() for i in range(sweep.count)]


def layer(folder, light, name):
    channels = read_channels(folder / "truth" / f"{light}.exr")
    return np.stack([channels[f"{name}.{c}"] for c in ("RGB" if f"{name}.R" in channels else "Y")])


def test_frames_sum_to_the_full_picture_times_the_frames_in_which_a_point_is_lit(clean):
    capture = load_capture(clean)
    assert [(s.light, s.direction) for s in capture.sweeps] == [("L1", "x"), ("L2", "x"), ("L3", "y")]
    for sweep in capture.sweeps:
        full = read_picture(clean / f"full/{sweep.light}.exr")[0].double()
        total = torch.stack(frames_of(clean, sweep)).sum(0)
        # Each frame is stored in float32: 24 bits of the largest.
        assert (total - 3 * full).abs().max() < 1e-6


def test_a_longer_slab_exposure_is_part_of_the_gain(tmp_path):
    rig = replace(RIG, sweep_x=("L1",), sweep_y=(), camera=SimulatedCamera(slab_exposure_s=0.04))
    out = simulate(make_object("wax", size=24), rig, tmp_path / "c", seed=0)
    (sweep,) = load_capture(out).sweeps
    total = torch.stack(frames_of(out, sweep)).sum(0)
    full = read_picture(out / "full/L1.exr")[0].double()
    assert total == pytest.approx(12 * full, abs=1e-5)
    assert json.loads((out / "truth/simulation.json").read_text())["gain"] == pytest.approx(12)


def test_the_parts_sum_to_the_picture_and_more_distance_leaves_less(clean):
    for name in (*(f"L{k}" for k in range(1, 7)),):
        parts = sum(layer(clean, name, part) for part in ("specular", "local_diffuse", "scattering"))
        assert parts == pytest.approx(read_picture(clean / f"full/{name}.exr")[0].numpy(), abs=1e-6)
        reach = [layer(clean, name, f"scattering{tail}") for tail in ("", "_beyond_1px", "_beyond_2px")]
        assert (reach[0] >= reach[1]).all()
        assert (reach[1] >= reach[2]).all()
        assert reach[2].max() > 0.1 * reach[0].max()


def test_a_point_that_the_slab_does_not_light_shows_scattering_alone(clean):
    capture = load_capture(clean)
    sweep = capture.sweeps[0]
    scattering = torch.from_numpy(layer(clean, sweep.light, "scattering")).double()
    full = read_picture(clean / f"full/{sweep.light}.exr")[0].double()
    direct = full - scattering
    frames = torch.stack(frames_of(clean, sweep))
    # Where a frame shows less than the direct light alone, its pixel was not lit: what is there is scattering.
    unlit = frames < 0.999 * direct
    assert unlit.double().mean() > 0.3
    assert (frames <= scattering + 1e-6)[unlit].all()


def test_lights_superpose_and_scale():
    obj = make_object("wax", size=24)
    made = transport(obj)
    a = illuminate(obj, made, Light(name="a", direction=(0.3, 0.2, 0.933), intensity=(1.0,)))
    b = illuminate(obj, made, Light(name="b", direction=(-0.4, 0.1, 0.911), intensity=(1.0,)))
    double = illuminate(obj, made, Light(name="c", direction=(0.3, 0.2, 0.933), intensity=(2.0,)))
    assert double.direct == pytest.approx(2 * a.direct)
    alone = [made.spread(light.entering[:, None]) for light in (a, b)]
    both = made.spread((a.entering + b.entering)[:, None])
    assert both == pytest.approx(alone[0] + alone[1], abs=1e-12)


def test_intensity_by_channel_scales_each(tmp_path):
    obj = make_object("wax", size=20, channels=3)
    lights = (replace(RIG.lights[0], intensity=(1.0, 0.5, 0.25)), *RIG.lights[1:])
    plain, tinted = (
        read_picture(simulate(obj, rig, tmp_path / name, seed=0) / "full/L1.exr")[0]
        for name, rig in (
            ("p", replace(RIG, sweep_x=(), sweep_y=())),
            ("t", replace(RIG, lights=lights, sweep_x=(), sweep_y=())),
        )
    )
    ratio = (tinted / plain)[:, 5:15, 5:15].mean((1, 2))
    assert (ratio / ratio[0]).tolist() == pytest.approx([1.0, 0.5, 0.25], rel=1e-5)


def test_plastic_has_no_scattering_and_dark_frames_away_from_the_slab(tmp_path):
    out = simulate(make_object("plastic", size=32), replace(RIG, sweep_y=()), tmp_path / "c", seed=0)
    for tail in ("", "_beyond_1px", "_beyond_2px"):
        assert not layer(out, "L1", f"scattering{tail}").any()
    sweep = load_capture(out).sweeps[0]
    lit = torch.stack(frames_of(out, sweep))[:, 0] > 0
    full = read_picture(out / "full/L1.exr")[0][0] > 0
    assert (lit.sum(0)[full] == 3).all()


def test_the_capture_is_one_that_can_be_loaded(clean):
    capture = load_capture(clean)
    raw = read_full(capture)
    assert raw.names == tuple(f"L{k}" for k in range(1, 7))
    assert raw.values.shape == (6, 3, 32, 32)
    obj = make_object("pudding", size=32, channels=3)
    assert torch.equal(read_mask(capture), obj.mask)
    assert capture.size == (32, 32)
    assert raw.values[:, :, ~obj.mask].abs().max() == 0
    lights = read_lights(clean / "heldout.json")
    assert set(lights) == {"L7", "L8", "L9", "L10"}
    for name, light in lights.items():
        expected = {held.name: held.direction for held in RIG.heldout}[name]
        assert light.direction == pytest.approx(expected)
        parts = sum(layer(clean, name, part) for part in ("specular", "local_diffuse", "scattering"))
        assert parts == pytest.approx(read_picture(clean / f"heldout/{name}.exr")[0].numpy(), abs=1e-6)


def test_geometry_is_written(clean):
    planes = read_channels(clean / "truth/geometry.exr")
    obj = make_object("pudding", size=32, channels=3)
    for axis, plane in zip("XYZ", obj.normals, strict=True):
        assert planes[f"normal.{axis}"] == pytest.approx(plane.numpy(), abs=1e-6)
    assert planes["depth"] == pytest.approx(obj.z.numpy(), abs=1e-5)
    assert (planes["material"] == obj.material.numpy()).all()


def test_the_brightest_thousandth_of_the_pictures_starts_at_the_peak(tmp_path):
    rig = replace(RIG, sweep_x=(), sweep_y=(), camera=SimulatedCamera(peak=0.8))
    obj = make_object("wax", size=48)
    out = simulate(obj, rig, tmp_path / "c", seed=0)
    values = read_full(load_capture(out)).values[:, 0, obj.mask]
    assert float((values > 0.8).double().mean()) == pytest.approx(0.001, abs=2 / values.numel())


def test_the_same_seed_makes_the_same_files_and_another_only_other_noise(tmp_path):
    camera = SimulatedCamera(full_well_e=5000.0, read_sigma=0.002, dark_level=0.02, bits=12)
    rig = replace(RIG, sweep_x=("L1",), sweep_y=(), camera=camera)
    obj = make_object("wax", size=20)
    sums = []
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        out = simulate(obj, rig, tmp_path / name, seed=seed)
        sums.append(
            {
                str(file.relative_to(out)): hashlib.sha256(file.read_bytes()).hexdigest()
                for file in sorted(out.rglob("*"))
                if file.is_file()
            }
        )
    assert sums[0] == sums[1]
    assert sums[0]["full/L1.png"] != sums[2]["full/L1.png"]
    assert sums[0]["truth/L1.exr"] == sums[2]["truth/L1.exr"]


def test_dark_pictures_take_away_what_is_not_light(tmp_path):
    camera = SimulatedCamera(slab_exposure_s=0.02, peak=0.4, dark_level=0.03, ambient_per_s=1.5, bits=16)
    rig = replace(RIG, sweep_x=("L1",), sweep_y=(), camera=camera)
    out = simulate(make_object("wax", size=24), rig, tmp_path / "c", seed=0)
    capture = load_capture(out)
    sweep = capture.sweeps[0]
    dark, sweep_dark = read_dark(capture, 0.01), read_sweep_dark(capture, sweep)
    assert dark is not None
    assert sweep_dark is not None
    assert dark == pytest.approx(torch.full((1, 24, 24), 0.045), abs=1e-5)
    assert sweep_dark == pytest.approx(torch.full((1, 24, 24), 0.06), abs=1e-5)
    full = read_picture(out / "full/L1.png")[0] - dark
    parts = sum(layer(out, "L1", part) for part in ("specular", "local_diffuse", "scattering"))
    assert full.numpy() == pytest.approx(parts, abs=2e-5)
    total = sum(frame - sweep_dark for frame in frames_of(out, sweep))
    assert total == pytest.approx(2 * 3 * full.double(), abs=sweep.count * 2e-5)


def test_gamma_is_named_in_the_manifest(tmp_path):
    rig = replace(RIG, sweep_x=(), sweep_y=(), camera=SimulatedCamera(gamma=2.2))
    out = simulate(make_object("wax", size=20), rig, tmp_path / "c", seed=0)
    assert load_capture(out).encoding.gamma == 2.2


def test_fft_and_chord_captures_say_which_they_are_and_both_keep_the_sum(tmp_path):
    rig = replace(RIG, sweep_x=("L2",), sweep_y=())
    out = simulate(make_object("wax", size=24), rig, tmp_path / "c", seed=0, distance="plane")
    assert json.loads((out / "truth/simulation.json").read_text())["distance"] == "plane"
    sweep = load_capture(out).sweeps[0]
    total = torch.stack(frames_of(out, sweep)).sum(0)
    assert (total - 3 * read_picture(out / "full/L2.exr")[0]).abs().max() < 1e-6


def test_an_existing_capture_is_kept_unless_overwritten(tmp_path):
    obj, rig = make_object("plastic", size=16), replace(RIG, sweep_x=(), sweep_y=())
    out = simulate(obj, rig, tmp_path / "c", seed=0)
    with pytest.raises(ResultError):
        simulate(obj, rig, out, seed=1)
    assert simulate(obj, rig, out, seed=1, overwrite=True) == out


def test_a_colour_light_on_a_grey_object_is_refused_and_nothing_is_left(tmp_path):
    rig = replace(RIG, lights=(replace(RIG.lights[0], intensity=(1.0, 0.5, 0.2)), *RIG.lights[1:]))
    with pytest.raises(SettingsError, match="light L1: intensity of 3 channels, but wax has 1"):
        simulate(make_object("wax", size=16), rig, tmp_path / "c", seed=0)
    assert not list(tmp_path.iterdir())
    with pytest.raises(LightError):
        replace(RIG, lights=(Light(name="L1"), *RIG.lights[1:]))


def test_progress_ends_each_stage(tmp_path):
    told = {}
    rig = replace(RIG, sweep_y=())
    simulate(
        make_object("wax", size=16),
        rig,
        tmp_path / "c",
        seed=0,
        progress=lambda stage, done, total: told.setdefault(stage, []).append((done, total)),
    )
    assert list(told) == ["lights", "transport", "frames"]
    for steps in told.values():
        assert [done for done, _ in steps] == list(range(1, steps[-1][1] + 1))


@pytest.mark.slow
def test_a_large_colour_capture_is_made_by_fft_in_little_memory(tmp_path):
    obj = make_object("wax", size=256, channels=3)
    rig = replace(RIG, slab_width_px=24.0, slab_step_px=8.0, sweep_x=("L1",), sweep_y=())
    out = simulate(obj, rig, tmp_path / "c", seed=0)
    assert json.loads((out / "truth/simulation.json").read_text())["distance"] == "plane"
    sweep = load_capture(out).sweeps[0]
    total = sum(frames_of(out, sweep))
    assert (total - 3 * read_picture(out / "full/L1.exr")[0]).abs().max() < 1e-5
