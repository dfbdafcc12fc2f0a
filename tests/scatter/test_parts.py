import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from reflectsep.data import PhotometricStack
from reflectsep.scatter import geometry
from reflectsep.scatter.exponent import GRID, Samples, solve_exponent
from reflectsep.scatter.filling import fill_along_time, fill_by_interpolation, fill_by_maximum
from reflectsep.scatter.frames import signed_root, steps
from reflectsep.scatter.kernel import Slab, _weights, beyond, fill_by_profile, line_response
from reflectsep.scatter.windows import Profiles
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


def test_beyond_is_the_integral_of_the_radial_spread():
    # int_d^inf K_0(r) r dr over int_0^inf, by sums.
    r = torch.arange(5e-4, 40, 1e-3, dtype=torch.float64)
    density = torch.special.modified_bessel_k0(r) * r
    for d in (0.3, 1.0, 2.5):
        expected = float(density[r > d].sum() / density.sum())
        assert float(beyond(d, torch.ones(1, dtype=torch.float64))) == pytest.approx(expected, abs=1e-3)
    assert float(beyond(0.0, torch.ones(1))) == pytest.approx(1.0, abs=1e-3)


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


def profiles(root, u, half):
    hole = u.abs() <= half
    flat = {"present": torch.ones_like(hole), "saturated": torch.zeros_like(hole)[:, None]}
    return Profiles(
        root=root[:, None],
        offset=u,
        hole=hole,
        lit=hole.any(0),
        light=torch.ones_like(u),
        at=torch.arange(u.shape[1]),
        **flat,
    )


def test_a_dark_channel_fills_with_next_to_nothing():
    # A value of exactly 0 in the one frame that is surely lit; everything else is noise.
    noise = 3e-4
    u = torch.arange(-11.0, 12.0)[:, None] + torch.linspace(-0.45, 0.45, 50)
    g = torch.Generator().manual_seed(4)
    root = noise * torch.randn(u.shape, generator=g).clamp_min(0.0)
    root[10:13] = 0.0
    p = profiles(root, u, 1.3)
    light = torch.cat([torch.full((11,), 1.0), 0.5 ** torch.arange(12.0).square()])[:, None].expand_as(u)
    slab = Slab(half=1.0, edge=0.6, frames_per_px=0.5)
    filled = fill_by_profile(replace(p, light=light), slab, distance_px=1.0, noise=noise)
    assert float(filled.abs().max()) < 10 * noise


def test_profile_recovers_its_own_model():
    u = torch.arange(-12.0, 13.0)[:, None] + torch.linspace(-0.5, 0.5, 11)
    s = torch.tensor([0.7, 1.4])
    slab = Slab(half=1.0, edge=0.2, frames_per_px=0.5)
    response = line_response(u, slab.half, s)
    amplitude = torch.tensor([0.02, 0.05, 0.03, 0.04])
    scattering = (response * amplitude[:, None]).sum(1)
    root = scattering + 0.3 * (u.abs() <= slab.half)
    p = profiles(root, u, slab.half + slab.edge)
    far = beyond(0.5, s).repeat(2)
    expected = 2 * slab.half * (amplitude * far).sum()
    total = p.root.sum(0) - p.unsound + fill_by_profile(p, slab, distance_px=1.0, noise=0.0)
    assert torch.allclose(total, expected.expand_as(total), rtol=0.06)


def test_lit_frames_that_are_dark_to_the_last_digit_weigh_no_more_than_others():
    """A 12-bit camera with its black clipped, in a shadow: weights of 1e12 left no number in single precision."""
    value = torch.zeros(9, 2)
    value[1, 0], value[:, 1] = 0.0012, torch.linspace(0.1, 0.9, 9)
    measured, plateau = torch.ones_like(value, dtype=torch.bool), torch.zeros_like(value, dtype=torch.bool)
    measured[4], plateau[4] = False, True
    weight, lit, size = _weights(value, measured, plateau, 3e-4)
    assert torch.equal(lit[4], weight[4])
    assert bool((weight <= 1.0001 / (0.02 * size) ** 2).all())
    assert float(lit[4, 1]) == pytest.approx(1 / 0.5**2)


def test_time_fills_a_line_exactly():
    u = torch.arange(-6.0, 7.0)[:, None].expand(13, 3)
    root = 2.0 + 0.25 * u + 100.0 * (u.abs() <= 1.5)
    p = profiles(root, u, 1.5)
    assert torch.allclose(fill_along_time(p), torch.full((1, 3), 6.0))


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


def test_scales_grow_with_the_slab():
    from reflectsep.scatter.kernel import scales

    thin, wide = (
        scales(Slab(half=0.5, edge=0.1, frames_per_px=0.5)),
        scales(Slab(half=4.0, edge=0.1, frames_per_px=0.5)),
    )
    assert float(thin[0]) == float(wide[0])
    assert math.log2(float(wide[-1] / thin[-1])) == pytest.approx(2.0)
