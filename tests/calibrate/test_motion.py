"""Motions and the one warp that undoes them."""

import json
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.calibrate.motion import Motion, displacement, inside, positions, sample, shifted, warp


def plane(height=20, width=24):
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return x.double(), y.double()


@given(st.floats(-2, 2), st.floats(-2, 2))
def test_cubic_keeps_ramps_and_parabolas_in_place(dx, dy):
    x, y = plane()
    picture = 0.3 * x - 0.2 * y + 0.02 * x**2 + 0.01 * y**2
    found = sample(picture[None], positions(shifted(dx, dy), 20, 24))[0]
    u, v = x + dx, y + dy
    expected = 0.3 * u - 0.2 * v + 0.02 * u**2 + 0.01 * v**2
    inner = (slice(5, -5), slice(5, -5))
    assert float((found - expected)[inner].abs().max()) < 1e-9


def test_a_warp_takes_back_what_moved():
    x, y = plane(40, 40)

    def scene(u, v):
        return torch.sin(u / 5) * torch.cos(v / 6)

    matrix = shifted(1.3, -0.6, 2.0, (19.5, 19.5))
    back = torch.linalg.inv(matrix)
    u, v = back[0, 0] * x + back[0, 1] * y + back[0, 2], back[1, 0] * x + back[1, 1] * y + back[1, 2]
    found, _, seen = warp(scene(u, v)[None], matrix)
    inner = (slice(4, -4), slice(4, -4))
    assert float((found[0] - scene(x, y))[inner].abs().max()) < 3e-3
    assert bool(seen[inner].all())


def test_values_from_outside_are_marked():
    _, _, seen = warp(torch.ones(1, 6, 8), shifted(2.5, 0.0))
    assert seen.sum(1).tolist() == [5] * 6
    assert bool(inside(positions(torch.eye(3, dtype=torch.float64), 5, 5)).all())


def test_clipped_values_spread_to_all_that_they_touch_and_do_not_ring():
    picture, clipped = torch.zeros(1, 9, 9), torch.zeros(1, 9, 9, dtype=torch.bool)
    picture[0, 4, 4], clipped[0, 4, 4] = 1.0, True
    values, found, _ = warp(picture, shifted(0.5, 0.0), clipped)
    assert found is not None
    assert found[0].nonzero().tolist() == [[4, 3], [4, 4]]
    assert values[found].tolist() == pytest.approx([0.5, 0.5])


def test_rotation_and_displacement_of_a_matrix():
    matrix = shifted(0.0, 0.0, 1.5, (10.0, 10.0))
    assert Motion(matrix=matrix).rotation_deg == pytest.approx(1.5)
    ring = torch.zeros(21, 21, dtype=torch.bool)
    ring[10, 0] = ring[0, 10] = True
    assert displacement(matrix, ring) == pytest.approx(2 * 10 * math.sin(math.radians(0.75)))
    assert displacement(shifted(3.0, 4.0), ring) == pytest.approx(5.0)


def test_velocity_adds_to_the_shift_over_a_sweep():
    motion = Motion(matrix=shifted(1.0, 2.0, 5.0), velocity=(0.5, -0.25))
    assert motion.at(0.0) is not motion.matrix
    torch.testing.assert_close(motion.at(0.0), motion.matrix)
    torch.testing.assert_close(motion.at(-1.0)[:2, 2], motion.matrix[:2, 2] - torch.tensor([0.5, -0.25]).double())


def test_document_is_plain():
    document = Motion(matrix=shifted(1, 2), model="translation", applied=True).document()
    assert document["matrix"][0] == [1.0, 0.0, 1.0]
    assert document["applied"] is True


def test_plain_values_give_the_same_motion():
    matrix = torch.eye(3, dtype=torch.float64) + 0.1 * torch.rand(3, 3, dtype=torch.float64)
    motion = Motion(matrix=matrix, model="affine", velocity=(0.1, 1 / 3), sd_px=1e-17, applied=True, reason="so")
    same = Motion.from_plain(json.loads(json.dumps(motion.plain())))
    assert torch.equal(same.matrix, motion.matrix)
    assert {**vars(same), "matrix": None} == {**vars(motion), "matrix": None}
