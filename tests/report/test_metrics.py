import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.report.metrics import psnr, relative_rms


def test_known_numbers():
    truth = torch.tensor([[[3.0, 4.0], [0.0, 0.0]]])
    picture = truth + torch.tensor([[[0.3, -0.4], [0.0, 0.0]]])
    assert relative_rms(picture, truth) == pytest.approx(0.1)
    assert psnr(picture, truth) == pytest.approx(10 * math.log10(16 / (0.25 / 4)))
    assert psnr(picture, truth, peak=1.0) == pytest.approx(10 * math.log10(1 / (0.25 / 4)))


def test_only_the_mask_counts():
    truth = torch.ones(3, 2, 2)
    picture = truth.clone()
    picture[:, 0, 0] = 99.0
    truth[:, 1, 1] = 50.0
    picture[:, 1, 1] = math.nan
    mask = torch.tensor([[False, True], [True, False]])
    assert relative_rms(picture, truth, mask) == 0.0
    assert psnr(picture, truth, mask) == math.inf


@given(scale=st.floats(1e-3, 1e3), error=st.floats(0.001, 0.5))
def test_neither_depends_on_the_unit(scale, error):
    truth = torch.linspace(0.1, 1, 12, dtype=torch.float64).reshape(1, 3, 4)
    picture = truth + error * torch.cos(7 * truth)
    assert psnr(scale * picture, scale * truth) == pytest.approx(psnr(picture, truth))
    assert relative_rms(scale * picture, scale * truth) == pytest.approx(relative_rms(picture, truth))


def test_ten_times_the_error_is_twenty_decibels():
    truth = torch.linspace(0, 1, 12, dtype=torch.float64).reshape(1, 3, 4)
    assert psnr(truth + 0.01, truth) - psnr(truth + 0.1, truth) == pytest.approx(20.0)


def test_nothing_against_nothing():
    zero = torch.zeros(1, 2, 2)
    assert relative_rms(zero, zero) == 0.0
    assert relative_rms(zero + 1, zero) == math.inf
    with pytest.raises(ValueError, match="peak"):
        psnr(zero, zero)


@pytest.mark.parametrize("measure", [psnr, relative_rms])
@pytest.mark.parametrize(
    ("picture", "mask", "message"),
    [
        (torch.ones(1, 2, 3), None, "shapes"),
        (torch.ones(1, 2, 2), torch.zeros(2, 2, dtype=torch.bool), "no pixels"),
        (torch.ones(1, 2, 2), torch.ones(3, 2, dtype=torch.bool), "mask of shape"),
        (torch.full((1, 2, 2), math.nan), None, "not a finite number"),
    ],
)
def test_what_cannot_be_compared(measure, picture, mask, message):
    with pytest.raises(ValueError, match=message):
        measure(picture, torch.ones(1, 2, 2), mask)
