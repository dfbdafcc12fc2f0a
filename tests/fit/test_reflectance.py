from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from reflectsep.data import Learnt
from reflectsep.errors import FitError
from reflectsep.fit.options import FitOptions
from reflectsep.fit.outcome import Pictures, warnings
from reflectsep.fit.problem import ALPHA, FRESNEL, LOG_N_D, LOG_N_S, SOFTNESS, F
from reflectsep.fit.reflectance import fit_reflectance, noise_of, observe, prepare, start_of
from reflectsep.flags import Flag
from reflectsep.workload import Counts, solving

QUICK = FitOptions(max_iterations=6, prior="none", method="two_step")


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
    obs, mask, _ = observe(stack, small_case.scattering, FitOptions())
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


def state_of(case, options=QUICK, scattering=None):
    obs, mask, _ = observe(case.stack, scattering or case.scattering, options)
    return prepare(obs, mask, options)


def test_an_exponent_that_no_lobe_has_is_warned_of(small_case):
    state = state_of(small_case)
    shared = state.shared.clone()
    state = replace(state, local=start_of(state.problem, shared))
    pictures = Pictures(state, 4096, torch.ones(6))
    said = lambda state: any("n_s ended at" in text for text in warnings(state, QUICK, pictures))  # noqa: E731
    assert not said(state)
    for log_n_s in (math.log(0.3), math.log(5000)):
        moved = shared.clone()
        moved[LOG_N_S] = log_n_s
        assert said(replace(state, shared=moved))
        held = state.free.clone()
        held[LOG_N_S] = False
        assert not said(replace(state, shared=moved, free=held))


def test_costs_that_are_no_numbers_are_said(small_case):
    state = state_of(small_case)
    problem, pixels = state.problem, len(state.problem)
    local = torch.full_like(start_of(problem, state.shared), torch.nan)
    with pytest.raises(FitError, match=rf"{pixels} of {pixels} pixels have no finite cost"):
        noise_of(problem, local, state.shared, 100, 1e-6)


def test_the_noise_is_that_of_the_residuals_with_freedoms_counted(model_case):
    case = model_case(noise=0.004, size=24)
    obs, mask, _ = observe(case.stack, case.scattering, FitOptions())
    state = prepare(obs, mask, FitOptions(prior="none"))
    shared = state.shared.clone()
    shared[:3] = (-case.shared.a).log()
    shared[3:ALPHA] = torch.tensor([math.log(25.0), 0.4, 0.08, 0.7, 0.0])
    local = state.problem.packed(case.d.flatten(2), case.B.flatten().log())
    # At the truth residuals are the noise; the worst tenth is left out, four of seven freedoms are counted.
    found = noise_of(state.problem, local, shared, 4096, 1e-9)
    left_out = noise_of(state.problem, local, shared, 50, 1e-9)
    assert found == pytest.approx(left_out, rel=1e-9)
    assert 1.0 < found / case.sigma < (7 / 3) ** 0.5
    assert noise_of(state.problem, local, shared, 4096, 1.0) == 1.0


@pytest.mark.parametrize(
    ("options", "free"),
    [
        (FitOptions(), "a a a n_s f softness fresnel"),
        (FitOptions(scattering="none"), "a a a n_s softness fresnel"),
        (FitOptions(shading="lambert", f=1.0), "a a a n_s"),
        (FitOptions(n_s=9.0, refine_n_d=True), "a a a f softness fresnel n_d"),
    ],
)
def test_settings_choose_the_free_globals(small_case, options, free):
    state = state_of(small_case, options)
    names = ["a", "a", "a", "n_s", "f", "softness", "fresnel", "n_d"]
    assert " ".join(name for name, chosen in zip(names, state.free.tolist(), strict=True) if chosen) == free
    assert float(state.shared[LOG_N_S].exp()) == pytest.approx(options.n_s or 20.0)
    if options.shading == "lambert":
        assert state.shared[[SOFTNESS, FRESNEL]].tolist() == [0.0, 0.0]
    if options.scattering == "none":
        assert float(state.shared[F]) == 1.0
    wide = state_of(small_case, replace(options, alpha_sd=0.01))
    assert len(wide.shared) == ALPHA + 9
    assert bool(wide.free[ALPHA:].all())


def test_alphas_are_refined_jointly_alone(small_case):
    with pytest.raises(FitError, match=r"alpha_sd 0\.01 with method two_step"):
        fit_reflectance(small_case.stack, small_case.scattering, FitOptions(method="two_step", alpha_sd=0.01))


def test_brighter_lights_are_divided_out(small_case):
    scale = torch.tensor([1.0, 2.0, 0.5, 1.0, 3.0, 1.0])
    stack = small_case.stack
    brighter = replace(
        stack, images=stack.images * scale[:, None, None, None], light_vectors=stack.light_vectors * scale[:, None]
    )
    scattering = replace(small_case.scattering, root=small_case.scattering.root * scale[:, None, None, None])
    plain, _, _ = observe(stack, small_case.scattering, FitOptions())
    obs, _, intensity = observe(brighter, scattering, FitOptions())
    torch.testing.assert_close(intensity.float(), scale)
    torch.testing.assert_close(obs.images, plain.images, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(obs.s, plain.s, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(obs.alpha, plain.alpha, rtol=1e-5, atol=1e-5)


def test_without_scattering_s_is_nothing(small_case):
    for scattering, options in ((None, FitOptions()), (small_case.scattering, FitOptions(scattering="none"))):
        obs, _, _ = observe(small_case.stack, scattering, options)
        assert float(obs.s.abs().max()) == 0.0
        assert obs.n_d == 1.0


@pytest.fixture(scope="module")
def quick_fit(model_case):
    case = model_case(size=16)
    stages = []
    fit = fit_reflectance(case.stack, case.scattering, progress=lambda *step: stages.append(step))
    return case, fit, stages


def test_stages_are_those_that_are_expected(quick_fit):
    _, _, stages = quick_fit
    counts = Counts(size=256, pixels=256, lights=7, channels=1)
    for part in solving(counts, FitOptions(), swept=True):
        shares = [done / total for stage, done, total in stages if stage == part.name]
        assert shares == sorted(shares)
        assert shares[-1] == 1.0
    assert {stage for stage, _, _ in stages} == {"globals", "pixels"}


def test_flags_name_what_the_fit_noticed(quick_fit):
    _, fit, _ = quick_fit
    shadow = (fit.flags & int(Flag.ATTACHED_SHADOW)) > 0
    assert torch.equal(shadow, ((fit.d + fit.s[:3]).mean(1) < 0).any(0))
    outlier = (fit.flags & int(Flag.SHADOW_OR_OUTLIER)) > 0
    assert torch.equal(outlier, (fit.residual.abs() > 5 * fit.noise).flatten(0, 1).any(0))
    assert float(outlier.float().mean()) < 0.05


def test_what_was_learnt_is_what_was_found(quick_fit):
    _, fit, _ = quick_fit
    assert fit.learnt is not None
    assert fit.learnt.noise == fit.noise
    assert fit.learnt.shared[LOG_N_S] == pytest.approx(math.log(float(fit.n_s)))
    assert fit.learnt.order == fit.global_names
    torch.testing.assert_close(torch.tensor(fit.learnt.covariance, dtype=torch.float64), fit.covariance)
    assert fit.learnt.smooth is not None


def test_held_globals_are_not_touched_and_pixels_end_where_they_were(quick_fit):
    case, fit, _ = quick_fit
    held = fit_reflectance(case.stack, case.scattering, FitOptions(given=fit.learnt))
    for name in ("a", "n_s", "f", "softness", "fresnel"):
        torch.testing.assert_close(getattr(held, name), getattr(fit, name), rtol=1e-6, atol=0)
    assert held.noise == fit.noise
    # Neighbours were heard once more often while the globals were sought, so that pixels differ by what that moves.
    for name in ("d", "B"):
        off = (getattr(held, name) - getattr(fit, name)).abs()
        assert float(off.max()) < 1e-2 * float(getattr(fit, name).abs().max())
    assert held.learnt == fit.learnt or held.learnt is not None


def test_a_part_of_the_object_under_held_globals_is_that_part(quick_fit):
    case, fit, _ = quick_fit
    assert fit.learnt is not None
    alone = replace(fit.learnt, smooth=None)  # pixels that hear of no neighbours
    whole = fit_reflectance(case.stack, case.scattering, FitOptions(given=alone))
    mask = torch.zeros_like(case.stack.mask)
    mask[3:9, 4:12] = True
    part = fit_reflectance(replace(case.stack, mask=mask), case.scattering, FitOptions(given=alone))
    torch.testing.assert_close(part.d[..., mask], whole.d[..., mask], rtol=1e-5, atol=1e-6)
    assert float(part.d[..., ~mask].abs().max()) == 0.0
    assert (part.flags[~mask] & int(Flag.OUTSIDE_MASK)).all()


def test_a_fit_starts_from_given_globals(quick_fit):
    case, fit, _ = quick_fit
    again = fit_reflectance(case.stack, case.scattering, FitOptions(given=fit.learnt, globals="start"))
    assert float(again.n_s) == pytest.approx(float(fit.n_s), rel=0.05)
    assert again.learnt != fit.learnt
    state = state_of(case, FitOptions(given=fit.learnt, globals="start", n_s=17.0))
    assert fit.learnt is not None
    assert state.shared[:3].tolist() == pytest.approx(fit.learnt.shared[:3])
    assert float(state.shared[LOG_N_S].exp()) == pytest.approx(17.0)


def test_a_fixed_exponent_stays_fixed(model_case):
    case = model_case(size=10)
    fit = fit_reflectance(case.stack, case.scattering, replace(QUICK, n_s=11.0))
    assert float(fit.n_s) == pytest.approx(11.0, rel=1e-6)
    assert "log_n_s" not in fit.global_names
    assert fit.d.isfinite().all()


def test_clipped_highlights_enter_as_lower_bounds(model_case):
    case = model_case(size=16)
    limit = float(case.stack.images.quantile(0.97))
    clipped = replace(case.stack, images=case.stack.images.clamp_max(limit), saturated=case.stack.images >= limit)
    believed = replace(clipped, saturated=torch.zeros_like(clipped.saturated))
    fit = fit_reflectance(clipped, case.scattering)
    assert case.psnr(fit) > case.psnr(fit_reflectance(believed, case.scattering))


def test_a_light_with_its_own_sweep_keeps_what_was_measured(model_case):
    case = model_case(size=8)
    root = case.scattering.root.clone()
    root[3] *= 0.9
    scattering = replace(case.scattering, root=root, measured=(True,) * 4 + (False,) * 3)
    obs, _, _ = observe(case.stack, scattering, FitOptions())
    torch.testing.assert_close(obs.s[3], root[3].flatten(1))
    assert obs.swept == scattering.measured


def test_refining_n_d_starts_from_the_sweeps_and_is_held_to_them(model_case):
    case = model_case(size=8)
    scattering = replace(case.scattering, n_d=0.9, n_d_sd=0.02)
    state = state_of(case, FitOptions(refine_n_d=True), scattering)
    assert float(state.shared[LOG_N_D].exp()) == pytest.approx(0.9)
    moved = state.shared.clone()
    moved[LOG_N_D] += 0.05
    rows = state.problem.shared_rows
    # 0.05 off is 0.05 / (0.02 / 0.9) = 2.25 standard deviations.
    assert float((rows(moved) - rows(state.shared)).abs().max()) == pytest.approx(2.25)


def test_nothing_learnt_is_not_held():
    learnt = Learnt(shared=(0.0,) * ALPHA, order=(), covariance=(), noise=0.01)
    assert FitOptions().held is None
    assert FitOptions(given=learnt).held is learnt
    assert FitOptions(given=learnt, globals="start").held is None
