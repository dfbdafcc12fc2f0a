"""Squares that stand for a whole object."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.fit.sample import GAP_PX, SQUARE_PX, sample, strewn_squares


def disc(height, width):
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return ((row / height - 0.5) ** 2 + (column / width - 0.5) ** 2) < 0.23


@pytest.mark.parametrize("shape", [(200, 260), (190, 101), (500, 30)])
def test_squares_lie_inside_of_the_mask_in_the_order_of_their_canvas(shape):
    mask = disc(*shape)
    found = sample(mask, 2000)
    assert len(found.index) == int(found.mask.sum())
    assert int(found.index.min()) >= 0
    assert int(found.index.max()) < int(mask.sum())
    assert len(found.index.unique()) == len(found.index)
    # Neighbours on the canvas are neighbours in the picture.
    place = mask.flatten().nonzero()[:, 0][found.index]
    assert mask.flatten()[place].all()
    canvas = torch.full(found.mask.shape, -1)
    canvas[found.mask] = place
    for step, axis in ((1, 1), (shape[1], 0)):
        first, second = (canvas.narrow(axis, k, canvas.shape[axis] - 1) for k in (0, 1))
        both = (first >= 0) & (second >= 0)
        assert both.sum() > 500
        assert ((second - first)[both] == step).all()


def test_squares_are_too_far_apart_to_be_neighbours():
    found = sample(disc(300, 300), 3000)
    step = SQUARE_PX + GAP_PX
    row, column = found.mask.nonzero().mT
    assert (row % step < SQUARE_PX).all()
    assert (column % step < SQUARE_PX).all()


@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 2000))
def test_small_objects_are_taken_whole(height, width, count):
    mask = torch.ones(height, width, dtype=torch.bool)
    found = sample(mask, count)
    if height * width <= 1.5 * count:
        assert torch.equal(found.mask, mask)
        assert torch.equal(found.index, torch.arange(height * width))
    assert len(found.index) == int(found.mask.sum()) > 0


def test_about_as_many_are_taken_as_asked_for():
    found = sample(torch.ones(700, 900, dtype=torch.bool), 20_000)
    assert 0.8 < len(found.index) / 20_000 < 1.25


def test_a_sparse_object_that_no_square_meets_is_sampled_pixel_by_pixel():
    mask = torch.zeros(480, 480, dtype=torch.bool)
    corners = ~strewn_squares((480, 480), 0.01)
    mask[corners] = torch.rand(int(corners.sum()), generator=torch.Generator().manual_seed(0)) < 0.01
    count = int(0.01 * mask.sum())
    found = sample(mask, count)
    assert 0 < len(found.index) <= count + 1
    assert not (found.mask[:, 1:] & found.mask[:, :-1]).any()
    assert len(found.index) == int(found.mask.sum())


@given(st.floats(0.02, 1))
def test_strewn_squares_are_whole_and_cover_their_share(share):
    found = strewn_squares((40 * SQUARE_PX, 40 * SQUARE_PX), share)
    blocks = found.view(40, SQUARE_PX, 40, SQUARE_PX)
    assert torch.equal(blocks.any(3).any(1), blocks.all(3).all(1))
    assert float(found.double().mean()) == pytest.approx(share, abs=0.02)
