from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.model import (
    Globals,
    diffuse,
    edge_width,
    lobe,
    lobe_argument,
    lobe_reaches,
    lobe_slope,
    positive_power,
    reflectance,
    signed_root,
    soft_positive,
)

finite = st.floats(-3, 3)


def double(*values):
    return torch.tensor(values, dtype=torch.float64)


def some_pixels(pixels=5, channels=2, lights=6, softness=0.0, crest=0.0, n_d=1.3):
    g = torch.Generator().manual_seed(4)
    rand = lambda *n: torch.rand(*n, generator=g, dtype=torch.float64)  # noqa: E731
    shared = Globals(
        a=double(-0.9, -0.8, -0.95), n_s=double(7.0)[0], n_d=n_d, softness=double(softness)[0], crest=double(crest)[0]
    )
    alpha = torch.cat([torch.eye(3, dtype=torch.float64), 1.5 * rand(lights - 3, 3) - 0.3])
    # Some patches face away, some lobes are dark.
    d, s, B = 0.8 * rand(pixels, channels, 3) - 0.2, 0.2 * rand(pixels, channels, lights), 2 + 3 * rand(pixels)
    return d, s, B, shared, alpha


def scalar_picture(  # noqa: PLR0917
    d, s, B, shared, alpha, softness, crest, p, c, j
):
    """Eqs. 20 and 21 for one pixel, channel and light, in plain numbers."""
    channels = d.shape[1]
    root = sum(float(alpha[j, i]) * float(d[p, c, i]) for i in range(3)) + float(s[p, c, j])
    e = softness * sum(float(s[p, c, i]) for i in range(3)) / 3
    root = (root + (root**2 + e**2) ** 0.5) / 2 if e > 0 else max(root, 0.0)
    u = 0.0
    for i in range(3):
        mean = sum(float(d[p, k, i]) for k in range(channels)) / channels
        u += float(alpha[j, i]) * (float(shared.a[i]) + float(B[p]) * mean)
    u, n_s = max(u, 0.0), float(shared.n_s)
    shine = u**n_s
    if crest > 0 and u > 0:
        least = 1 / (1 + n_s / 2) ** 2
        tail = 1 / (1 + n_s * (1 - u / crest) / 2) ** 2 if u < crest else (u / crest) ** n_s
        shine = crest**n_s * (tail - least)
    return root ** float(shared.n_d) + shine


@pytest.mark.parametrize(("softness", "crest"), [(0.0, 0.0), (0.3, 0.9)])
@pytest.mark.parametrize("n_d", [1.0, 0.8, 1.6])
def test_reflectance_is_equations_20_and_21(softness, crest, n_d):
    d, s, B, shared, alpha = some_pixels(softness=softness, crest=crest, n_d=n_d)
    width = edge_width(s[..., :3], shared.softness)
    pictures = reflectance(d, B, shared, s=s, alpha=alpha, width=width)
    assert pictures.shape == (5, 2, 6)
    for p in range(5):
        for c in range(2):
            for j in range(6):
                expected = scalar_picture(d, s, B, shared, alpha, softness, crest, p, c, j)
                assert float(pictures[p, c, j]) == pytest.approx(expected, rel=1e-10, abs=1e-12)


def test_the_example_has_both_sides_of_every_clamp():
    d, s, B, shared, alpha = some_pixels()
    for argument in (d @ alpha.mT + s, lobe_argument(d, B, shared.a, alpha)):
        assert 0.05 < float((argument > 0).double().mean()) < 0.999


def test_a_fitted_n_d_of_one_gives_what_the_number_one_gives():
    d, s, B, shared, alpha = some_pixels(n_d=1.0)
    fitted = Globals(a=shared.a, n_s=shared.n_s, n_d=double(1.0)[0], softness=shared.softness, crest=shared.crest)
    width = edge_width(s[..., :3], shared.softness)
    plain = reflectance(d, B, shared, s=s, alpha=alpha, width=width)
    torch.testing.assert_close(reflectance(d, B, fitted, s=s, alpha=alpha, width=width), plain)


@pytest.mark.parametrize("crest", [0.0, 0.9])
def test_gradients_are_those_of_finite_differences(crest):
    d, s, B, shared, alpha = some_pixels(pixels=3, softness=0.3, crest=crest)

    def picture(d, s, B, a, n_s, n_d, softness, crest, alpha):  # noqa: PLR0917
        g = Globals(a=a, n_s=n_s, n_d=n_d, softness=softness, crest=crest)
        return reflectance(d, B, g, s=s, alpha=alpha, width=edge_width(s[..., :3], softness))

    inputs = (d, s, B, shared.a, shared.n_s, double(1.3)[0], shared.softness, shared.crest, alpha)
    inputs = tuple(x.clone().requires_grad_() for x in inputs)
    assert torch.autograd.gradcheck(picture, inputs)
    assert torch.autograd.gradcheck(picture, inputs, check_forward_ad=True, check_backward_ad=False)


@pytest.mark.parametrize("exponent", [0.3, 1.0, 2.5])
def test_power_and_derivatives_are_zero_at_and_below_zero(exponent):
    base = double(-2.0, -1e-300, 0.0, 0.5).requires_grad_()
    power = torch.full((), exponent, dtype=torch.float64, requires_grad=True)
    value = positive_power(base, power)
    by_base, by_power = torch.autograd.grad(value.sum(), (base, power))
    assert torch.equal(value[:3], torch.zeros(3, dtype=torch.float64))
    assert torch.equal(by_base[:3], torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(by_base[3], double(exponent * 0.5 ** (exponent - 1))[0])
    torch.testing.assert_close(by_power, double(0.5**exponent)[0] * double(0.5)[0].log())


@pytest.mark.parametrize("width", [0.0, 0.2])
def test_soft_positive_has_finite_derivatives_everywhere(width):
    x = double(-1.0, 0.0, 1.0).requires_grad_()
    w = torch.full((3,), width, dtype=torch.float64, requires_grad=True)
    gradients = torch.autograd.grad(soft_positive(x, w).sum(), (x, w))
    assert all(g.isfinite().all() for g in gradients)
    assert float(gradients[0][0]) < 0.05
    assert float(gradients[0][2]) > 0.95


@given(finite)
def test_width_zero_is_the_hard_clamp(x):
    assert float(soft_positive(double(x), double(0.0))) == pytest.approx(max(x, 0.0), abs=1e-9)


@given(finite, st.floats(0.01, 1))
def test_the_soft_edge_lies_above_the_clamp_by_half_its_width_at_most(x, width):
    soft = float(soft_positive(double(x), double(width)))
    assert max(x, 0.0) < soft <= max(x, 0.0) + 0.5 * width + 1e-12
    assert soft - x == pytest.approx(float(soft_positive(double(-x), double(width))), abs=1e-9)


@given(st.floats(0, 3), st.floats(0.1, 5), st.floats(1, 60))
def test_the_single_lobe_is_homogeneous(u, factor, n_s):
    zero = double(0.0)[0]
    scaled = lobe(double(factor * u), double(n_s), zero)
    torch.testing.assert_close(
        scaled, double(factor) ** n_s * lobe(double(u), double(n_s), zero), rtol=1e-8, atol=1e-12
    )


@given(st.floats(0.1, 0.6), st.floats(0, 1.5))
def test_the_lobe_with_a_crest_is_the_distribution_of_ggx(roughness, angle):
    """Of microfacets whose normals lie at half the angle from the mirror direction (Walter et al., 2007, Eq. 33)."""

    def distribution(t):
        cosine = math.cos(t / 2)
        return roughness**2 / (math.pi * (cosine**2 * (roughness**2 - 1) + 1) ** 2)

    n_s = double(1 / roughness**2 - 1)
    value = lobe(double(math.cos(angle)), n_s, double(1.0))
    edge = distribution(math.pi / 2) / distribution(0)  # it is nothing from there on
    torch.testing.assert_close(value, double(distribution(angle) / distribution(0) - edge))


@given(st.floats(0.3, 1.2), st.floats(1, 60))
def test_both_lobes_leave_the_crest_alike(crest, n_s):
    at, off = double(crest), double(crest * 0.9999)
    least = crest**n_s / (1 + n_s / 2) ** 2
    zero = double(0.0)
    for u, rel in ((at, 1e-9), (off, 1e-4)):
        assert float(lobe(u, double(n_s), at)) + least == pytest.approx(float(lobe(u, double(n_s), zero)), rel=rel)


@given(st.floats(-0.3, 1.5), st.floats(2, 60), st.sampled_from([0.0, 0.8]))
def test_slope_and_inverse_of_the_lobe(u, n_s, crest):
    n, C = double(n_s), double(crest)
    x = double(u).requires_grad_()
    value = lobe(x, n, C)
    (slope,) = torch.autograd.grad(value, x)
    torch.testing.assert_close(lobe_slope(x.detach(), n, C), slope)
    if float(value.detach()) > 1e-9:
        torch.testing.assert_close(lobe_reaches(value.detach(), n, C), x.detach())
    else:
        assert u <= 0.25 or n_s > 5


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
    d, _, B, shared, alpha = some_pixels()
    u = lobe_argument(d, B, shared.a, alpha)
    assert torch.equal(u, lobe_argument(d.flip(1), B, shared.a, alpha))
    torch.testing.assert_close(u, lobe_argument(d.mean(1, keepdim=True), B, shared.a, alpha))


def test_edge_width_is_a_share_of_the_mean_scattering_and_never_negative():
    s = double(0.1, 0.2, 0.3)[None]
    torch.testing.assert_close(edge_width(s, double(0.5)[0]), double(0.1)[None])
    assert float(edge_width(-s, double(0.5)[0])) == 0.0


def test_diffuse_with_a_plain_one_is_its_argument_clamped():
    root = double(-0.3, 0.0, 0.7)
    torch.testing.assert_close(diffuse(root, double(0.0), 1.0), double(0.0, 0.0, 0.7))
    torch.testing.assert_close(diffuse(root, double(0.0), 2.0), double(0.0, 0.0, 0.49))
