from __future__ import annotations

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from reflectsep.fit.body import robust_body
from reflectsep.fit.options import FitOptions
from reflectsep.fit.problem import LOG_C_2, LOG_N_S, SOFTNESS
from reflectsep.fit.reflectance import observe, prepare
from reflectsep.fit.search import basis_roots, colour_roots, globals_grid, informative_pixels, scan
from reflectsep.model import Globals, diffuse, lobe

number = lambda low, high: st.floats(low, high, allow_nan=False)  # noqa: E731


def double(x):
    return torch.tensor(x, dtype=torch.float64)


@settings(max_examples=300)
@example(target=0.01, s=0.0, B=12.0, a=-0.6, n_s=3.0, n_d=1.5, width=0.0, crest=0.9)
@given(
    target=number(0.01, 1.5),
    s=number(0, 0.4),
    B=number(0.3, 12),
    a=number(-1.3, -0.6),
    n_s=number(3, 60),
    n_d=st.sampled_from([1.0, 0.7, 1.5]),
    width=st.sampled_from([0.0, 0.05]),
    crest=st.sampled_from([0.0, 0.9]),
)
def test_basis_roots_solve_their_equation(target, s, B, a, n_s, n_d, width, crest):
    shared = Globals(a=double([a] * 3), n_s=double(n_s), n_d=n_d, softness=double(0.0), crest=double(crest))
    images, edge = double([target] * 3), double([width])
    d = basis_roots(images, double([s] * 3), double([B]), shared, edge, iterations=60)
    shine = lobe((shared.a + B * d).clamp_min(0), shared.n_s, shared.crest)
    torch.testing.assert_close(diffuse(d + s, edge, n_d) + shine, images, rtol=1e-6, atol=1e-7)


@pytest.fixture(scope="module")
def ready(small_case):
    """The noise-free case up to the start of the search, and the true shared parameters."""
    case = small_case
    obs, mask, _ = observe(case.stack, case.scattering, FitOptions(scattering_sd=0.0), torch.float64)
    state = prepare(obs, mask, FitOptions(scattering_sd=0.0))
    shared = state.shared.clone()
    shared[:3] = case.truth.a
    shared[LOG_N_S] = torch.log(double(case.truth.n_s))
    shared[LOG_C_2] = torch.log(double(2 * 0.91 * 1.015))
    assert float(shared[SOFTNESS]) == 0.0
    return state, shared


def test_the_scan_finds_the_lobe_of_clean_pictures(ready, small_case):
    state, shared = ready
    values = 32
    candidates = scan(state.obs, state.priors, shared, keep=4, values=values)
    assert candidates.d.shape == (len(state.obs), 4, 1, 3)
    truth = small_case.truth.B[0][small_case.stack.mask].log()
    sees = small_case.sees_lobe(0.01)[small_case.stack.mask]
    off = (candidates.log_B - truth[:, None]).abs().masked_fill(~candidates.cost.isfinite(), torch.inf)
    step = 2.8 / (values - 1)
    assert float((off.amin(1) < step)[sees].double().mean()) > 0.97
    assert float((off[:, 0] < step)[sees].double().mean()) > 0.9


def test_candidates_come_cheapest_first_and_reproduce_the_basis_pictures(ready):
    state, shared = ready
    candidates = scan(state.obs, state.priors, shared, keep=3)
    cost = candidates.cost
    assert ((cost[:, 1:] >= cost[:, :-1]) | cost[:, 1:].isinf()).all()
    assert cost[:, 0].isfinite().all()
    d, B = candidates.d[:, 0, 0], candidates.log_B[:, 0].exp()
    u = (shared[:3] + B[:, None] * d).clamp_min(0)
    picture = (d + state.obs.s_basis[:, 0]).clamp_min(0) + u ** shared[LOG_N_S].exp()
    lit = state.obs.images[:, 0, :3] > 0.01
    assert float((picture - state.obs.images[:, 0, :3])[lit].abs().max()) < 1e-4


def test_a_pixels_scan_does_not_depend_on_the_others(ready):
    state, shared = ready
    index = torch.tensor([100, 3, 77])
    whole = scan(state.obs, state.priors, shared, keep=2)
    part = scan(state.obs.take(index), state.priors.take(index), shared, keep=2)
    assert torch.equal(part.log_B, whole.log_B[index])
    assert torch.equal(part.d, whole.d[index])


def test_the_grid_puts_the_true_globals_near_the_top(ready, small_case):
    state, _ = ready
    index = torch.arange(0, len(state.obs), 4)
    obs, priors = state.obs.take(index), state.priors.take(index)
    starts = globals_grid(obs, priors, state.shared, trim=0.8, best=3)
    assert len(starts) == 3
    n_s = [float(start[LOG_N_S].exp()) for start in starts]
    assert min(abs(x / small_case.truth.n_s - 1) for x in n_s) < 0.45
    for start in starts:
        assert (start[:3] < 0).all()
        torch.testing.assert_close(start[LOG_C_2].exp(), -2 * (start[:3] / obs.cosine).mean())


def test_telling_pixels_are_those_with_highlights(ready, small_case):
    state, _ = ready
    body = robust_body(state.obs.images, torch.full_like(state.obs.images, 1 / state.sigma), state.obs.alpha, 1.0)
    chosen = informative_pixels(state.obs, body, 40)
    assert len(chosen) == 40
    assert len(chosen.unique()) == 40
    shine = small_case.specular[:, 0][:, small_case.stack.mask].amax(0)
    assert float(shine[chosen].min()) > float(shine.quantile(0.2))
    assert len(informative_pixels(state.obs, body, 10**6)) == len(state.obs)


def test_colour_roots_leave_the_lobe_out(paper_case):
    case = paper_case(size=12, channels=3)
    obs, _, _ = observe(case.stack, case.scattering, FitOptions(), torch.float64)
    truth, mask = case.truth, case.stack.mask
    # What drives the lobe is B times d, in every channel the same.
    d, B = truth.d[..., mask].permute(2, 1, 0), truth.B[..., mask].T
    mean = d.mean(1)
    B_grey = (B[:, :1] * d[:, 0] / mean)[:, :1]
    shared = Globals(a=truth.a, n_s=double(truth.n_s), n_d=1.0, softness=double(0.0), crest=double(0.0))
    found = colour_roots(obs, mean[:, None], B_grey, shared)
    assert found.shape == (len(obs), 1, 3, 3)
    lit = (d > 0).all(-1).all(-1)
    torch.testing.assert_close(found[lit, 0], d[lit], rtol=1e-4, atol=1e-5)
