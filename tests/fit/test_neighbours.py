from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.fit import chunks, neighbours
from reflectsep.fit.neighbours import QUADRATIC, local_median, local_quadratic, neighbourhood, smooth, to_map


def some_mask():
    mask = torch.ones(9, 11, dtype=torch.bool)
    mask[:2], mask[4, 5], mask[8, 10] = False, False, False
    return mask


def some_values(mask, channels=2):
    g = torch.Generator().manual_seed(0)
    return torch.rand(int(mask.sum()), channels, generator=g, dtype=torch.float64)


def test_to_map_puts_values_where_they_belong():
    mask = some_mask()
    values = some_values(mask)
    picture = to_map(values, mask)
    assert torch.equal(picture[:, mask].T, values)
    assert float(picture[:, ~mask].abs().max()) == 0.0


@given(st.floats(-5, 5), st.floats(0.5, 3))
def test_smoothing_leaves_a_constant_alone_up_to_the_edge_of_the_mask(value, sigma_px):
    mask = some_mask()
    values = torch.full((int(mask.sum()), 1), value, dtype=torch.float64)
    weight = some_values(mask)[:, 0] + 0.1
    torch.testing.assert_close(smooth(values, weight, mask, sigma_px), values, rtol=1e-6, atol=1e-9)


def test_smoothing_is_the_weighted_gaussian_mean():
    mask = some_mask()
    values, weight = some_values(mask, 1), some_values(mask)[:, 1]
    y, x = (c.double() for c in mask.nonzero(as_tuple=True))
    apart = (y[:, None] - y).square() + (x[:, None] - x).square()
    near = ((y[:, None] - y).abs() <= 3) & ((x[:, None] - x).abs() <= 3)
    kernel = torch.where(near, torch.exp(-apart / 2), 0.0) * weight
    expected = kernel @ values / kernel.sum(1, keepdim=True)
    torch.testing.assert_close(smooth(values, weight, mask, 1.0), expected, rtol=1e-6, atol=1e-9)


def test_what_has_no_weight_has_no_say():
    mask = some_mask()
    values = torch.ones(int(mask.sum()), 1, dtype=torch.float64)
    weight = torch.ones(len(values), dtype=torch.float64)
    values[30], weight[30] = 1e6, 0.0
    torch.testing.assert_close(smooth(values, weight, mask, 1.0), torch.ones_like(values))


def test_the_median_is_of_the_neighbours_inside_the_mask_without_the_pixel_itself():
    mask = some_mask()
    values = some_values(mask)
    places = [tuple(p) for p in mask.nonzero().tolist()]
    for radius in (1, 2):
        median = local_median(values, mask, radius)
        for i, (y, x) in enumerate(places):
            around = [j for j, (v, u) in enumerate(places) if j != i and abs(v - y) <= radius and abs(u - x) <= radius]
            assert torch.equal(median[i], values[around].median(0).values)


@pytest.mark.parametrize("rows", [1, 2, 4])
def test_medians_by_bands_of_rows_are_those_of_the_whole_picture(monkeypatch, rows):
    mask = some_mask()
    values = some_values(mask)
    whole = local_median(values, mask, 2)
    monkeypatch.setattr(neighbours, "PIXELS_OF_WINDOWS", rows * mask.shape[1])
    assert torch.equal(local_median(values, mask, 2), whole)


@pytest.mark.parametrize("rows", [1, 2, 4])
def test_means_and_surfaces_by_bands_of_rows_are_those_of_the_whole_picture(monkeypatch, rows):
    mask = some_mask()
    mask[3:6] = False  # bands without a pixel, too
    values, weight = some_values(mask, 3), some_values(mask)[:, 0] + 0.1
    mean, surface = smooth(values, weight, mask, 1.0), local_quadratic(values, weight, mask, 1.0)
    monkeypatch.setattr(neighbours, "PIXELS_OF_A_BAND", rows * mask.shape[1])
    assert torch.equal(smooth(values, weight, mask, 1.0), mean)
    parts = local_quadratic(values, weight, mask, 1.0)
    assert torch.equal(parts[0], surface[0])
    assert torch.equal(parts[1], surface[1])


def test_of_an_empty_mask_there_is_nothing():
    nothing = torch.zeros(5, 4, dtype=torch.bool)
    assert smooth(torch.ones(0, 2), torch.ones(0), nothing, 1.0).shape == (0, 2)


def test_quadratics_a_few_pixels_at_a_time_are_those_of_all(monkeypatch):
    mask = some_mask()
    values, weight = some_values(mask, 3), some_values(mask)[:, 0] + 0.1
    whole = local_quadratic(values, weight, mask, 1.0)
    monkeypatch.setattr(chunks, "AT_ONCE", 7)
    parts = local_quadratic(values, weight, mask, 1.0)
    assert torch.equal(parts[0], whole[0])
    assert torch.equal(parts[1], whole[1])


def test_an_outlier_is_replaced_and_a_lone_pixel_keeps_its_value():
    mask = torch.zeros(7, 7, dtype=torch.bool)
    mask[:3, :3] = True
    mask[6, 6] = True
    values = torch.ones(10, 1, dtype=torch.float64)
    values[4], values[9] = 100.0, 7.0
    median = local_median(values, mask, 1)
    assert torch.equal(median, torch.tensor([1.0] * 9 + [7.0], dtype=torch.float64)[:, None])


def test_the_window_leaves_the_pixel_out():
    mask = some_mask()
    window = neighbourhood(some_values(mask), mask, 1)
    assert window.shape == (int(mask.sum()), 2, 8)
    assert window[0].isnan().any()  # at the mask's edge


def test_a_quadratic_surface_is_predicted_from_its_other_pixels():
    mask = torch.ones(14, 15, dtype=torch.bool)
    mask[0, :4], mask[7, 7] = False, False
    y, x = (c.double() / 10 for c in mask.nonzero(as_tuple=True))
    surface = torch.stack([0.3 - x + 2 * y + x * x - 0.5 * x * y + 0.7 * y * y, 1 + x * y], 1)
    spoilt = surface.clone()
    # Its own value has no say: a wrong pixel is predicted as if it were right.
    spoilt[100] += 5.0
    weight = torch.ones(len(x), dtype=torch.float64)
    weight[100] = 0.0
    predicted, _ = local_quadratic(spoilt, weight, mask, 2.0)
    # The trace of a ridge costs most in the corners.
    tolerance = 2e-3 * float(surface.amax() - surface.amin())
    assert float((predicted - surface).abs().max()) < tolerance
    alone, _ = local_quadratic(spoilt, torch.ones_like(weight), mask, 2.0)
    torch.testing.assert_close(alone[100], surface[100], rtol=0, atol=tolerance)


def test_the_prediction_is_the_weighted_regression_with_its_variance():
    mask = some_mask()
    values, weight = some_values(mask, 1), some_values(mask)[:, 1] + 0.2
    y, x = (c.double() for c in mask.nonzero(as_tuple=True))
    predicted, variance = local_quadratic(values, weight, mask, 1.5)
    for i in (3, 30, 60):
        dx, dy = (x - x[i]) / 1.5, (y - y[i]) / 1.5
        near = (dx.abs() * 1.5 <= 4) & (dy.abs() * 1.5 <= 4)
        near[i] = False
        w = (weight * torch.exp(-0.5 * (dx**2 + dy**2)))[near]
        design = torch.stack([dx**a * dy**b for a, b in QUADRATIC], 1)[near]
        normal = design.T @ (w[:, None] * design)
        expected = torch.linalg.solve(normal, design.T @ (w * values[near, 0]))[0]
        # A trace of a ridge is all that sets the two apart.
        assert float(predicted[i, 0] - expected) == pytest.approx(0.0, abs=0.02)
        assert float(variance[i]) == pytest.approx(float(torch.linalg.inv(normal)[0, 0]), rel=0.02)
