from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.fit import chunks
from reflectsep.fit.blocks import build_problem
from reflectsep.fit.expectations import (
    first_priors,
    noise_level,
    parallel_spread,
    parallel_weight,
    quantile,
    shape_spread,
    with_facing,
    with_ratio,
)
from reflectsep.fit.options import FitOptions
from reflectsep.fit.problem import (
    LOG_C_2,
    LOG_N_S,
    SOFTNESS,
    Locals,
    log_shape,
    no_priors,
    normalised_lobe,
    pixel_residual,
    shared_residual,
    unpack,
)
from reflectsep.fit.reflectance import observe, prepare, weights
from reflectsep.fit.solution import Effort, LocalFit, fit_locals, hand_on_lobes, initial_shared, lobe_pictures, merge
from reflectsep.solve.problem import forward_jacobian


def double(x):
    return torch.tensor(x, dtype=torch.float64)


def at_truth(case, *, scattering_sd=0.0):
    """Observations, and the true parameters as the solver's rows."""
    options = FitOptions(scattering_sd=scattering_sd)
    obs, mask, _ = observe(case.stack, case.scattering, options, torch.float64)
    d = case.truth.d[..., mask].permute(2, 1, 0)
    log_B = case.truth.B[0][mask].log()
    local = Locals(d, log_B, obs.s_basis if obs.s_unknown else None).pack()
    shared = initial_shared(obs.images, obs.cosine, 1.0, case.truth.n_s)
    shared[:3] = case.truth.a
    shared[LOG_C_2] = torch.log(double(2 * 0.91 * 1.015))
    return obs, mask, local, shared


def test_the_truth_leaves_no_residual(small_case):
    obs, _, local, shared = at_truth(small_case)
    rows = pixel_residual(local, shared, obs, no_priors(len(obs), obs.images))
    assert float(rows.abs().max()) < 1e-6
    priors = replace(no_priors(len(obs), obs.images), shape=10.0)
    # B of the paper's surface is C_2 N.V / q exactly, so the shape row vanishes too.
    assert float(pixel_residual(local, shared, obs, priors).abs().max()) < 1e-3


def test_locals_pack_and_unpack():
    g = torch.Generator().manual_seed(0)
    for s in (None, torch.rand(4, 3, 3, generator=g)):
        x = Locals(torch.rand(4, 3, 3, generator=g), torch.rand(4, generator=g), s)
        back = unpack(x.pack(), 3)
        assert torch.equal(back.d, x.d)
        assert torch.equal(back.log_B, x.log_B)
        assert (back.s is None) if s is None else torch.equal(back.s, s)


def test_every_pixels_jacobian_is_its_own(small_case):
    obs, mask, _ = observe(small_case.stack, small_case.scattering, FitOptions(), torch.float64)
    state = prepare(obs, mask, FitOptions())
    problem = build_problem(state.obs, state.priors, robust=5.0).take(torch.arange(0, 576, 97))
    obs, _, local, shared = at_truth(small_case, scattering_sd=0.03)
    local, shared = local[::97] + 0.01, shared + 0.01
    _, J, K = forward_jacobian(problem.residual, local, shared, problem.data)
    for p in range(2):
        one = problem.take(slice(p, p + 1))
        by_local, by_shared = torch.autograd.functional.jacobian(
            lambda x, g, one=one: one.residuals(x[None], g)[0], (local[p], shared)
        )
        torch.testing.assert_close(J[p], by_local, rtol=1e-8, atol=1e-8)
        torch.testing.assert_close(K[p], by_shared, rtol=1e-8, atol=1e-8)


def test_a_clipped_value_is_a_lower_bound(small_case):
    obs, _, local, shared = at_truth(small_case)
    priors = no_priors(len(obs), obs.images)
    clipped = replace(obs, clipped=torch.ones_like(obs.clipped))
    brighter = replace(clipped, images=obs.images - 0.1)
    darker = replace(clipped, images=obs.images + 0.1)
    count = obs.images[0].numel()
    assert float(pixel_residual(local, shared, brighter, priors)[:, :count].abs().max()) == 0.0
    torch.testing.assert_close(
        pixel_residual(local, shared, darker, priors)[:, :count], torch.full((len(obs), count), -0.1).double()
    )


def test_only_pictures_are_robust(small_case):
    obs, _, local, shared = at_truth(small_case, scattering_sd=0.03)
    priors = no_priors(len(obs), obs.images)
    problem = build_problem(obs, priors, robust=5.0)
    assert problem.threshold is not None
    assert problem.residuals(local, shared).shape[1] == len(problem.threshold)
    assert (problem.threshold[:6] == 5.0).all()
    assert problem.threshold[6:].isinf().all()
    assert build_problem(obs, priors, robust=None).threshold is None


def test_lambda_of_equation_22_weighs_squared_residuals(small_case):
    obs, *_ = at_truth(small_case)
    given = weights(obs, FitOptions(lambda_basis=1.0, lambda_other=2.0), 0.01)
    torch.testing.assert_close(given[0, 0].square() * 1e-4, double([1.0, 1, 1, 2, 2, 2]))
    assert (weights(obs, FitOptions(weights="noise"), 0.01) == 100.0).all()


def test_log_shape_is_the_geometry_of_the_lobe():
    basis = double([[0.4, 0.1, 0.9], [-0.3, 0.4, 0.87], [-0.1, -0.5, 0.86]])
    basis = basis / basis.norm(dim=1, keepdim=True)
    normal, view, q = double([0.1, -0.2, 0.97]), double([0.0, 0.0, 1.0]), 0.6
    normal = normal / normal.norm()
    value = log_shape(q * basis @ normal, torch.linalg.inv(basis), view, True)
    torch.testing.assert_close(value, torch.log(q / (normal @ view)), rtol=1e-4, atol=1e-5)
    away = log_shape(-q * basis @ normal, torch.linalg.inv(basis), view, True)
    assert away.isfinite()
    torch.testing.assert_close(log_shape(double([0.3, 0.6, 0.9]), basis, view, False), double(0.6).log())


def test_a_mirror_lobe_within_its_height_meets_the_shared_priors():
    cosine = double([0.9, 0.88, 0.86])
    priors = replace(no_priors(1, double([0.0])), height=1.0)
    shared = torch.zeros(8, dtype=torch.float64)
    shared[:3], shared[LOG_N_S], shared[LOG_C_2] = -0.9 * cosine, double(14.0).log(), double(1.8).log()
    assert float(shared_residual(shared, cosine, priors).abs().max()) < 1e-9
    for index, shift in ((0, -0.05), (LOG_C_2, 0.1), (SOFTNESS, 0.1)):
        moved = shared.clone()
        moved[index] += shift
        assert float(shared_residual(moved, cosine, priors).abs().max()) > 0.1
    moved = shared.clone()
    moved[:3] *= 1.2  # a peak of 1.08 ** 14 = 2.9
    assert float(shared_residual(moved, cosine, priors)[4]) == pytest.approx(14 * float(double(1.08).log()) / 0.03)


def test_the_noise_level_is_that_of_the_residuals():
    g = torch.Generator().manual_seed(0)
    images = torch.ones(5000, 1, 12, dtype=torch.float64)
    residual = 0.02 * torch.randn(5000, 1, 12, generator=g, dtype=torch.float64)
    residual[::20] = 5.0  # highlights have no say
    assert noise_level(images, residual, 0) == pytest.approx(0.02, rel=0.05)
    # A fit of 3 of 12 leaves 9 degrees of freedom.
    assert noise_level(images, residual * 0.75**0.5, 3) == pytest.approx(0.02, rel=0.05)
    assert noise_level(images, 0 * residual, 3) == pytest.approx(3e-4)


def test_the_first_priors_know_the_highest_highlight(small_case):
    obs, _, _, shared = at_truth(small_case)
    body = small_case.truth.d[..., small_case.stack.mask].permute(2, 1, 0) + obs.s_basis
    shine = small_case.specular[:, 0][:, small_case.stack.mask]
    priors = first_priors(obs, body, 1e-3, shared)
    assert priors.height == pytest.approx(2 * float(shine.max()), rel=0.05)
    assert first_priors(replace(obs, lights_known=False), body, 1e-3, shared).shape == pytest.approx(priors.shape / 2)


def test_parallel_is_believed_as_far_as_it_holds(small_case):
    obs, *_ = at_truth(small_case)
    assert parallel_spread(obs, 3 * obs.s_basis) < 1e-9
    crossed = obs.s_basis * double([1.5, 1.0, 0.7])
    assert parallel_spread(obs, crossed) > 0.06
    weight = [parallel_weight(obs, spread, 1e-3) for spread in (0.02, 0.05, 0.2)]
    assert (weight[0] > weight[1]).all()
    assert (weight[1] > weight[2]).all()
    # In units of the scattering: half as much of it, twice the weight, noise aside.
    fainter = parallel_weight(replace(obs, s=obs.s / 2), 0.02, 0.0)
    torch.testing.assert_close(fainter, 2 * parallel_weight(obs, 0.02, 0.0))


def test_the_ratio_row_holds_the_neighbourhoods_ratio(small_case):
    obs, mask, *_ = at_truth(small_case)
    none = no_priors(len(obs), obs.images)
    priors = with_ratio(none, obs, 2.5 * obs.s_basis, 2.0 * obs.s_basis, mask)
    torch.testing.assert_close(priors.ratio, torch.full((len(obs),), 2.5, dtype=torch.float64), rtol=1e-5, atol=1e-5)
    assert float(priors.ratio_weight.max()) == pytest.approx(100.0)
    dark = replace(obs, s=torch.zeros_like(obs.s))
    assert torch.equal(with_ratio(none, dark, obs.s_basis, obs.s_basis, mask).ratio_weight, none.ratio_weight)


def test_a_label_has_no_say_in_the_bodys_ratio_nor_the_body_in_its(small_case):
    obs, mask, *_ = at_truth(small_case)
    none = no_priors(len(obs), obs.images)
    rows, columns = mask.nonzero().T
    label = ((rows >= 10) & (rows < 13) & (columns >= 8) & (columns < 16))[:, None, None]
    body = torch.where(label, 6.0, 2.0) * obs.s_basis
    priors = with_ratio(none, obs, torch.where(label, 6.5, 2.5) * obs.s_basis, body, mask)
    label = label[:, 0, 0]
    assert (priors.ratio_weight[label] == 0).all()
    outside = priors.ratio_weight > 0
    assert int(outside.sum()) > 0.6 * int((~label).sum())
    assert float((priors.ratio[outside] - 2.5).abs().max()) < 0.05
    # A patch that only the present fit sets apart, as one in a wrong minimum, is still held to its neighbours.
    wrong = with_ratio(none, obs, torch.where(label[:, None, None], 6.5, 2.5) * obs.s_basis, 2.0 * obs.s_basis, mask)
    assert (wrong.ratio_weight[label] > 0).any()


def tilted(x, angle):
    """d of every pixel turned by `angle` within the space of the three lights, of the length it had."""
    across_it = torch.nn.functional.normalize(torch.linalg.cross(x.d, torch.ones_like(x.d)), dim=-1)
    return replace(x, d=x.d * math.cos(angle) + across_it * x.d.norm(dim=-1, keepdim=True) * math.sin(angle))


def test_a_lobe_is_held_to_the_direction_of_the_whole_light_as_firmly_as_the_seen_ones(small_case):
    obs, mask, local, shared = at_truth(small_case)
    none = no_priors(len(obs), obs.images)
    x, shine = unpack(local, 1), lobe_pictures(obs, local, shared)
    free = replace(obs, s=torch.zeros_like(obs.s))
    exact = with_facing(none, free, x, shared, shine, 1e-6, mask)
    flat = exact.facing_weight > 0
    torch.testing.assert_close(exact.facing, torch.nn.functional.normalize(x.d[:, 0], dim=-1))
    # The same light with its scattering turned away from d: nothing else but the learnt scatter differs.
    turned = tilted(x, 0.08)
    scattering = torch.cat([x.d - turned.d, obs.s[..., 3:]], -1)
    loose = with_facing(none, replace(obs, s=scattering), turned, shared, shine, 1e-6, mask)
    ratio = exact.facing_weight[flat] / loose.facing_weight[flat]
    assert float(ratio.amax()) < 0.08 / 1.18 / 0.03 * 1.01
    assert float(ratio.median()) > 1.1
    unseen = with_facing(none, free, x, shared, 0 * shine, 1e-6, mask)
    assert bool((unseen.facing_weight[flat] < loose.facing_weight[flat]).all())
    noisy = with_facing(none, free, x, shared, shine, 0.2 * float(x.d.mean()), mask)
    assert bool((noisy.facing_weight <= exact.facing_weight).all())
    dark = with_facing(none, free, replace(x, d=-x.d), shared, shine, 1e-6, mask)
    assert float(dark.facing_weight.abs().max()) == 0.0
    # Along the direction the row is nothing, across it the weight times what is across.
    rows = lambda at: pixel_residual(at.pack(), shared, free, exact)[:, -3:]  # noqa: E731
    assert float(rows(x).abs().max()) < 1e-9
    v = normalised_lobe(x, shared)
    expected = exact.facing_weight * v.norm(dim=-1) * math.sin(0.08)
    torch.testing.assert_close(rows(tilted(x, 0.08)).norm(dim=-1)[flat], expected[flat])


def test_the_shapes_spread_is_measured_on_seen_lobes(small_case):
    obs, _, local, shared = at_truth(small_case)
    g = torch.Generator().manual_seed(0)
    scattered = local.clone()
    scattered[:, 3] += 0.06 * torch.randn(len(local), generator=g, dtype=torch.float64)
    shine = lobe_pictures(obs, local, shared)
    assert shape_spread(obs, scattered, shared, shine, 1e-3) == pytest.approx(0.06, rel=0.15)
    assert shape_spread(obs, local, shared, shine, 1e-3) == pytest.approx(0.02)
    assert shape_spread(obs, scattered, shared, 0 * shine, 1e-3) == pytest.approx(0.1)


def test_lobe_pictures_are_the_specular_component(small_case):
    obs, mask, local, shared = at_truth(small_case)
    expected = small_case.specular[:, 0][:, mask].T
    torch.testing.assert_close(lobe_pictures(obs, local, shared), expected, rtol=1e-4, atol=1e-6)


EFFORT = Effort(minima=2)


def noisy_fit(case, robust=5.0):
    obs, mask, local, shared = at_truth(case)
    obs = replace(obs, weight=weights(obs, FitOptions(), 1e-3))
    priors = replace(no_priors(len(obs), obs.images), shape=10.0)
    return obs, priors, mask, local, shared, fit_locals(obs, priors, shared, EFFORT, robust)


def test_given_the_globals_the_pixels_that_see_the_lobe_are_recovered(small_case):
    _, _, mask, local, _, found = noisy_fit(small_case)
    sees = small_case.sees_lobe(0.003)[mask]
    right = ((found.local - local).abs() < 0.01 * local.abs().amax(1, keepdim=True)).all(1)
    assert float(right[sees].double().mean()) > 0.98
    assert float(found.converged.double().mean()) > 0.99
    assert (found.runner_up >= found.cost).all()


def test_handing_lobes_on_never_raises_a_cost_and_mends_wrong_pixels(small_case):
    obs, priors, mask, local, shared, found = noisy_fit(small_case)
    broken = found.local.clone()
    broken[::7, :3] *= 0.3
    problem = build_problem(obs, priors, robust=5.0)
    cost = problem.costs(broken, shared)
    state = LocalFit(broken, cost, torch.full_like(cost, torch.inf), torch.zeros_like(found.converged))
    mended = hand_on_lobes(obs, priors, state, shared, mask, EFFORT, 5.0, radius=1)
    assert (mended.cost <= cost).all()
    torch.testing.assert_close(mended.cost, problem.costs(mended.local, shared))
    right = ((mended.local - local).abs() < 0.01 * local.abs().amax(1, keepdim=True)).all(1)
    assert float(right[::7].double().mean()) > 0.9


def test_merging_a_few_pixels_at_a_time_is_merging_all(monkeypatch):
    g = torch.Generator().manual_seed(3)
    rand = lambda *n: torch.rand(*n, generator=g, dtype=torch.float64)  # noqa: E731
    first = merge(None, torch.arange(50), rand(50, 3), rand(50), rand(50) > 0.5, 50)
    which = torch.randperm(50, generator=g)[:37]
    more = which, rand(37, 3), rand(37), rand(37) > 0.5, 50
    before = first.local.clone()
    whole = merge(first, *more)
    assert torch.equal(first.local, before)
    monkeypatch.setattr(chunks, "AT_ONCE", 5)
    parts = merge(first, *more)
    for name in ("local", "cost", "runner_up", "converged"):
        assert torch.equal(getattr(parts, name), getattr(whole, name)), name


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=40), st.floats(0, 1))
def test_a_quantile_is_torchs_own_bit_for_bit(values, share):
    values = torch.tensor(values, dtype=torch.float64)
    assert quantile(values, share) == float(values.quantile(share))


def test_a_quantile_among_the_finite_ones_takes_no_notice_of_the_infinite():
    assert quantile(double([torch.inf, 1.0, 3.0, 2.0, torch.inf]), 0.5) == 3.0
    assert quantile(double([torch.inf, 1.0]), 1.0) == torch.inf


def test_merging_keeps_the_better_and_remembers_the_other():
    row = lambda *x: double([[v, v] for v in x])  # noqa: E731
    yes = torch.ones(3, dtype=torch.bool)
    first = merge(None, torch.arange(3), row(1.0, 2.0, 3.0), double([5.0, 5.0, 5.0]), yes, 3)
    second = merge(first, torch.tensor([0, 2]), row(9.0, 8.0), double([7.0, 1.0]), ~yes[:2], 3)
    assert torch.equal(second.local, row(1.0, 2.0, 8.0))
    assert torch.equal(second.cost, double([5.0, 5.0, 1.0]))
    assert torch.equal(second.runner_up, double([7.0, torch.inf, 5.0]))
    assert second.converged.tolist() == [True, True, False]
    # A solution that is the same one again is no rival, and one that is no number loses.
    again = merge(first, torch.tensor([0, 1]), row(1.001, 7.0), double([5.1, torch.nan]), yes[:2], 3)
    assert torch.equal(again.runner_up, double([torch.inf] * 3))
    assert torch.equal(again.cost, first.cost)
