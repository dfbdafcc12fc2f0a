import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from reflectsep.synth.objects import Material, from_height
from reflectsep.synth.rig import direction
from reflectsep.synth.shading import fresnel, irradiance, local_diffuse, specular, visibility

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
GREY = Material(name="grey", diffuse=(0.5,), scattering=(0.0,), ior=1.5, roughness=0.3)


def plane(slope_x=0.0, material=GREY):
    return from_height("plane", lambda x, y: slope_x * x + 0 * y, size=(9, 9), materials=(material,))


def tower(x, y):
    """A tower of height 6 in the middle of a flat floor."""
    return torch.where((x.abs() <= 2) & (y.abs() <= 2), 6.0, 0.0).to(torch.float64)


def test_a_facing_patch_gets_irradiance_pi_and_a_tilted_one_its_cosine():
    assert irradiance(plane(), UP) == pytest.approx(torch.full((81,), math.pi))
    light = torch.tensor(direction(30, 0), dtype=torch.float64)
    assert irradiance(plane(), light) == pytest.approx(torch.full((81,), math.pi * math.cos(math.radians(30))))


def test_a_patch_that_faces_away_is_dark():
    away = torch.tensor(direction(60, 0), dtype=torch.float64)
    assert not irradiance(plane(slope_x=1.0), away).any()


def test_a_tower_casts_a_shadow_as_long_as_the_light_is_low():
    scene = from_height("tower", tower, size=(41, 41), materials=(GREY,))
    # Light from the right at 45 degrees: the shadow reaches 6 px to the left of the tower's edge at x = -2.
    free = scene.picture(visibility(scene, torch.tensor(direction(45, 0), dtype=torch.float64))[None])[0]
    middle = free[20]
    assert middle[:11].tolist() == [1.0] * 11  # x <= -10
    assert not middle[14:17].any()  # -6 <= x <= -4
    assert middle[23:].tolist() == [1.0] * 18
    assert free[14].min() == 1.0  # y = 6: beside it


def test_a_convex_body_casts_no_shadow_on_itself():
    def cap(x, y):
        return 12 - 0.02 * (x.square() + y.square())

    dome = from_height("dome", cap, size=(40, 40), materials=(GREY,))
    light = torch.tensor(direction(50, 77), dtype=torch.float64)
    facing = dome.patch_normals @ light > 0.05
    assert visibility(dome, light)[facing].min() == 1.0


def test_a_shadow_is_as_by_following_every_ray_to_its_end():
    scene = from_height("tower", tower, size=(21, 21), materials=(GREY,))
    light = torch.tensor(direction(62, 25), dtype=torch.float64)
    right, up, rise = (float(part / light[:2].norm()) for part in light)
    z, expected = scene.z.tolist(), []
    for x, y, height in scene.points.tolist():
        free = 1.0
        for away in (0.5 * sample for sample in range(2, 60)):
            column, row = (min(max(at, 0.0), 19.999) for at in (x + away * right + 10, 10 - y - away * up))
            i, j, p, q = int(column), int(row), column % 1, row % 1
            above = (1 - p) * z[j][i] + p * z[j][i + 1]
            below = (1 - p) * z[j + 1][i] + p * z[j + 1][i + 1]
            overhang = (1 - q) * above + q * below - height - away * rise
            free = min(free, 1 - min(max(overhang / 0.5, 0.0), 1.0))
        expected.append(free)
    facing = scene.patch_normals @ light > 0
    found = visibility(scene, light)[facing]
    assert found == pytest.approx(torch.tensor(expected, dtype=torch.float64)[facing], abs=1e-2)
    assert float((found < 0.5).double().mean()) > 0.03


def test_a_lambertian_patch_is_its_albedo_less_fresnel():
    value = local_diffuse(plane(), UP) * math.pi
    expected = 0.5 * (1 - 0.04) ** 2  # ((1.5 - 1) / (1.5 + 1))^2 = 0.04
    assert value == pytest.approx(torch.full((1, 81), expected))


def test_a_rough_patch_sends_more_back_to_its_light_than_on_past_it():
    rough = Material(name="rough", diffuse=(0.5,), scattering=(0.0,), diffuse_roughness_deg=30.0)
    smooth = Material(name="smooth", diffuse=(0.5,), scattering=(0.0,))
    # A normal 45 degrees to the right of the view; lights 35 degrees from it on the view's side, and on the other.
    back, on = (torch.tensor(direction(tilt, 0), dtype=torch.float64) for tilt in (10, 80))
    gain = {
        side: float((local_diffuse(plane(-1.0, rough), light) / local_diffuse(plane(-1.0, smooth), light)).mean())
        for side, light in {"back": back, "on": on}.items()
    }
    sigma = math.radians(30) ** 2
    flat = 1 - 0.5 * sigma / (sigma + 0.33)
    extra = 0.45 * sigma / (sigma + 0.09) * math.sin(math.radians(45)) * math.tan(math.radians(35))
    assert gain["on"] == pytest.approx(flat)
    assert gain["back"] == pytest.approx(flat + extra)


def test_fresnel_runs_from_facing_to_everything():
    ior = torch.tensor([1.5, 1.5])
    assert fresnel(torch.tensor([1.0, 0.0]), ior).tolist() == pytest.approx([0.04, 1.0])


def test_the_highlight_is_brightest_where_the_normal_halves_light_and_view():
    slopes = torch.linspace(-0.6, 0.6, 241, dtype=torch.float64)
    light = torch.tensor(direction(30, 180), dtype=torch.float64)
    lobes = torch.stack([specular(plane(float(s)), light)[0] for s in slopes])
    # Smith's terms move the peak a little; the half vector leans 15 degrees towards the light, at slope +tan 15.
    assert float(slopes[lobes.argmax()]) == pytest.approx(math.tan(math.radians(15)), abs=0.03)


@settings(max_examples=15, deadline=None)
@given(st.floats(0.1, 1.0), st.floats(0.0, 1.0), st.floats(1.05, 2.0))
def test_a_lobe_never_sends_back_more_than_it_got(roughness, slope, ior):
    """By reciprocity, light from all around must not send the camera more than it carries."""
    material = Material(name="m", diffuse=(0.0,), scattering=(0.0,), roughness=roughness, ior=ior)
    patch = from_height("p", lambda x, y: slope * x + 0 * y, size=(1, 1), materials=(material,))
    normal = patch.patch_normals[0]
    generator = torch.Generator().manual_seed(0)
    z = torch.rand(600, dtype=torch.float64, generator=generator)
    angle = 2 * math.pi * torch.rand(600, dtype=torch.float64, generator=generator)
    side = (1 - z.square()).sqrt()
    lights = torch.stack([side * angle.cos(), side * angle.sin(), z], -1)
    lights = torch.where((lights @ normal > 0)[:, None], lights, lights - 2 * (lights @ normal)[:, None] * normal)
    sent = sum(float(specular(patch, light)[0] * (normal @ light)) for light in lights) * 2 * math.pi / 600
    assert 0 <= sent <= 1.1
