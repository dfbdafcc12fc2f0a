"""A ball is found where no mask is given."""

import pytest
import torch
from kornia.filters import gaussian_blur2d

from reflectsep.calibrate.ball import find_ball_circle
from reflectsep.calibrate.chrome import Circle
from reflectsep.errors import LightError

from .test_chrome import BALL, LIGHTS, SIZE, chrome, sphere_normals, unit

OUTLINE = (BALL.x, BALL.y, 0.96**0.5 * BALL.radius)
"""What `sphere_normals` shows of it."""


def pictures(make=chrome, noise=0.002, background=None):
    """One a light, with the scene behind the ball where there is one."""
    g = torch.Generator().manual_seed(0)
    result = []
    for light in LIGHTS.values():
        picture = make(light)
        if background is not None:
            picture = torch.where(picture > 0, picture, background * max(0.3, unit(light)[2]))
        result.append(picture + noise * torch.randn(SIZE, generator=g))
    return torch.stack(result)


def found(given):
    circle = find_ball_circle(given)
    return circle.x, circle.y, circle.radius


def room(seed=1):
    """A wall with a gradient and blurred things on it, and a table's straight edge."""
    g = torch.Generator().manual_seed(seed)
    things = gaussian_blur2d(torch.randn((1, 1, *SIZE), generator=g), (13, 13), (4.0, 4.0))[0, 0]
    wall = 0.08 + 0.0004 * torch.arange(SIZE[1]) + 0.15 * things
    wall[90:] = 0.03
    return wall.clamp_min(0.01).double()


def test_before_darkness():
    assert found(pictures()) == pytest.approx(OUTLINE, abs=1.0)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_before_a_room_brighter_and_darker_than_the_ball(seed):
    assert found(pictures(background=room(seed))) == pytest.approx(OUTLINE, abs=1.5)


def test_a_matte_ball():
    def matte(light):
        normals, seen = sphere_normals(BALL, *SIZE)
        return torch.where(seen, 0.02 + (normals @ torch.tensor(unit(light)).double()).clamp_min(0.0), 0.0)

    assert found(pictures(matte, background=torch.full(SIZE, 0.01))) == pytest.approx(OUTLINE, abs=1.5)


def test_a_large_picture_is_searched_small_and_measured_large():
    big = torch.nn.functional.interpolate(pictures()[:, None], scale_factor=3, mode="bilinear")[:, 0]
    expected = (3 * BALL.x + 1, 3 * BALL.y + 1, 3 * OUTLINE[2])
    assert found(big) == pytest.approx(expected, abs=2.0)


def test_a_ring_without_the_highlight_is_not_the_ball():
    """A clearer circle elsewhere, in which nothing is ever brightest."""
    given = pictures(background=torch.full(SIZE, 0.02))
    other = Circle(x=118.0, y=100.0, radius=16.0)
    y, x = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="ij")
    inside = (x - other.x) ** 2 + (y - other.y) ** 2 < other.radius**2
    given[:, inside] = 0.4
    assert found(given) == pytest.approx(OUTLINE, abs=1.5)


def test_no_ball_is_said_so():
    g = torch.Generator().manual_seed(0)
    noise = 0.1 + 0.01 * torch.rand((4, *SIZE), generator=g)
    with pytest.raises(LightError, match=r"chrome ball: .*give a mask or circle=\[x,y,radius\]"):
        find_ball_circle(noise)
    striped = noise + (torch.arange(SIZE[1]) % 40 > 20) * 0.5
    with pytest.raises(LightError, match=r"chrome ball: .*give a mask or circle=\[x,y,radius\]"):
        find_ball_circle(striped)
