"""What a finished fit says of itself."""

import math
from dataclasses import replace

import pytest
import torch

from reflectsep.fit.options import FitOptions
from reflectsep.fit.outcome import carried_covariance, deviation, names_of
from reflectsep.fit.problem import ALPHA, SHARED_NAMES
from reflectsep.fit.reflectance import fit_reflectance
from reflectsep.report.advice import GENERAL, what_to_do


def test_deviations_are_those_of_the_whole_covariance(random_problem):
    problem, local, shared = random_problem(channels=3, pixels=4)
    root = 0.05 * torch.randn(ALPHA, ALPHA, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    covariance = root @ root.mT
    V, _, W, _, _ = problem.coupled(local, shared)
    V = torch.tril(V.movedim(-1, 0)) + torch.tril(V.movedim(-1, 0), -1).mT
    pull = torch.linalg.solve(V, W.movedim(-1, 0))
    expected = (torch.linalg.inv(V) + pull @ covariance @ pull.mT).diagonal(dim1=1, dim2=2).sqrt().mT
    torch.testing.assert_close(deviation(problem, local, shared, covariance), expected, rtol=1e-3, atol=1e-9)
    firm = deviation(problem, local, shared, 0.0 * covariance)
    assert (firm <= expected).all()


def test_names_of_globals_are_of_lights_where_alphas_are_refined(model_case):
    stack = model_case(size=8).stack
    assert names_of(stack, torch.zeros(ALPHA), 1) == SHARED_NAMES
    names = names_of(stack, torch.zeros(ALPHA + 12), 1)
    assert names[ALPHA] == f"alpha_{stack.names[3]}_{stack.names[0]}"
    assert len(set(names)) == ALPHA + 12


def test_a_covariance_is_carried_by_name(model_case):
    case = model_case(size=8)
    fit = fit_reflectance(case.stack, case.scattering, FitOptions(max_iterations=3))
    assert fit.learnt is not None
    carried = carried_covariance(fit.learnt, SHARED_NAMES, torch.zeros(ALPHA, dtype=torch.float64))
    index = [SHARED_NAMES.index(name) for name in fit.global_names]
    torch.testing.assert_close(carried[index][:, index], fit.covariance)
    rest = [i for i in range(ALPHA) if i not in index]
    assert float(carried[rest].abs().max()) == 0.0
    swapped = replace(fit.learnt, order=fit.learnt.order[::-1])
    turned = carried_covariance(swapped, SHARED_NAMES, torch.zeros(ALPHA, dtype=torch.float64))
    torch.testing.assert_close(turned[index][:, index], fit.covariance.flip(0, 1))


def test_pictures_without_a_highlight_are_warned_of_with_advice(model_case):
    case = model_case(size=10, n_s=25.0)
    dull = replace(case.stack, images=case.stack.images - case.specular[:, None].float())
    fit = fit_reflectance(dull, case.scattering)
    # Either hardly any pixel shows a highlight, or what is left of one is too broad to be told from the body.
    kinds = ("show the highlight in two or more pictures", "the pictures show no lobe that all pixels share")
    said = [text for text in fit.warnings if any(kind in text for kind in kinds)]
    assert len(said) == 1
    assert what_to_do(said[0]) != GENERAL
    assert math.isfinite(fit.cost)


def test_refined_alphas_have_a_deviation_where_they_are_free(model_case):
    case = model_case(size=10)
    fit = fit_reflectance(case.stack, case.scattering, FitOptions(alpha_sd=0.02, max_iterations=6))
    assert fit.alpha is not None
    assert fit.alpha_sd is not None
    torch.testing.assert_close(fit.alpha[:3], torch.eye(3))
    assert float(fit.alpha_sd[:3].max()) == 0.0
    assert (fit.alpha_sd[3:] > 0).all()
    assert (fit.alpha_sd[3:] <= 0.02 * (1 + 1e-6)).all()
    # The stated ones were right: what is found lies within a few deviations.
    off = (fit.alpha - case.stack.alpha)[3:].abs() / fit.alpha_sd[3:]
    assert float(off.median()) < 3


@pytest.mark.parametrize("known", [True, False])
def test_intensities_are_those_of_the_lights(model_case, known):
    case = model_case(size=8)
    scale = torch.tensor([1.0, 2.0, 0.5, 1.0, 3.0, 1.0, 0.8])
    stack = replace(
        case.stack,
        images=case.stack.images * scale[:, None, None, None],
        light_vectors=case.stack.light_vectors * scale[:, None] if known else None,
    )
    fit = fit_reflectance(stack, None, FitOptions(scattering="none", max_iterations=2))
    torch.testing.assert_close(fit.intensity, scale if known else torch.ones(7))
