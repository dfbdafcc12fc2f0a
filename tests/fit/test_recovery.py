"""Known truth recovered, at stated rates, without a hint of it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from reflectsep.fit.options import FitOptions
from reflectsep.fit.reflectance import fit_reflectance

PAPER = FitOptions(
    method="two_step", lobe="power", shading="lambert", f=1.0, lambda_other=2.0, robust="none", prior="none"
)
PLAIN = {"ggx": False, "f": 1.0, "softness": 0.0, "fresnel": 0.0, "n_s": 14.0}
"""Truth of the paper's own formula."""


def assert_sound(fit, case):
    """Finite everywhere, certainty where there is a pixel, and a lobe that no bound has made."""
    for name in ("d", "s", "B", "d_sd", "B_sd", "residual", "a", "n_s", "f", "softness", "fresnel", "covariance"):
        assert getattr(fit, name).isfinite().all(), name
    assert (fit.B[case.stack.mask] >= 0).all()
    assert float((fit.B > 0)[case.stack.mask].double().mean()) > 0.9
    assert (fit.d_sd[..., case.stack.mask] > 0).all()
    assert (fit.a < 0).all()
    assert 1.0 < float(fit.n_s) < 1000.0
    assert 0 <= float(fit.f) <= 1
    assert 0 <= float(fit.fresnel) <= 1
    assert fit.d.shape == (3, *case.stack.images.shape[1:])
    assert fit.B.shape == fit.B_sd.shape == case.stack.mask.shape
    assert fit.covariance.shape == (len(fit.global_names),) * 2
    assert fit.warnings == () or case.stack.light_vectors is None


@pytest.fixture(scope="module")
def grey(model_case):
    case = model_case()
    return case, fit_reflectance(case.stack, case.scattering)


def test_globals_of_noisy_pictures_come_back(grey):
    case, fit = grey
    assert_sound(fit, case)
    assert float(fit.n_s) == pytest.approx(25.0, rel=0.1)
    assert float((fit.a / case.shared.a.float() - 1).abs().max()) < 0.05
    assert float(fit.f) == pytest.approx(0.4, abs=0.2)
    assert fit.noise == pytest.approx(case.sigma, rel=0.25)


def test_highlights_of_noisy_pictures_come_back_and_relight(grey):
    case, fit = grey
    assert case.specular_error(fit) < 0.15
    assert case.psnr(fit) > 38
    assert float((fit.d - case.d.float()).norm() / case.d.norm()) < 0.05


def test_residuals_are_the_noise(grey):
    case, fit = grey
    g, d, _, _ = case.found(fit)
    assert float(fit.residual.std()) == pytest.approx(case.sigma, rel=0.4)
    assert float(fit.residual.mean().abs()) < 0.2 * case.sigma
    assert g.ggx
    assert d.shape == case.d.shape


def test_standard_deviations_are_as_large_as_the_errors(grey):
    case, fit = grey
    off = ((fit.d - case.d.float()) / fit.d_sd).abs()
    assert 0.3 < float(off.median()) / 0.6745 < 3


def test_colour_recovers_as_well(model_case):
    case = model_case(channels=3, size=24)
    fit = fit_reflectance(case.stack, case.scattering)
    assert_sound(fit, case)
    assert float(fit.n_s) == pytest.approx(25.0, rel=0.1)
    assert case.specular_error(fit) < 0.2
    assert case.psnr(fit) > 38


def test_an_object_that_does_not_scatter(model_case):
    case = model_case(size=24, scattering=0.0)
    nothing = replace(case.scattering, root=torch.zeros_like(case.scattering.root))
    options = FitOptions(scattering="none")
    fit = fit_reflectance(case.stack, None, options)
    assert_sound(fit, case)
    assert float(fit.n_s) == pytest.approx(25.0, rel=0.1)
    assert case.psnr(fit) > 36
    assert float(fit.s.abs().max()) == 0.0
    # Sweeps that saw none say the same as none.
    swept = fit_reflectance(case.stack, nothing, options)
    torch.testing.assert_close(swept.d, fit.d, rtol=1e-5, atol=1e-6)
    assert case.psnr(fit_reflectance(case.stack, nothing)) > 36


@pytest.mark.parametrize(
    ("truth", "options", "least_dB"),
    [
        pytest.param(PLAIN, PAPER, 24.0, id="the paper's"),
        pytest.param(PLAIN, FitOptions(lobe="power", shading="lambert", f=1.0), 24.0, id="the paper's formula, joint"),
        pytest.param({}, FitOptions(dtype="float32"), 38.0, id="single precision"),
        pytest.param({"n_d": 1.1}, FitOptions(refine_n_d=True), 38.0, id="refined n_d"),
        pytest.param({}, FitOptions(alpha_sd=0.02), 36.0, id="refined alphas"),
        pytest.param({}, FitOptions(method="two_step"), 36.0, id="two steps"),
    ],
)
def test_every_way_of_fitting_recovers(model_case, truth, options, least_dB):
    case = model_case(size=16, **truth)
    fit = fit_reflectance(case.stack, case.scattering, options)
    assert_sound(fit, case)
    assert float(fit.n_s) == pytest.approx(float(case.shared.n_s), rel=0.1)
    assert case.psnr(fit) > least_dB
    assert fit.ggx == (options.lobe == "ggx")
    assert ("log_n_d" in fit.global_names) == options.refine_n_d
    assert (fit.alpha is None) == (options.alpha_sd == 0)
    if options.refine_n_d:
        assert float(fit.n_d) == pytest.approx(1.1, abs=0.05)
    if options.shading == "lambert":
        assert (float(fit.softness), float(fit.fresnel), float(fit.f)) == (0.0, 0.0, 1.0)


def test_unknown_light_directions_fit_by_alpha_alone(model_case):
    case = model_case(size=16, ggx=False, fresnel=0.0)
    fit = fit_reflectance(replace(case.stack, light_vectors=None), case.scattering)
    case = replace(case, stack=replace(case.stack, light_vectors=None))
    blind = replace(case, shared=replace(case.shared, M=torch.eye(3, dtype=torch.float64)))
    assert_sound(fit, blind)
    assert any("directions are unknown" in said for said in fit.warnings)
    assert not fit.ggx
    assert float(fit.fresnel) == 0.0
    assert blind.psnr(fit) > 20


@pytest.mark.slow
def test_scattering_that_nobody_measured_is_fitted(model_case):
    case = model_case(size=10, lights=9)
    fit = fit_reflectance(case.stack, None, FitOptions(scattering="unknown", max_iterations=10))
    for name in ("d", "s", "B", "d_sd", "B_sd", "residual", "a", "n_s"):
        assert getattr(fit, name).isfinite().all(), name
    assert float(fit.s[:3].abs().max()) > 0
    torch.testing.assert_close(fit.s, torch.einsum("ji,ichw->jchw", case.stack.alpha, fit.s[:3]), rtol=1e-4, atol=1e-5)
    assert case.psnr(fit) > 22


@pytest.mark.slow
def test_clean_pictures_of_a_larger_object_recover_closely(model_case):
    case = model_case(size=64, noise=1e-4)
    fit = fit_reflectance(case.stack, case.scattering)
    assert float(fit.n_s) == pytest.approx(25.0, rel=0.03)
    assert case.specular_error(fit) < 0.1
    assert case.psnr(fit) > 42


@pytest.mark.slow
def test_measured_scattering_relights_better_than_none(model_case):
    case = model_case(size=48, f=1.0)
    ours = fit_reflectance(case.stack, case.scattering)
    without = fit_reflectance(case.stack, None, FitOptions(scattering="none"))
    assert case.psnr(ours) > case.psnr(without)
