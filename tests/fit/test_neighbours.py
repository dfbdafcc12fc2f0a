from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.fit.neighbours import local_median, neighbourhood, smooth, to_map


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
