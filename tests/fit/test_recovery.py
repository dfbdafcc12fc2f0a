"""Known truth recovered, at stated rates, without a hint of it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from reflectsep.fit.blocks import build_problem
from reflectsep.fit.options import FitOptions
from reflectsep.fit.problem import LOG_C_2, LOG_N_S, Locals
from reflectsep.fit.reflectance import fit_reflectance, observe, prepare, refine, rescored, start
from reflectsep.fit.solution import LocalFit
from reflectsep.progress import silent

pytestmark = pytest.mark.slow

EXACT = FitOptions(scattering_sd=0.0)
"""The scattering of these cases is the truth's own, so it is held."""


@pytest.mark.parametrize("lights", [6, 12])
def test_clean_pictures_give_the_truth_back(paper_case, lights):
    case = paper_case(size=64, lights=lights)
    fit = fit_reflectance(case.stack, case.scattering, EXACT)
    sees = case.sees_lobe(0.003)
    D, truth = fit.d.clamp_min(0) ** fit.n_d, case.truth.d.clamp_min(0) ** case.truth.n_d
    u = fit.a[:, None, None, None] + fit.B * fit.d
    specular = u.clamp_min(0) ** fit.n_s
    assert fit.crest == 0
    for found, expected in ((D, truth), (specular, case.specular[:3])):
        right = ((found - expected).abs() <= 0.01 * expected.amax(0)).all(0)[0]
        assert float(right[sees].float().mean()) >= 0.99
    assert float((fit.a / case.truth.a - 1).abs().max()) < 0.05
    assert float(fit.n_s) == pytest.approx(case.truth.n_s, rel=0.05)


def test_the_cost_is_no_higher_than_from_a_start_at_the_truth(paper_case):
    case = paper_case(size=32)
    obs, mask, _ = observe(case.stack, case.scattering, EXACT, torch.float64)
    begun = start(prepare(obs, mask, EXACT), EXACT, silent)
    found = refine(begun, EXACT, silent)
    shared = begun.shared.clone()
    shared[:3], shared[LOG_N_S] = case.truth.a, torch.tensor(case.truth.n_s).log()
    shared[LOG_C_2] = torch.tensor(2 * 0.91 * 1.015).log()
    local = Locals(case.truth.d[..., mask].permute(2, 1, 0), case.truth.B[0][mask].log(), None).pack()
    at_truth = LocalFit(local, begun.found.cost, begun.found.runner_up, begun.found.converged)
    from_truth = refine(rescored(replace(begun, shared=shared, found=at_truth)), EXACT, silent)
    # Priors are remade on the way: both ends are scored by the same problem.
    problem = build_problem(found.obs, found.priors, robust=found.robust)
    cost = lambda state: float(problem.costs(state.found.local, state.shared).sum())  # noqa: E731
    assert cost(found) <= cost(from_truth) * 1.02 + 1e-3


@pytest.mark.parametrize(("sigma", "least_dB"), [(0.002, 42.0), (0.01, 32.0)])
def test_noisy_pictures_relight(paper_case, sigma, least_dB):
    case = paper_case(size=64, sigma=sigma)
    ours = case.psnr(fit_reflectance(case.stack, case.scattering, EXACT))
    without = case.psnr(fit_reflectance(case.stack, case.scattering, replace(EXACT, scattering="none")))
    assert ours >= without
    assert ours >= least_dB
