import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.errors import SettingsError
from reflectsep.synth.kernels import DipoleKernel, ExponentialKernel

EXPONENTIAL = ExponentialKernel((0.7, 0.3), (1.5, 4.0))
DIPOLE = DipoleKernel(scattering_per_px=0.6, absorption_per_px=0.02, ior=1.4)


def on_disc(kernel, radius):
    """The integral of a kernel over a disc, by brute force."""
    edges = torch.linspace(0, radius, 40_001, dtype=torch.float64)
    r = (edges[1:] + edges[:-1]) / 2
    return float((kernel(r) * 2 * math.pi * r).sum() * (edges[1] - edges[0]))


@pytest.mark.parametrize("kernel", [EXPONENTIAL, DIPOLE])
@pytest.mark.parametrize("radius", [0.3, 0.5642, 3.0, 40.0])
def test_the_share_within_a_radius_is_the_integral_of_the_kernel(kernel, radius):
    assert kernel.within(radius) == pytest.approx(on_disc(kernel, radius), rel=1e-5)


def test_exponentials_lose_no_light():
    assert EXPONENTIAL.within(1000.0) == pytest.approx(1.0, abs=1e-12)


@given(st.floats(0.05, 3.0), st.floats(1e-3, 1.0), st.floats(1.0, 2.0), st.floats(0.1, 200.0), st.floats(1.001, 3.0))
def test_a_dipole_loses_light_and_more_of_it_leaves_within_a_larger_disc(scattering, absorption, ior, radius, factor):
    kernel = DipoleKernel(scattering_per_px=scattering, absorption_per_px=absorption, ior=ior)
    assert 0 <= kernel.within(radius) <= kernel.within(radius * factor) + 1e-12 <= 1


def test_a_dipole_absorbs_all_but_the_diffuse_albedo_of_its_two_sources():
    # Jensen et al.'s total: albedo'/2 (1 + exp(-4/3 A sqrt(3 (1 - albedo')))) exp(-sqrt(3 (1 - albedo'))).
    albedo = 0.6 / 0.62
    f_dr = -1.440 / 1.4**2 + 0.710 / 1.4 + 0.668 + 0.0636 * 1.4
    root = math.sqrt(3 * (1 - albedo))
    total = albedo / 2 * (1 + math.exp(-4 / 3 * (1 + f_dr) / (1 - f_dr) * root)) * math.exp(-root)
    assert DIPOLE.within(1e5) == pytest.approx(total, rel=1e-9)


@pytest.mark.parametrize(
    "weights_lengths", [((0.5, 0.6), (1.0, 2.0)), ((1.0,), (0.0,)), ((0.5, 0.5), (1.0,)), ((1.5, -0.5), (1.0, 2.0))]
)
def test_exponentials_that_make_light_are_refused(weights_lengths):
    with pytest.raises(SettingsError, match="exponential kernel"):
        ExponentialKernel(*weights_lengths)


def test_a_dipole_without_scattering_is_refused():
    with pytest.raises(SettingsError, match="sigma_s' 0"):
        DipoleKernel(scattering_per_px=0, absorption_per_px=0.1)
