"""The solver that is compiled: its system and its steps against those of the plain one."""

from __future__ import annotations

import shutil
from dataclasses import replace

import pytest
import torch

from reflectsep.fit.blocks import build_problem
from reflectsep.fit.elimination import damped_step
from reflectsep.fit.fused import layout_of, one_iteration, solve_fused
from reflectsep.fit.lines import (
    form_of,
    linearised,
    pack_constants,
    pack_data,
    pack_system,
    read_constants,
    read_data,
    read_place,
    read_system,
)
from reflectsep.fit.normal import normal_equations
from reflectsep.fit.problem import SHARED_NAMES, Observations, Priors
from reflectsep.kernel.compiling import Speed
from reflectsep.kernel.step import ACTIVE, CONVERGED, MOST_DAMPING
from reflectsep.solve.local import Termination, solve_damped, solve_local

from .test_derivatives import CASES, PIXELS, random_case

PLAIN = Speed(compile="never", cores=1)
BRIEF = Termination(tolerance=1e-10, max_iterations=12)


def system_of(obs, priors, local, shared, robust):
    form = form_of(obs, shared)
    constants = read_constants(pack_constants(obs, priors, shared, robust), form)
    data = read_data(pack_data(obs, priors, shared), form)
    at = read_place(local.T.contiguous(), data, form)
    cost, system = linearised(at, data, constants, form)
    packed = pack_system(system, form)
    assert len(packed) == form.system
    return cost, read_system(packed, form), at, constants.shape


@pytest.mark.parametrize("case", CASES, ids=str)
@pytest.mark.parametrize("softness", [0.0, 0.4])
@pytest.mark.parametrize("ggx", [0.0, 1.0])
@pytest.mark.parametrize("robust", [None, 0.5])
def test_its_steps_are_those_of_the_whole_matrix(case, softness, ggx, robust):
    obs, priors, local, shared = random_case(**case)
    shared[SHARED_NAMES.index("softness")] = softness
    shared[SHARED_NAMES.index("ggx")] = ggx
    cost, system, at, weight = system_of(obs, priors, local, shared, robust)
    whole_cost, gradient, V = normal_equations(local, shared, obs, priors, robust)
    torch.testing.assert_close(cost, whole_cost, rtol=1e-12, atol=1e-12)
    for damping in (1e-6, 1e-2, 1e3):
        mu = torch.full((PIXELS,), damping, dtype=torch.float64)
        step, promised = damped_step(system, at, mu, weight)
        expected, predicted = solve_damped(V, gradient, mu)
        torch.testing.assert_close(step.rows(), expected, rtol=1e-7, atol=1e-9)
        torch.testing.assert_close(promised, predicted, rtol=1e-7, atol=1e-9)


def test_an_unknown_that_nothing_feels_stays():
    obs, priors, local, shared = random_case(channels=3, s_unknown=True)
    weight = obs.weight.clone()
    weight[3] = 0.0
    silent = priors.ratio_weight.clone()
    silent[3] = 0.0
    off = replace(priors, shape=0.0, parallel=silent, ratio_weight=silent, lobe_weight=silent, facing_weight=silent)
    off = replace(off, s_weight=silent)
    _, system, at, w = system_of(replace(obs, weight=weight), off, local, shared, None)
    step, promised = damped_step(system, at, torch.full((PIXELS,), 1e-4, dtype=torch.float64), w)
    assert step.rows().isfinite().all()
    assert not step.rows()[:, 3].any()
    assert step.rows()[:, 4].any()
    assert float(promised[3]) == 0.0


@pytest.fixture(scope="module")
def well_posed():
    """Starts near the minimum of pictures that the model can make, and the plain solver's ends."""
    torch.manual_seed(2)
    obs, priors, local, shared = random_case(channels=3, s_unknown=True)
    shared[SHARED_NAMES.index("ggx")] = 0.0
    start = local + 0.02 * torch.randn_like(local)
    problem = build_problem(obs, priors, robust=2.0)
    return obs, priors, start, shared, solve_local(problem, start, shared, BRIEF)


def some(obs: Observations, priors: Priors, start, index):
    return obs.take(index), priors.take(index), start[index]


def test_it_ends_where_the_plain_solver_ends(well_posed):
    obs, priors, start, shared, plain = well_posed
    found = solve_fused(start, shared, obs, priors, 2.0, BRIEF, PLAIN)
    torch.testing.assert_close(found.cost, plain.cost, rtol=1e-6, atol=0.0)
    assert torch.equal(found.converged, plain.converged)
    assert found.iterations == plain.iterations


def test_a_pixel_depends_neither_on_its_neighbours_nor_on_their_number_bit_for_bit(well_posed):
    obs, priors, start, shared, _ = well_posed
    whole = solve_fused(start, shared, obs, priors, 2.0, BRIEF, PLAIN)
    index = torch.tensor([31, 4, 17])
    few_obs, few_priors, few_start = some(obs, priors, start, index)
    few = solve_fused(few_start, shared, few_obs, few_priors, 2.0, BRIEF, PLAIN)
    assert torch.equal(few.local, whole.local[index])
    assert torch.equal(few.cost, whole.cost[index])


def test_a_pixel_without_a_finite_cost_stays_and_says_so(well_posed):
    obs, priors, start, shared, _ = well_posed
    images = obs.images.clone()
    images[5, 1, 2] = torch.nan
    found = solve_fused(start, shared, replace(obs, images=images), priors, 2.0, BRIEF, PLAIN)
    assert torch.equal(found.local[5], start[5])
    assert float(found.cost[5]) == torch.inf
    assert not found.converged[5]
    assert int((~found.cost.isfinite()).sum()) == 1


def test_out_of_iterations_is_not_converged(well_posed):
    obs, priors, start, shared, plain = well_posed
    found = solve_fused(start, shared, obs, priors, 2.0, replace(BRIEF, max_iterations=1), PLAIN)
    assert not found.converged.any()
    assert found.iterations == 1
    assert (found.cost >= plain.cost * (1.0 - 1e-9)).all()


@pytest.fixture
def under_way(well_posed):
    """Slots after their first iteration, and what takes them one further, to a tolerance of nothing."""
    obs, priors, start, shared, _ = well_posed
    form = form_of(obs, shared)
    layout = layout_of(form)
    packed = torch.cat([pack_constants(obs, priors, shared, 2.0), shared.new_tensor([0.0, 0.0, 50.0])])
    state = shared.new_zeros(layout.rows, PIXELS)
    state[layout.place], state[layout.cost], state[layout.damping] = start.T, torch.inf, 1.0
    state[layout.status] = ACTIVE
    maps = pack_data(obs, priors, shared)
    further = lambda state: one_iteration(state, maps, packed, form)  # noqa: E731
    return layout, further(state), further


def test_a_finished_pixel_stays_while_the_others_go_on(under_way):
    layout, state, further = under_way
    unhindered = further(state)
    pixel = int((unhindered[layout.place] != state[layout.place]).any(0).nonzero()[0])
    state[layout.status, pixel] = CONVERGED
    after = further(state)
    known = torch.arange(layout.rows) != layout.damping
    assert torch.equal(after[known, pixel], state[known, pixel])
    others = torch.arange(PIXELS) != pixel
    assert torch.equal(after[:, others], unhindered[:, others])


def test_where_no_step_is_short_enough_there_is_an_end(under_way):
    layout, state, further = under_way
    state[layout.cost, 4] = 0.0  # as if nothing were lower
    state[layout.damping, 4] = MOST_DAMPING
    after = further(state)
    assert after[layout.status, 4] == CONVERGED
    assert (after[layout.status] == ACTIVE).sum() == PIXELS - 1


def test_the_problem_goes_to_it_where_it_is_wanted(well_posed, monkeypatch):
    obs, priors, start, shared, plain = well_posed
    problem = build_problem(replace(obs, fused=PLAIN), priors, robust=2.0)
    ours = solve_fused(start, shared, obs, priors, 2.0, BRIEF, PLAIN)
    assert torch.equal(solve_local(problem, start, shared, BRIEF).local, ours.local)
    assert not torch.equal(ours.local, plain.local)  # by rounding alone, but it tells which of them was at work


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
def test_compiled_it_is_the_same_and_as_independent(well_posed):
    obs, priors, start, shared, plain = well_posed
    speed = Speed(compile="always", cores=1)
    found = solve_fused(start, shared, obs, priors, 2.0, BRIEF, speed)
    torch.testing.assert_close(found.cost, plain.cost, rtol=1e-6, atol=0.0)
    assert torch.equal(found.converged, plain.converged)
    index = torch.arange(700) % PIXELS
    more_obs, more_priors, more_start = some(obs, priors, start, index)
    more = solve_fused(more_start, shared, more_obs, more_priors, 2.0, BRIEF, speed)
    assert torch.equal(more.local, found.local[index])
