import pytest
import torch

from reflectsep.errors import SettingsError
from reflectsep.synth.kernels import ExponentialKernel
from reflectsep.synth.objects import Material, from_height, grid
from reflectsep.synth.presets import OBJECTS, make_object

GREY = Material(name="grey", diffuse=(0.5,), scattering=(0.0,))


def test_x_grows_to_the_right_and_y_upwards_from_the_middle():
    x, y = grid(4, 3)
    assert x[0].tolist() == [-1.5, -0.5, 0.5, 1.5]
    assert y[:, 0].tolist() == [1.0, 0.0, -1.0]


def test_a_tilted_plane_has_its_normal_everywhere():
    plane = from_height("plane", lambda x, y: 0.5 * x - 0.25 * y, size=(7, 5), materials=(GREY,))
    expected = torch.tensor([-0.5, 0.25, 1.0], dtype=torch.float64)
    expected = expected / expected.norm()
    assert plane.normals.permute(1, 2, 0).reshape(-1, 3) == pytest.approx(expected.expand(35, 3), abs=1e-9)


def test_a_sphere_has_its_normals_and_no_patch_beyond_the_steepest():
    def cap(x, y):
        inside = 400 - x.square() - y.square()
        return torch.where(inside > 0, inside.clamp_min(0).sqrt(), torch.nan)

    ball = from_height("ball", cap, size=(48, 48), materials=(GREY,))
    assert ball.patch_normals == pytest.approx(ball.points / 20, abs=1e-5)
    assert 0.18 < float(ball.patch_normals[:, 2].min()) < 0.35


@pytest.mark.parametrize("name", sorted(OBJECTS))
@pytest.mark.parametrize("channels", [1, 3])
def test_presets_are_whole_objects_inside_their_picture(name, channels):
    obj = make_object(name, size=48, channels=channels, seed=3)
    assert obj.channels == channels
    assert 0.4 < obj.mask.double().mean() < 0.8
    border = torch.cat([obj.mask[0], obj.mask[-1], obj.mask[:, 0], obj.mask[:, -1]])
    assert not border.any()
    assert obj.normals.norm(dim=0) == pytest.approx(torch.ones(48, 48), abs=1e-9)
    present = set(obj.patch_material.tolist())
    assert present == set(range(len(obj.materials)))
    scatters = any(max(material.scattering) > 0 for material in obj.materials)
    assert scatters == (name != "plastic")


def test_the_label_is_of_paper_with_ink_inside_and_less_translucent_than_the_pudding():
    obj = make_object("pudding", size=96)
    body, paper, _ = obj.materials
    assert paper.scattering[0] < body.scattering[0] / 2
    assert paper.diffuse[0] > body.diffuse[0] * 5
    label = (obj.material >= 1).nonzero()
    (top, left), (bottom, right) = label.min(0).values.tolist(), label.max(0).values.tolist()
    assert (obj.material[top : bottom + 1, left : right + 1] >= 1).all()
    printed = (obj.material == 2)[top : bottom + 1, left : right + 1].double().mean()
    assert 0.15 < printed < 0.6


def test_lengths_scale_with_the_picture():
    small, large = (make_object("wax", size=size).materials[0].kernels[0].reach_px for size in (48, 96))
    assert large == pytest.approx(2 * small)


def test_seeds_change_the_bumps():
    first, again, second = (make_object("wax", size=32, seed=seed).z for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, second)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"name": "waxx"}, "'waxx' is not known, expected one of marble, plastic"),
        ({"name": "wax", "size": 8}, "size 8 px, expected at least 16"),
        ({"name": "wax", "channels": 2}, "2 channels, expected 1"),
    ],
)
def test_impossible_presets_are_refused(arguments, says):
    with pytest.raises(SettingsError, match=says):
        make_object(**arguments)


@pytest.mark.parametrize(
    ("material", "says"),
    [
        ({"diffuse": (0.6,), "scattering": (0.5,)}, "diffuse 0.6 and scattering 0.5"),
        ({"diffuse": (0.1,), "scattering": (0.5,)}, "0 kernels, expected 1"),
        ({"diffuse": (0.1,), "scattering": (0.0,), "roughness": 0.0}, "roughness 0"),
        (
            {"diffuse": (float("nan"),), "scattering": (0.1,), "kernels": (ExponentialKernel((1.0,), (1.0,)),)},
            "diffuse nan",
        ),
    ],
)
def test_impossible_materials_are_refused(material, says):
    with pytest.raises(SettingsError, match=says):
        Material(name="odd", **material)


def test_an_object_outside_its_picture_is_refused():
    with pytest.raises(SettingsError, match="mask is empty"):
        from_height("none", lambda x, y: torch.full_like(x + y, torch.nan), size=(8, 8), materials=(GREY,))
