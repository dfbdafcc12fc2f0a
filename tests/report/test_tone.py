import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.report.tone import INVALID, tone, white_point


def test_srgb_at_known_values():
    # IEC 61966-2-1: linear 0.0031308 is the joint at 0.04045; 0.2158605 is code 128.
    picture = torch.tensor([[[0.0, 0.0031308, 0.2158605, 1.0, -0.3, 7.0]]])
    expected = [0, round(255 * 0.04045), 128, 255, 0, 255]
    assert tone(picture)[0, :, 0].tolist() == expected


def test_shape_type_and_grey():
    found = tone(torch.rand(1, 4, 5))
    assert found.shape == (4, 5, 3)
    assert found.dtype == np.uint8
    assert (found[..., 0] == found[..., 2]).all()


def test_channels_and_rows_keep_their_place():
    picture = torch.zeros(3, 2, 2)
    picture[1, 0, 1] = 1.0
    found = tone(picture)
    assert found[0, 1].tolist() == [0, 255, 0]
    assert found.sum() == 255


@given(value=st.floats(0, 1), white=st.floats(1e-3, 1e3))
def test_white_is_an_exposure(value, white):
    picture = torch.full((1, 1, 1), value, dtype=torch.float64)
    assert abs(int(tone(picture * white, white=white)[0, 0, 0]) - int(tone(picture)[0, 0, 0])) <= 1


def test_what_is_not_finite_is_shown():
    picture = torch.zeros(3, 1, 3)
    picture[0, 0, 0], picture[2, 0, 1] = math.nan, math.inf
    assert tone(picture)[0].tolist() == [list(INVALID), list(INVALID), [0, 0, 0]]


@pytest.mark.parametrize(("shape", "white"), [((2, 4, 4), 1.0), ((4, 4), 1.0), ((1, 4, 4), 0.0), ((1, 4, 4), math.nan)])
def test_what_cannot_be_shown(shape, white):
    with pytest.raises(ValueError, match="expected"):
        tone(torch.zeros(shape), white=white)


def test_white_point_is_a_quantile_over_the_mask():
    picture = torch.arange(1000.0).reshape(1, 10, 100)
    mask = torch.ones(10, 100, dtype=torch.bool)
    assert white_point([picture], mask, share=0.9) == 899.0
    mask[5:] = False
    assert white_point([picture], mask, share=1.0) == 499.0
    assert white_point([picture, 2 * picture], mask, share=1.0) == 998.0


def test_white_point_of_darkness_is_one():
    assert white_point([torch.zeros(1, 3, 3)]) == 1.0
    assert white_point([torch.full((1, 3, 3), math.nan)]) == 1.0
