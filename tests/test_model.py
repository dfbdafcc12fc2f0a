from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.model import (
    Globals,
    diffuse,
    length,
    lobe,
    lobe_by_exponent,
    lobe_of,
    lobe_vector,
    lobe_with_slopes,
    mixed,
    positive_power,
    reflectance,
    signed_root,
    transmitted,
    transmitted_by_globals,
    transmitted_with_slope,
)

finite = st.floats(-3, 3)


def double(*values):
    return torch.tensor(values, dtype=torch.float64)


def one(value):
    return torch.tensor(value, dtype=torch.float64)


def directions(lights=6):
    rows = [[0.4, 0.1, 1], [-0.3, 0.35, 1], [-0.1, -0.4, 1], [0.1, 0.1, 1], [0.3, -0.2, 1], [-0.6, 0.5, 1]]
    return torch.nn.functional.normalize(torch.tensor(rows[:lights], dtype=torch.float64), dim=1)


def some_globals(**changes):
    basis = directions()[:3]
    values = {
        "a": double(-0.9, -0.8, -0.95),
        "n_s": one(7.0),
        "n_d": 1.3,
        "f": one(1.0),
        "softness": one(0.0),
        "fresnel": one(0.0),
        "ggx": False,
        "M": torch.linalg.inv(basis),
    }
    return Globals(**values | changes)


def some_pixels(pixels=5, channels=2):
    """Some patches face away, some lobes are dark."""
    g = torch.Generator().manual_seed(4)
    rand = lambda *n: torch.rand(*n, generator=g, dtype=torch.float64)  # noqa: E731
    alpha = directions() @ torch.linalg.inv(directions()[:3])
    d, s, B = 0.8 * rand(3, channels, pixels) - 0.25, 0.2 * rand(3, channels, pixels), 4 + 4 * rand(pixels)
    return d, s, B, alpha


def papers_picture(d, s, B, shared, alpha, place):
    """Eqs. 20 and 21 for one light, channel and pixel, in plain numbers."""
    j, c, p = place
    channels = d.shape[1]
    root, u = 0.0, 0.0
    for i in range(3):
        root += float(alpha[j, i]) * (float(d[i, c, p]) + float(s[i, c, p]))
        mean = sum(float(d[i, k, p]) for k in range(channels)) / channels
        u += float(alpha[j, i]) * (float(shared.a[i]) + float(B[p]) * mean)
    return max(root, 0.0) ** float(shared.n_d) + max(u, 0.0) ** float(shared.n_s)


@pytest.mark.parametrize("n_d", [1.0, 0.8, 1.6])
def test_without_what_is_added_reflectance_is_equations_20_and_21(n_d):
    d, s, B, alpha = some_pixels()
    shared = some_globals(n_d=n_d)
    pictures = reflectance(d, B, shared, s=s, alpha=alpha)
    assert pictures.shape == (6, 2, 5)
    clamped = 0
    for place in [(j, c, p) for j in range(6) for c in range(2) for p in range(5)]:
        expected = papers_picture(d, s, B, shared, alpha, place)
        clamped += expected == 0.0
        # The clamp is the limit of a soft one, whose rounding near 0 is 1e-6.
        assert float(pictures[place]) == pytest.approx(expected, rel=1e-9, abs=1e-6)
    assert clamped > 0
    assert float(pictures.amax()) > 0.3


def test_n_s_of_the_paper_does_not_depend_on_the_directions():
    d, s, B, alpha = some_pixels()
    known = some_globals(softness=one(0.0))
    unknown = dataclasses.replace(known, M=torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(
        reflectance(d, B, known, s=s, alpha=alpha), reflectance(d, B, unknown, s=s, alpha=alpha), rtol=1e-9, atol=1e-6
    )


@pytest.mark.parametrize("ggx", [False, True])
def test_without_scattering_f_means_nothing_as_in_lin_and_lee(ggx):
    d, s, B, alpha = some_pixels()
    shared = some_globals(ggx=ggx, softness=one(0.1), fresnel=one(0.7))
    forgot, kept = (dataclasses.replace(shared, f=one(f)) for f in (1.0, 0.0))
    nothing = torch.zeros_like(s)
    picture = lambda g, s: reflectance(d, B, g, s=s, alpha=alpha)  # noqa: E731
    torch.testing.assert_close(picture(forgot, nothing), picture(kept, nothing), rtol=1e-12, atol=0)
    # Their model does not tell d from s: at f = 0 only the sum counts.
    whole = reflectance(d + s, B, forgot, s=nothing, alpha=alpha)
    torch.testing.assert_close(picture(kept, s), whole, rtol=1e-9, atol=1e-12)
    assert float((picture(forgot, s) - whole).abs().max()) > 1e-2


def test_lights_with_a_sweep_of_their_own_are_lit_by_it():
    d, s, B, alpha = some_pixels()
    shared = some_globals(softness=one(0.1), f=one(0.5), ggx=True)
    lights = mixed(alpha, s)
    torch.testing.assert_close(
        reflectance(d, B, shared, s=s, alpha=alpha, s_lights=lights), reflectance(d, B, shared, s=s, alpha=alpha)
    )
    lights[4] *= 1.5
    moved = reflectance(d, B, shared, s=s, alpha=alpha, s_lights=lights) - reflectance(d, B, shared, s=s, alpha=alpha)
    assert float(moved[4].abs().max()) > 1e-3
    assert float(moved[[0, 1, 2, 3, 5]].abs().max()) < 1e-12


def test_the_body_is_transmitted_light_of_its_cosine():
    d, s, _, alpha = some_pixels()
    shared = some_globals(softness=one(0.2), fresnel=one(0.8), n_d=1.0)
    normal = torch.einsum("xk,kcp->xcp", shared.M, d + s)
    q = normal.norm(dim=0)
    cosine = torch.einsum("jx,xcp->jcp", directions(), normal / q)
    # A light's cosine is that between its direction and the normal.
    expected = q * transmitted(cosine, shared.softness, shared.fresnel)
    torch.testing.assert_close(diffuse(mixed(alpha, d + s), length(shared.M, d + s), shared), expected)


def test_a_fitted_n_d_of_one_gives_what_the_number_one_gives():
    d, s, B, alpha = some_pixels()
    plain = reflectance(d, B, some_globals(n_d=1.0), s=s, alpha=alpha)
    torch.testing.assert_close(reflectance(d, B, some_globals(n_d=one(1.0)), s=s, alpha=alpha), plain)


@pytest.mark.parametrize("ggx", [False, True])
def test_gradients_are_those_of_finite_differences(ggx):
    d, s, B, alpha = some_pixels(pixels=3)

    def picture(d, s, B, a, n_s, n_d, f, softness, fresnel, alpha):  # noqa: PLR0917
        g = some_globals(a=a, n_s=n_s, n_d=n_d, f=f, softness=softness, fresnel=fresnel, ggx=ggx)
        return reflectance(d, B, g, s=s, alpha=alpha)

    inputs = (d, s, B, double(-0.9, -0.8, -0.95), one(7.0), one(1.3), one(0.6), one(0.2), one(0.5), alpha)
    inputs = tuple(x.clone().requires_grad_() for x in inputs)
    assert torch.autograd.gradcheck(picture, inputs)
    assert torch.autograd.gradcheck(picture, inputs, check_forward_ad=True, check_backward_ad=False)


def by_autograd(function, *inputs):
    inputs = tuple(x.clone().requires_grad_() for x in inputs)
    value = function(*inputs)
    found = torch.autograd.grad(value.sum(), inputs, allow_unused=True, materialize_grads=True)
    return value.detach(), found


COSINES = double(-0.9, -0.3, -0.01, 0.005, 0.2, 0.7, 0.99, 1.02)


@pytest.mark.parametrize("softness", [0.0, 0.02, 0.4])
@pytest.mark.parametrize("fresnel", [0.0, 0.6, 1.0])
def test_slopes_of_transmitted_light_are_those_of_autograd(softness, fresnel):
    e, k = (torch.full_like(COSINES, value) for value in (softness, fresnel))
    value, (by_c, by_softness, by_fresnel) = by_autograd(transmitted, COSINES, e, k)
    same, slope = transmitted_with_slope(COSINES, e, k)
    torch.testing.assert_close(same, value, rtol=1e-12, atol=1e-15)
    torch.testing.assert_close(slope, by_c, rtol=1e-9, atol=1e-12)
    for found, expected in zip(transmitted_by_globals(COSINES, e, k), (by_softness, by_fresnel), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-12)
    assert torch.autograd.gradcheck(transmitted, (COSINES[[0, 1, 4, 5]].clone().requires_grad_(), one(0.2), one(0.6)))


ARGUMENTS = double(-0.5, -1e-3, 1e-3, 0.2, 0.6, 0.8, 0.79, 0.3)
SIZES = double(0.8, 0.9, 0.7, 0.9, 1.1, 0.81, 0.8, 0.5)


@pytest.mark.parametrize("n_s", [3.0, 20.0, 80.0])
@pytest.mark.parametrize("ggx", [False, True])
def test_slopes_of_the_lobe_are_those_of_autograd(ggx, n_s):
    exponent = torch.full_like(SIZES, n_s)
    value, (by_u, by_size, by_exponent) = by_autograd(lambda u, w, n: lobe(u, w, n, ggx), ARGUMENTS, SIZES, exponent)
    assert float(value.max()) > 1e-9
    found = lobe_with_slopes(ARGUMENTS, SIZES, exponent, ggx)
    for ours, expected in zip(found, (value, by_u, by_size), strict=True):
        torch.testing.assert_close(ours, expected, rtol=1e-9, atol=1e-12)
    by_n_s = lobe_by_exponent(ARGUMENTS, SIZES, exponent, ggx)
    torch.testing.assert_close(by_n_s, by_exponent, rtol=1e-9, atol=1e-12)
    inputs = tuple(x.clone().requires_grad_() for x in (ARGUMENTS, SIZES, one(min(n_s, 20.0))))
    assert torch.autograd.gradcheck(lambda u, w, n: lobe(u, w, n, ggx), inputs)


@given(st.floats(0.3, 1.3), st.floats(1, 100))
def test_the_ggx_lobe_is_as_high_as_the_power_in_the_mirror_direction_but_for_its_foot(size, n_s):
    height = float(lobe(one(size), one(size), one(n_s), True))
    assert height == pytest.approx(size**n_s * (1 - (1 + n_s / 2) ** -2), rel=1e-9)


@given(st.floats(0.3, 1.3), st.floats(1, 100), st.floats(-1, 0))
def test_the_ggx_lobe_is_nothing_at_ninety_degrees_and_beyond(size, n_s, cosine):
    assert float(lobe(one(cosine * size), one(size), one(n_s), True)) == 0.0
    # And runs into it without a step.
    assert 0 < float(lobe(one(1e-6 * size), one(size), one(n_s), True)) < 1e-5 * size**n_s


@given(st.floats(0.1, 0.6), st.floats(0, 1.5))
def test_the_ggx_lobe_is_the_distribution_of_ggx(roughness, angle):
    """Of microfacets whose normals lie at half the angle from the mirror direction (Walter et al., 2007, Eq. 33)."""

    def distribution(t):
        cosine = math.cos(t / 2)
        return roughness**2 / (math.pi * (cosine**2 * (roughness**2 - 1) + 1) ** 2)

    value = lobe(one(math.cos(angle)), one(1.0), one(1 / roughness**2 - 1), True)
    edge = distribution(math.pi / 2) / distribution(0)
    torch.testing.assert_close(value, one(distribution(angle) / distribution(0) - edge))


@given(st.floats(0, 3), st.floats(0.1, 5), st.floats(1, 60), st.booleans())
def test_a_lobe_of_a_longer_vector_is_higher_by_the_power(u, factor, n_s, ggx):
    size = max(u, 1.0)
    scaled = lobe(one(factor * u), one(factor * size), one(n_s), ggx)
    torch.testing.assert_close(
        scaled, one(factor) ** n_s * lobe(one(u), one(size), one(n_s), ggx), rtol=1e-8, atol=1e-12
    )


@pytest.mark.parametrize("ggx", [False, True])
def test_no_lobe_is_longer_than_the_ceiling(ggx):
    d, s, B, alpha = some_pixels()
    shared = some_globals(ggx=ggx)
    v = lobe_vector(d, s, B, shared)
    size = length(shared.M, v)
    ceiling = float(size.median())
    capped = lobe_of(v, shared, alpha, ceiling)
    shorter = v * (ceiling / size).clamp_max(1.0)
    torch.testing.assert_close(capped, lobe_of(shorter, shared, alpha), rtol=1e-9, atol=1e-12)
    assert float((lobe_of(v, shared, alpha) - capped).max()) > 0


@pytest.mark.parametrize("exponent", [0.3, 1.0, 2.5])
def test_power_and_derivatives_are_zero_at_and_below_zero(exponent):
    base = double(-2.0, -1e-300, 0.0, 0.5).requires_grad_()
    power = torch.full((), exponent, dtype=torch.float64, requires_grad=True)
    value = positive_power(base, power)
    by_base, by_power = torch.autograd.grad(value.sum(), (base, power))
    assert torch.equal(value[:3], torch.zeros(3, dtype=torch.float64))
    assert torch.equal(by_base[:3], torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(by_base[3], one(exponent * 0.5 ** (exponent - 1)))
    torch.testing.assert_close(by_power, one(0.5**exponent) * one(0.5).log())


@given(finite)
def test_softness_zero_is_the_hard_clamp(x):
    assert float(transmitted(one(x), one(0.0), one(0.0))) == pytest.approx(max(x, 0.0), abs=1e-6)


@given(st.floats(-1, 1), st.floats(0.01, 1))
def test_the_soft_edge_lies_above_the_clamp_by_half_its_width_at_most(x, width):
    soft = float(transmitted(one(x), one(width), one(0.0)))
    assert max(x, 0.0) < soft <= max(x, 0.0) + 0.5 * width + 1e-9
    assert soft - x == pytest.approx(float(transmitted(one(-x), one(width), one(0.0))), abs=1e-9)


@given(st.floats(0.001, 1))
def test_the_whole_of_fresnels_losses_is_schlicks_term(cosine):
    entered = float(transmitted(one(cosine), one(0.0), one(1.0)))
    assert entered == pytest.approx(cosine * (1 - (1 - cosine) ** 5), rel=1e-6, abs=1e-9)


@given(finite.filter(lambda x: x == 0 or abs(x) > 1e-30), st.floats(0.3, 3))
def test_the_signed_root_keeps_the_sign_and_undoes_the_power(x, n_d):
    root = signed_root(double(x), n_d)
    assert root.sign() == double(x).sign()
    torch.testing.assert_close(root.sign() * root.abs() ** n_d, double(x), rtol=1e-9, atol=0)


def test_the_signed_root_of_noise_about_zero_is_unbiased():
    noise = torch.randn(100_000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    root = signed_root(noise, 1.7)
    assert abs(float(root.mean())) < 4 * float(root.std()) / len(noise) ** 0.5


def test_the_lobe_is_driven_by_the_mean_over_channels():
    d, s, B, _ = some_pixels()
    shared = some_globals(f=one(0.4))
    v = lobe_vector(d, s, B, shared)
    torch.testing.assert_close(v, lobe_vector(d.flip(1), s.flip(1), B, shared))
    torch.testing.assert_close(v, lobe_vector(d.mean(1, keepdim=True), s.mean(1, keepdim=True), B, shared))
