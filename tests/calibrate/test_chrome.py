"""Lights from balls."""

import math

import pytest
import torch

from reflectsep.calibrate.chrome import (
    Circle,
    chrome_lights,
    compare_lights,
    diffuse_lights,
    disc,
    find_circle,
    highlight,
    reflected,
    sphere_normals,
)
from reflectsep.errors import LightError

BALL = Circle(x=70.3, y=58.6, radius=40.2)
SIZE = (120, 140)
LIGHTS = {"a": (0.0, 0.0, 1.0), "b": (0.4, 0.2, 0.9), "c": (-0.5, 0.3, 0.8), "d": (0.1, -0.6, 0.7)}


def unit(vector):
    length = math.sqrt(sum(v * v for v in vector))
    return tuple(v / length for v in vector)


def chrome(light, ball=BALL):
    """A mirror ball that shows a small lamp."""
    normals, seen = sphere_normals(ball, *SIZE)
    view = torch.tensor([0.0, 0.0, 1.0]).double()
    mirrored = 2 * (normals @ view)[..., None] * normals - view
    lamp = torch.exp((mirrored @ torch.tensor(unit(light)).double() - 1.0) / 0.002)
    return torch.where(seen, 0.05 + lamp, 0.0)


def test_direction_is_the_reflection_and_not_the_normal():
    found = chrome_lights(list(LIGHTS), torch.stack([chrome(v) for v in LIGHTS.values()]), [BALL])
    for light in found:
        (difference,) = compare_lights({light.light: unit(LIGHTS[light.light])}, {light.light: light.direction})
        assert difference.angle_deg < 0.3
    # 45 degrees off the view is seen where the normal is at 22.5.
    direction, _ = reflected((BALL.x + BALL.radius * math.sin(math.radians(22.5)), BALL.y), BALL)
    assert direction == pytest.approx((math.sqrt(0.5), 0.0, math.sqrt(0.5)))


def test_up_in_the_picture_is_up():
    direction, _ = reflected((BALL.x, BALL.y - 10), BALL)
    assert direction[1] > 0


def test_several_balls_are_averaged_and_their_spread_is_said():
    wrong = Circle(x=BALL.x + 1.0, y=BALL.y, radius=BALL.radius)
    pictures = torch.stack([chrome(v) for v in LIGHTS.values()])
    alone = chrome_lights(list(LIGHTS), pictures, [BALL])
    both = chrome_lights(list(LIGHTS), pictures, [BALL, wrong])
    assert all(light.spread_deg == 0 for light in alone)
    # A pixel across is 2 / radius, in radians, at the middle of the ball.
    assert both[0].spread_deg == pytest.approx(math.degrees(2 / BALL.radius), rel=0.05)
    assert alone[0].position_deg == pytest.approx(math.degrees(2 / BALL.radius), rel=0.05)


def test_circle_of_a_mask_with_a_stand():
    mask = disc(BALL, *SIZE)
    mask[95:, 66:75] = True  # the stand that it rests on
    circle = find_circle(mask)
    assert (circle.x, circle.y, circle.radius) == pytest.approx((BALL.x, BALL.y, BALL.radius), abs=0.3)
    assert circle.support < 1


def test_a_square_is_no_ball():
    square = torch.zeros(100, 100, dtype=torch.bool)
    square[20:80, 20:80] = True
    with pytest.raises(LightError, match=r"of its outline lie on a circle; give circle=\[x,y,radius\]"):
        find_circle(square)
    tiny = torch.zeros(9, 9, dtype=torch.bool)
    tiny[3:5, 3:5] = True
    with pytest.raises(LightError, match="an outline of 4 pixels, expected at least 32"):
        find_circle(tiny)


def test_dark_ball_and_a_place_off_it_are_refused():
    with pytest.raises(LightError, match="light a: chrome ball: dark, expected a highlight"):
        chrome_lights(["a"], torch.zeros(1, *SIZE), [BALL])
    with pytest.raises(LightError, match="off the ball"):
        reflected((BALL.x + BALL.radius, BALL.y), BALL)


def test_highlight_is_the_brightest_region_and_no_second_lamp():
    picture = chrome(LIGHTS["b"]).clone()
    alone = highlight(picture, BALL)
    picture[50, 50] = picture.max()  # a hot pixel on the ball
    assert highlight(picture, BALL) == pytest.approx(alone, abs=0.01)


def test_matte_ball_gives_strengths_and_the_better_direction():
    normals, seen = sphere_normals(BALL, *SIZE)
    strengths = {"a": 0.5, "b": 0.8, "c": 0.65, "d": 0.7}
    pictures = []
    for name, vector in LIGHTS.items():
        shading = (normals @ torch.tensor(unit(vector)).double()).clamp_min(0)
        pictures.append(torch.where(seen, strengths[name] * shading, 0.0))
    listed = {name: unit(vector) for name, vector in LIGHTS.items()}
    found = diffuse_lights(list(LIGHTS), torch.stack(pictures), BALL, listed)
    for sphere in found:
        assert sphere.intensity == pytest.approx(strengths[sphere.light], rel=1e-3)
        assert sphere.error < 1e-3
    wrong = diffuse_lights(["b"], torch.stack(pictures[1:2]), BALL, {"b": LIGHTS["c"]})
    assert wrong[0].error > 0.1
    assert wrong[0].direction == pytest.approx(unit(LIGHTS["b"]), abs=1e-3)


def test_differences_are_angle_and_per_cent():
    (difference,) = compare_lights({"a": (0.0, 0.0, 2.0), "z": (1.0, 0.0, 0.0)}, {"a": (0.0, 3.0, 0.0)})
    assert (difference.angle_deg, difference.magnitude_percent) == pytest.approx((90.0, 50.0))
