import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from reflectsep.data import PhotometricStack
from reflectsep.scatter import geometry
from reflectsep.scatter.exponent import GRID, Samples, solve_exponent
from reflectsep.scatter.filling import fill_by_interpolation, fill_by_maximum
from reflectsep.scatter.frames import signed_root, steps
from reflectsep.scatter.kernel import spread, strip
from reflectsep.scatter.spread import _undarkened, point_sampled
from reflectsep.scatter.width_fit import line_response
from reflectsep.solve.nonnegative import nonnegative_least_squares


@given(st.floats(1e-6, 4).flatmap(lambda v: st.sampled_from([v, -v, 0.0])), st.floats(0.3, 3))
def test_root_keeps_the_sign_and_is_undone(value, n_d):
    x = torch.tensor(value, dtype=torch.float64)
    root = signed_root(x, n_d)
    assert root.sign() == x.sign()
    assert float(signed_root(root, 1 / n_d)) == pytest.approx(value, abs=1e-9)


@pytest.mark.parametrize("at_once", [1, 7])
def test_normals_some_pixels_at_a_time_are_those_of_all(monkeypatch, at_once):
    g = torch.Generator().manual_seed(2)
    vectors = torch.nn.functional.normalize(torch.randn(6, 3, generator=g) + torch.tensor([0.0, 0.0, 3.0]), dim=1)
    mask = torch.rand(9, 9, generator=g) > 0.3
    stack = PhotometricStack(
        names=tuple("abcdef"),
        images=torch.rand(6, 3, 9, 9, generator=g),
        saturated=torch.zeros(6, 3, 9, 9, dtype=torch.bool),
        mask=mask,
        alpha=torch.zeros(6, 3),
        light_vectors=vectors,
        view=torch.tensor([0.0, 0.0, 1.0]),
        flags=torch.zeros(9, 9, dtype=torch.int32),
    )
    whole = geometry.crude_normals(stack)
    monkeypatch.setattr(geometry, "PIXELS_AT_ONCE", at_once)
    parts = geometry.crude_normals(stack)
    torch.testing.assert_close(parts, whole, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(whole.norm(dim=-1), torch.ones(9, 9))
    assert (whole[~mask] == torch.tensor([0.0, 0.0, 1.0])).all()


@settings(deadline=None)
@given(st.floats(0.5, 3), st.floats(0.3, 2), st.floats(-0.5, 0.5))
def test_line_response_is_the_slab_on_the_line_spread(half, scale, shift):
    u = (torch.arange(-40, 41, dtype=torch.float64) + shift)[:, None]
    response = line_response(u, half, torch.tensor([scale], dtype=torch.float64))[..., 0]
    t = torch.arange(-60, 60, 0.002, dtype=torch.float64) + 0.001
    for k in (36, 40, 43):
        inside = (t - u[k]).abs() < half
        one_sided = torch.exp(t / scale) * (t < 0) / scale
        assert float(response[k, 0]) == pytest.approx(float((one_sided * inside).sum() * 0.002), abs=5e-3)
    assert torch.allclose(response[:, 1], line_response(-u, half, torch.tensor([scale], dtype=torch.float64))[:, 0, 0])


def test_nonnegative_least_squares_is_optimal():
    torch.manual_seed(0)
    a = torch.rand(12, 4, 50, dtype=torch.float64)
    y = torch.rand(12, 50, dtype=torch.float64) - 0.2
    normal, right = torch.einsum("fip,fjp->ijp", a, a), torch.einsum("fip,fp->ip", a, y)
    x = nonnegative_least_squares(normal, right)
    gradient = torch.einsum("ijp,jp->ip", normal, x) - right
    assert (x >= 0).all()
    # Karush-Kuhn-Tucker: no slope where free, none downhill where held.
    assert float((gradient * x).abs().max()) < 1e-6
    assert float(gradient.min()) > -1e-6


def test_spatial_fillings():
    mask = torch.ones(12, 12, dtype=torch.bool)
    hole = torch.zeros_like(mask)
    hole[:, 5:8] = True
    frame = torch.full((2, 12, 12), 0.5)
    frame[:, :, 8] = 0.9
    spoilt = torch.where(hole, 50.0, frame)
    smooth, largest = fill_by_interpolation(spoilt, hole, mask), fill_by_maximum(spoilt, hole, mask)
    for filled in (smooth, largest):
        assert torch.equal(filled[:, ~hole], frame[:, ~hole])
    assert torch.allclose(largest[:, :, 7], torch.full((2, 12), 0.9))
    assert torch.allclose(largest[:, :, 5], torch.full((2, 12), 0.5))
    assert float(smooth[:, hole].min()) >= 0.5
    assert float(smooth[:, hole].max()) <= 0.9


def test_filling_does_not_reach_over_the_edge_of_the_object():
    mask = torch.ones(10, 10, dtype=torch.bool)
    mask[:, 6:] = False
    hole = torch.zeros_like(mask)
    hole[:, 4:6] = True
    frame = torch.full((1, 10, 10), -1.0)
    frame[:, :, 6:] = 7.0
    for fill in (fill_by_interpolation, fill_by_maximum):
        assert torch.allclose(fill(frame, hole, mask)[:, :, 4:6], torch.tensor(-1.0)), fill.__name__


@pytest.mark.parametrize("n_d", [0.5, 1.0, 1.6])
def test_exponent_with_noise_on_both_sides(n_d):
    g = torch.Generator().manual_seed(3)
    parts = torch.rand(6000, 8, generator=g, dtype=torch.float64) ** 3 + 0.05
    parts *= torch.rand(6000, 1, generator=g, dtype=torch.float64) + 0.5
    full = (parts.sum(1) / 5.0) ** n_d
    noise = 0.01 * float(full.max())
    noisy = full + noise * torch.randn(6000, generator=g, dtype=torch.float64)
    frames = parts**n_d
    sums = torch.stack([signed_root(frames, n).sum(1) for n in GRID])
    found = solve_exponent([Samples(full=noisy, instrument=full, sums=sums, noise=noise)], GRID)
    assert found.identifiable
    assert abs(found.n_d - n_d) < max(0.01, 2.5 * found.n_d_sd)
    assert found.gains[0] == pytest.approx(5.0, rel=0.01 if n_d != 1.0 else 0.003)


def test_lost_frames_lie_between_their_neighbours(body):
    b = body()
    stream, full = b.stream(0, lost=[12, 13]), b.stack().images[0]
    walked = list(steps(stream, full, b.mask))
    assert [s.index for s in walked] == list(range(len(stream)))
    assert [s.index for s in walked if s.lost] == [12, 13]
    low, high = torch.minimum(walked[11].values, walked[14].values), torch.maximum(walked[11].values, walked[14].values)
    for i in (12, 13):
        assert (walked[i].values >= low - 1e-7).all()
        assert (walked[i].values <= high + 1e-7).all()


@settings(deadline=None)
@given(st.floats(0.5, 4), st.floats(0.0, 5))
def test_strip_is_all_that_the_spread_sends_from_beyond_a_line(scale, distance):
    across = torch.arange(distance + 0.01, distance + 14 * scale, 0.02, dtype=torch.float64)
    along = torch.arange(-14 * scale, 14 * scale, 0.05, dtype=torch.float64)
    r = torch.hypot(across[:, None], along)
    expected = float(spread(r, scale).sum() * 0.02 * 0.05)
    assert float(strip(torch.tensor(distance), scale)) == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("points", [True, False])
def test_a_camera_that_samples_points_is_told_by_divided_pixels(points):
    g = torch.Generator().manual_seed(1)
    centre, wide, half = 8 + 4 * torch.rand(500, generator=g), torch.full((500,), 0.5), 1.0
    index = torch.arange(20)
    away = (index[:, None] - centre).abs()
    lit = (away <= half).float() if points else ((half - away) / wide + 0.5).clamp(0, 1)
    value = 0.1 + lit + 0.02 * torch.rand(lit.shape, generator=g)
    assert point_sampled([(value, index, centre, wide, half)]) == points


@pytest.mark.parametrize("signal", [0.0, 0.5, 3.0])
def test_noise_that_was_clipped_at_black_adds_nothing(signal):
    g = torch.Generator().manual_seed(5)
    frames, deviation = 60, 1e-3
    clipped = (signal * deviation + deviation * torch.randn(frames, 40, 50, generator=g)).clamp(min=0.0)
    dark = deviation / (2 * torch.pi) ** 0.5
    found = _undarkened(clipped.sum(0), frames, dark) / frames
    assert float(found.mean()) == pytest.approx(signal * deviation, abs=0.1 * deviation)
