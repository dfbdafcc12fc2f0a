from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from reflectsep.errors import FitError
from reflectsep.fit import reflectance
from reflectsep.fit.blocks import build_problem
from reflectsep.fit.options import FitOptions
from reflectsep.fit.outcome import warnings
from reflectsep.fit.problem import LOG_N_D, LOG_N_S, MOST_LOG_N_S, SOFTNESS, Locals, s_of_lights
from reflectsep.fit.reflectance import fit_reflectance, observe, prepare, try_soft_edges, with_noise_of_fit
from reflectsep.fit.solution import LocalFit, fit_locals
from reflectsep.flags import Flag
from reflectsep.progress import silent

QUICK = FitOptions(
    globals_pixels=40, max_iterations=6, lobe="single", prior="none", scattering_sd=0.0, method="two_step"
)


def assert_sound(fit, case):
    """Finite everywhere, zero outside the mask, certainty where there is a pixel."""
    for name in ("d", "s", "B", "d_sd", "B_sd", "residual", "a", "n_s", "covariance"):
        assert getattr(fit, name).isfinite().all(), name
    assert (fit.B[..., case.stack.mask] > 0).all()
    assert (fit.d_sd[..., case.stack.mask] > 0).all()
    assert (fit.a < 0).all()
    assert fit.d.shape == (3, *case.stack.images.shape[1:])
    assert fit.covariance.shape == (len(fit.global_names),) * 2


@pytest.mark.parametrize(("scattering", "lights"), [("measured", 5), ("none", 5), ("unknown", 7)])
def test_too_few_pictures_are_refused(paper_case, scattering, lights):
    case = paper_case(size=8, lights=lights)
    with pytest.raises(FitError, match=rf"{lights} pictures.*at least {lights + 1}"):
        fit_reflectance(case.stack, case.scattering, FitOptions(scattering=scattering))


def test_nothing_to_fit_is_refused(small_case):
    stack = small_case.stack
    empty = replace(stack, mask=torch.zeros_like(stack.mask))
    invalid = replace(stack, flags=torch.full_like(stack.flags, int(Flag.INVALID_INPUT)))
    for broken in (empty, invalid):
        with pytest.raises(FitError, match="no pixel"):
            fit_reflectance(broken, small_case.scattering)
    with pytest.raises(FitError, match="no contrast"):
        fit_reflectance(replace(stack, images=torch.full_like(stack.images, 0.3)), small_case.scattering)
    dark = -stack.images.abs() - 0.1
    with pytest.raises(FitError, match="nothing to fit"):
        fit_reflectance(replace(stack, images=dark), small_case.scattering)


def test_invalid_pixels_are_left_out(small_case):
    flags = small_case.stack.flags.clone()
    flags[2, 3] = int(Flag.INVALID_INPUT)
    images = small_case.stack.images.clone()
    images[4, 0, 2, 3] = torch.nan
    stack = replace(small_case.stack, flags=flags, images=images)
    obs, mask, _ = observe(stack, small_case.scattering, FitOptions(), torch.float64)
    assert not mask[2, 3]
    assert len(obs) == int(small_case.stack.mask.sum()) - 1


def test_pixels_whose_scattering_is_no_number_are_left_out_and_flagged(small_case):
    root = small_case.scattering.root.clone()
    root[1, 0, 2, 3] = torch.nan
    broken = replace(small_case.scattering, root=root)
    fit = fit_reflectance(small_case.stack, broken, QUICK)
    assert fit.d.isfinite().all()
    assert torch.isfinite(torch.tensor(fit.noise))
    assert int(fit.flags[2, 3]) & int(Flag.INVALID_INPUT)
    assert int(((fit.flags & int(Flag.INVALID_INPUT)) > 0).sum()) == 1
    without = fit_reflectance(small_case.stack, broken, replace(QUICK, scattering="none"))
    assert not (without.flags & int(Flag.INVALID_INPUT)).any()
    with pytest.raises(FitError, match=r"scattering is not finite at any of the \d+ pixels"):
        fit_reflectance(small_case.stack, replace(broken, root=torch.full_like(root, torch.nan)), QUICK)


def test_an_exponent_at_its_bound_is_warned_of(small_case):
    obs, mask, _ = observe(small_case.stack, small_case.scattering, QUICK, torch.float64)
    state = prepare(obs, mask, QUICK)
    state = replace(state, found=fit_locals(state.obs, state.priors, state.shared, state.effort, state.robust))
    sharp = state.shared.clone()
    sharp[LOG_N_S] = MOST_LOG_N_S
    said = lambda state: any("n_s ended at 200" in text for text in warnings(state, QUICK))  # noqa: E731
    assert said(replace(state, shared=sharp))
    assert not said(state)
    held = state.free.clone()
    held[LOG_N_S] = False
    assert not said(replace(state, shared=sharp, free=held))


def test_costs_that_are_no_numbers_are_said(small_case):
    obs, mask, _ = observe(small_case.stack, small_case.scattering, QUICK, torch.float64)
    state = prepare(obs, mask, QUICK)
    found = fit_locals(state.obs, state.priors, state.shared, state.effort, state.robust)
    state = replace(state, found=replace(found, cost=torch.full_like(found.cost, torch.inf)))
    with pytest.raises(FitError, match=rf"{len(obs)} of {len(obs)} pixels have no finite cost"):
        with_noise_of_fit(state, QUICK)


def test_brighter_lights_are_divided_out(small_case):
    scale = torch.tensor([1.0, 2.0, 0.5, 1.0, 3.0, 1.0])
    stack = small_case.stack
    brighter = replace(
        stack, images=stack.images * scale[:, None, None, None], light_vectors=stack.light_vectors * scale[:, None]
    )
    scattering = replace(small_case.scattering, root=small_case.scattering.root * scale[:, None, None, None])
    plain, _, _ = observe(stack, small_case.scattering, FitOptions(), torch.float64)
    obs, _, intensity = observe(brighter, scattering, FitOptions(), torch.float64)
    torch.testing.assert_close(intensity.float(), scale)
    torch.testing.assert_close(obs.images, plain.images, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(obs.s, plain.s, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(obs.alpha, plain.alpha, rtol=1e-5, atol=1e-5)


def test_without_scattering_s_is_nothing(small_case):
    for scattering, options in ((None, FitOptions()), (small_case.scattering, FitOptions(scattering="none"))):
        obs, _, _ = observe(small_case.stack, scattering, options, torch.float64)
        assert float(obs.s.abs().max()) == 0.0
        assert not obs.s_unknown
        assert obs.n_d == 1.0


def test_lit_scattering_passes_through_and_the_noise_is_found(paper_case):
    case = paper_case(size=24, lights=12, sigma=0.01)
    options = FitOptions(scattering_sd=0.0)
    obs, mask, _ = observe(case.stack, case.scattering, options, torch.float64)
    state = prepare(obs, mask, options)
    lit = ((case.truth.d > 0.15)[:, 0][:, mask]).all(0)
    torch.testing.assert_close(state.obs.s_basis[lit], obs.s_basis[lit], rtol=1e-6, atol=1e-6)
    assert 0.005 < state.sigma < 0.1


@pytest.fixture(scope="module")
def quick_fit(small_case):
    return fit_reflectance(small_case.stack, small_case.scattering, QUICK)


def test_two_steps_alone_recover_clean_pictures(quick_fit, small_case):
    assert_sound(quick_fit, small_case)
    sees = small_case.sees_lobe(0.003)
    D, truth = quick_fit.d.clamp_min(0), small_case.truth.d.clamp_min(0)
    assert float((((D - truth).abs() < 0.01 * truth.amax(0)).all(0)[0])[sees].float().mean()) > 0.95
    assert float((quick_fit.a / small_case.truth.a - 1).abs().max()) < 0.05
    assert float(quick_fit.n_s) == pytest.approx(small_case.truth.n_s, rel=0.05)
    assert quick_fit.crest == 0
    assert quick_fit.softness == 0
    assert small_case.psnr(quick_fit) > 35


def test_flags_name_what_the_fit_noticed(quick_fit, small_case):
    shadow = (quick_fit.flags & int(Flag.ATTACHED_SHADOW)) > 0
    assert torch.equal(shadow, (quick_fit.d.mean(1) < 0).any(0))
    outlier = (quick_fit.flags & int(Flag.SHADOW_OR_OUTLIER)) > 0
    assert float(outlier.float().mean()) < 0.05


def test_a_fixed_exponent_stays_fixed(paper_case):
    case = paper_case(size=12)
    fit = fit_reflectance(case.stack, case.scattering, replace(QUICK, n_s=11.0))
    assert float(fit.n_s) == pytest.approx(11.0, rel=1e-6)
    assert "log_n_s" not in fit.global_names
    assert_sound(fit, case)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("paper", "options"),
    [
        pytest.param({"lights": 8}, FitOptions(scattering="unknown", max_iterations=6), id="unknown scattering"),
        pytest.param({}, FitOptions(refine_n_d=True, max_iterations=6), id="refined n_d"),
        pytest.param({"channels": 3}, FitOptions(max_iterations=6), id="colour"),
        pytest.param({}, FitOptions(dtype="float32", max_iterations=6), id="single precision"),
    ],
)
def test_every_way_of_fitting_runs_and_relights(paper_case, paper, options):
    case = paper_case(size=20, **paper)
    fit = fit_reflectance(case.stack, case.scattering, replace(options, globals_pixels=80))
    assert_sound(fit, case)
    assert case.psnr(fit) > 28
    if options.refine_n_d:
        assert float(fit.n_d) == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
def test_unknown_light_directions_fit_by_alpha_alone(paper_case, without_vectors):
    case = paper_case(size=20)
    fit = fit_reflectance(without_vectors(case), case.scattering, FitOptions(globals_pixels=80, max_iterations=6))
    assert_sound(fit, case)
    assert any("directions are unknown" in said for said in fit.warnings)
    assert case.psnr(fit) > 28


@pytest.mark.slow
def test_clipped_highlights_enter_as_lower_bounds(paper_case):
    case = paper_case(size=24)
    limit = float(case.stack.images.quantile(0.97))
    clipped = replace(case.stack, images=case.stack.images.clamp_max(limit), saturated=case.stack.images >= limit)
    believed = replace(clipped, saturated=torch.zeros_like(clipped.saturated))
    fit = fit_reflectance(clipped, case.scattering, QUICK)
    assert_sound(fit, case)
    assert case.psnr(fit) > case.psnr(fit_reflectance(believed, case.scattering, QUICK))


def test_a_light_with_its_own_sweep_keeps_what_was_measured(paper_case):
    case = paper_case(size=16)
    lights = len(case.stack.names)
    root = case.scattering.root.clone()
    root[3] *= 0.9
    options = FitOptions(scattering_sd=0.0)
    for swept in (False, True):
        measured = (True, True, True, swept, *[False] * (lights - 4))
        scattering = replace(case.scattering, root=root, measured=measured)
        obs, mask, _ = observe(case.stack, scattering, options, torch.float64)
        state = prepare(obs, mask, options)
        mixed = state.obs.s_basis @ state.obs.alpha.mT
        lit = (case.truth.d[:, 0, mask] > 0.05).all(0)  # no shadow's edge, beyond which s is extended
        ratio = (state.obs.s[:, 0, 3] / mixed[:, 0, 3])[lit]
        assert float((ratio - (0.9 if swept else 1.0)).abs().max()) < 1e-6
        # Where s is refined, by a shift of the basis, that light moves along and keeps its own difference.
        free = replace(state.obs, s_unknown=True)
        x = Locals(free.images[..., :3], free.images[:, 0, 0], 1.02 * free.s_basis)
        torch.testing.assert_close(s_of_lights(x, free), free.s + 0.02 * mixed)


def test_refining_n_d_starts_from_the_sweeps_and_is_held_to_them(paper_case):
    case = paper_case(size=16)
    scattering = replace(case.scattering, n_d=0.9, n_d_sd=0.02)
    options = FitOptions(refine_n_d=True)
    obs, mask, _ = observe(case.stack, scattering, options, torch.float64)
    state = prepare(obs, mask, options)
    assert float(state.shared[LOG_N_D].exp()) == pytest.approx(0.9)
    row = build_problem(state.obs, state.priors, robust=None).shared_residual
    assert row is not None
    moved = state.shared.clone()
    moved[LOG_N_D] += 0.05
    # 0.05 off is 0.05 / (0.02 / 0.9) = 2.25 standard deviations.
    assert float((row(moved) - row(state.shared)).abs().max()) == pytest.approx(2.25)


@pytest.mark.parametrize(
    ("gains", "kept", "fitted"),
    [((0.02, 0.02), True, [192, 576]), ((0.005, 0.02), False, [192]), ((0.02, 0.005), False, [192, 576])],
)
def test_some_of_many_pixels_tell_whether_soft_shadows_are_worth_fitting(small_case, monkeypatch, gains, kept, fitted):
    obs, mask, _ = observe(small_case.stack, small_case.scattering, QUICK, torch.float64)
    state = prepare(obs, mask, QUICK)
    flat = obs.images[:, 0, 0]
    local = torch.zeros(len(obs), 4, dtype=torch.float64)
    state = replace(state, found=LocalFit(local, torch.ones_like(flat), flat, flat > 0))
    sizes = []

    def joint_step(state, stage, progress):
        sizes.append(len(state.obs))
        assert torch.equal(state.obs.images, obs.images[:: 576 // sizes[-1]])
        assert state.shared[SOFTNESS] > 0
        assert state.free[SOFTNESS]
        cost = torch.full_like(state.found.cost, 1.0 - gains[len(sizes) - 1])
        return replace(state, found=replace(state.found, cost=cost))

    monkeypatch.setattr(reflectance, "TRIAL", 192)
    monkeypatch.setattr(reflectance, "joint_step", joint_step)
    monkeypatch.setattr(reflectance, "rescored", lambda state: state)
    found = try_soft_edges(state, silent)
    assert sizes == fitted
    assert (found.shared[SOFTNESS] > 0) == kept
