"""The turtle: what it is made of, and a capture of it by a camera that adds up several patches a pixel."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import avg_pool2d

from reflectsep.errors import SettingsError
from reflectsep.io.capture import load_capture
from reflectsep.io.exr import read_channels
from reflectsep.io.pictures import read_picture
from reflectsep.synth import transport as transport_module
from reflectsep.synth.objects import Material, from_height
from reflectsep.synth.presets import make_object
from reflectsep.synth.rig import RIGS, SimulatedCamera, direction
from reflectsep.synth.shading import local_diffuse, specular
from reflectsep.synth.simulate import simulate
from reflectsep.synth.transport import transport

SIZE, FINE = 32, 2
RIG = replace(RIGS["six"], sweep_x=("L1", "L2"), camera=SimulatedCamera(oversample=FINE))


@pytest.fixture(scope="module")
def turtle():
    return make_object("turtle", size=SIZE * FINE, channels=3)


@pytest.fixture(scope="module", params=["chord", "plane"])
def captured(turtle, request, tmp_path_factory):
    out = tmp_path_factory.mktemp("turtle") / "capture"
    return simulate(turtle, RIG, out, seed=0, distance=request.param)


def layers(folder, light):
    planes = read_channels(folder / "truth" / f"{light}.exr")
    names = {key.rsplit(".", 1)[0] for key in planes}
    return {name: np.stack([planes[f"{name}.{c}"] for c in "RGB"]) for name in names}


def test_two_glosses_each_cover_much_of_it(turtle):
    skin, shell, eye = turtle.materials
    assert shell.roughness < skin.roughness / 2
    shares = [float((turtle.patch_material == index).double().mean()) for index in range(3)]
    assert min(shares[:2]) > 0.3
    assert 0 < shares[2] < 0.05
    assert sum(eye.diffuse) + sum(eye.scattering) < 0.1 * (sum(skin.diffuse) + sum(skin.scattering))


def test_the_glaze_shines_more_sharply_than_the_wax(turtle):
    shine = specular(turtle, torch.tensor(direction(25, 90), dtype=torch.float64))
    for level, index in ((0.6, 0), (0.3, 1)):
        of_material = shine[turtle.patch_material == index]
        share = float((of_material > 0.5 * of_material.max()).double().mean())
        assert share < level
    brightest = [float(shine[turtle.patch_material == index].max()) for index in (0, 1)]
    assert brightest[1] > 5 * brightest[0]


def test_relief_is_fine_and_still_drawn_by_a_pixel():
    """Grains and growth rings are three to six pixels apart at 256 pixels: slopes alternate over that distance."""
    obj = make_object("turtle", size=256)
    slope = obj.normals[0] - avg_pool2d(obj.normals[0][None, None], 25, stride=1, padding=12)[0, 0]
    inner = avg_pool2d(obj.mask[None, None].double(), 25, stride=1, padding=12)[0, 0] == 1
    spectrum = torch.fft.rfft(torch.where(inner, slope, 0.0), dim=1).abs().square().sum(0)
    periods = 256 / torch.arange(1, len(spectrum), dtype=torch.float64)
    fine = spectrum[1:][(periods > 3) & (periods < 6)].sum()
    assert fine > 0.15 * spectrum[1:].sum()


def test_red_wanders_furthest_and_blue_least(turtle):
    made = transport(turtle, "plane")
    middle = int(turtle.points[:, :2].norm(dim=1).argmin())
    beam = torch.zeros(len(turtle.points), 1, dtype=torch.float64)
    beam[middle] = 1.0
    # Of the light that leaves, not of that which enters: albedo counts at both ends.
    even = made.spread(beam)[..., 0] / made.albedo.sqrt()
    away = (turtle.points[:, :2] - turtle.points[middle, :2]).norm(dim=1)
    red, green, blue = ((light * away).sum() / light.sum() for light in even)
    assert red > 1.2 * green > 1.2 * blue


def test_components_add_up_to_the_pictures_that_were_taken(captured):
    capture = load_capture(captured)
    assert capture.size == (SIZE, SIZE)
    for folder, names in (("full", capture.lights), ("heldout", ("L7", "L8", "L9", "L10"))):
        for name in names:
            parts = layers(captured, name)
            total = parts["specular"] + parts["local_diffuse"] + parts["scattering"]
            picture = read_picture(captured / folder / f"{name}.exr")[0].numpy()
            assert total == pytest.approx(picture, abs=1e-6)
            assert (parts["scattering"] + 1e-6 >= parts["scattering_beyond_1px"]).all()
            assert parts["specular"].max() > 0.1


def test_slab_frames_sum_to_the_picture_times_the_frames_in_which_a_point_is_lit(captured):
    for sweep in load_capture(captured).sweeps:
        frames = [read_picture(captured / sweep.frames.format(index))[0].double() for index in range(sweep.count)]
        full = read_picture(captured / f"full/{sweep.light}.exr")[0].double()
        assert (torch.stack(frames).sum(0) - 2 * full).abs().max() < 5e-6 * full.max()


def test_a_pixel_is_the_mean_of_its_patches(turtle, captured, tmp_path):
    """A camera of one patch a pixel sees the same light finer, when slab and distances are given in its pixels."""
    distance = "plane" if "plane" in (captured / "truth/simulation.json").read_text() else "chord"
    rig = replace(RIG, slab_width_px=8.0, slab_step_px=4.0, camera=SimulatedCamera())
    fine = simulate(turtle, rig, tmp_path / "fine", seed=0, distance=distance)
    for name in ("full/L1.exr", "heldout/L8.exr", "sweep/L1/0009.exr"):
        seen = avg_pool2d(read_picture(fine / name)[0][None].double(), FINE)[0]
        assert read_picture(captured / name)[0].double().numpy() == pytest.approx(seen.numpy(), abs=2e-6)
    assert np.allclose(
        avg_pool2d(torch.from_numpy(layers(fine, "L1")["scattering_beyond_2px"])[None], FINE)[0].numpy(),
        layers(captured, "L1")["scattering_beyond_1px"],
        atol=0.02,  # one pixel is two patches, but the edge of what is beyond is one patch wide in both
    )


def test_single_precision_is_nearer_than_any_camera_sees(turtle):
    made = transport(turtle, "plane")
    light = torch.rand(len(made.points), 2, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    exact, quick = made.spread(light), made.spread(light.float())
    assert quick.dtype == torch.float32
    assert (exact - quick).abs().max() < 2e-6 * exact.max()


def test_the_convolution_is_a_plain_sum_over_pairs(monkeypatch):
    """By distance in the picture plane, balanced by N.V: against the sum that the FFT stands for."""
    obj = make_object("turtle", size=28, channels=3)
    monkeypatch.setattr(transport_module, "TAIL", 40.0)  # so that nothing comes round
    made = transport(obj, "plane")
    light = torch.rand(len(made.points), 1, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    found = made.spread(light)[..., 0]
    flat = obj.points[:, :2]
    r = torch.cdist(flat, flat)
    for channel in range(3):
        root = made.albedo[channel].sqrt()
        kernel = obj.materials[0].kernels[channel](r) * (r > 0)
        entering = root * made.area.sqrt() * light[:, 0]
        expected = made.out * root / made.area.sqrt() * (kernel @ entering)
        assert found[channel] == pytest.approx(expected.numpy(), rel=1e-9, abs=1e-12)


def test_a_tint_scales_both_albedos_and_cannot_make_light():
    material = Material(name="paint", diffuse=(0.4,), scattering=(0.0,))
    flat = {"size": (6, 4), "materials": (material,)}
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    plain = from_height("plain", lambda x, y: 0 * x, **flat)
    half = from_height("half", lambda x, y: 0 * x, tint=lambda x, y: torch.full((1, 4, 6), 0.5), **flat)
    assert local_diffuse(half, up) == pytest.approx(0.5 * local_diffuse(plain, up))
    assert transport(half).albedo == pytest.approx(0.5 * transport(plain).albedo)
    with pytest.raises(SettingsError, match="a tint outside 0"):
        from_height("bright", lambda x, y: 0 * x, tint=lambda x, y: torch.full((1, 4, 6), 1.5), **flat)
