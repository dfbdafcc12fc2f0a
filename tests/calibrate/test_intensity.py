"""Strengths of lights jointly from alpha."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.calibrate.alpha import alpha_from_vectors
from reflectsep.calibrate.intensity import joint_intensities
from reflectsep.errors import LightError

from .conftest import ANGLES, direction

NAMES = list(ANGLES)
DIRECTIONS = {name: direction(*angles) for name, angles in ANGLES.items()}


def alpha_of(strengths):
    vectors = torch.tensor([DIRECTIONS[name] for name in NAMES], dtype=torch.float64) * strengths[:, None]
    return alpha_from_vectors(vectors, vectors[:3])


@given(st.lists(st.floats(0.2, 5.0), min_size=len(NAMES), max_size=len(NAMES)))
def test_strengths_come_back_up_to_their_scale(values):
    strengths = torch.tensor(values, dtype=torch.float64)
    found, residual = joint_intensities(NAMES, DIRECTIONS, alpha_of(strengths))
    assert [found[name] for name in NAMES] == pytest.approx((strengths / strengths[0]).tolist(), rel=1e-6)
    assert residual < 1e-9


def test_wrong_directions_are_left_over():
    wrong = {**DIRECTIONS, "L5": DIRECTIONS["L6"]}
    _, residual = joint_intensities(NAMES, wrong, alpha_of(torch.ones(len(NAMES), dtype=torch.float64)))
    assert residual > 0.01


def test_contradiction_and_too_few_are_refused():
    alpha = alpha_of(torch.ones(len(NAMES), dtype=torch.float64))
    with pytest.raises(LightError, match="3 lights, expected 4 or more"):
        joint_intensities(NAMES[:3], DIRECTIONS, alpha)
    with pytest.raises(LightError, match="light L4 would be negative; its direction contradicts"):
        joint_intensities(NAMES[:4], DIRECTIONS, torch.cat([alpha[:3], -alpha[3:4]]))
