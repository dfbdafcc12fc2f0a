from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.fit import chunks
from reflectsep.fit.chunks import cuts, in_chunks, taken


@given(st.integers(1, 200_000))
def test_cuts_cover_the_pixels_once_and_none_is_too_large(pixels):
    found = list(cuts(pixels))
    assert [0, *(cut.stop for cut in found)] == [*(cut.start for cut in found), pixels]
    assert all(0 < cut.stop - cut.start <= chunks.AT_ONCE for cut in found)


def test_results_stand_in_the_pixels_order_and_keep_their_kind(monkeypatch):
    monkeypatch.setattr(chunks, "AT_ONCE", 3)
    values = torch.arange(20.0).view(10, 2)
    assert torch.equal(in_chunks(10, lambda cut: values[cut] + 1.0), values + 1.0)
    assert in_chunks(10, lambda cut: values[cut].sum(-1) > 5.0).dtype == torch.bool


def test_of_no_pixels_there_is_nothing():
    assert in_chunks(0, lambda cut: torch.ones(5, 2)[:0][cut]).shape == (0, 2)
    assert list(cuts(0)) == []


def test_rows_taken_are_those_of_the_index(monkeypatch):
    monkeypatch.setattr(chunks, "AT_ONCE", 3)
    values, index = torch.arange(20.0).view(10, 2), torch.tensor([9, 0, 4, 4, 7])
    assert torch.equal(taken(values, index), values[index])
