from __future__ import annotations

import shutil

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from reflectsep.kernel import local as kernel_local
from reflectsep.kernel.compiling import Speed
from reflectsep.kernel.local import solve_pixels
from reflectsep.kernel.problem import Bounds, pack_constants, quadratic, read_constants, read_data
from reflectsep.kernel.step import CONVERGED, EXHAUSTED, FAILED, Stop
from reflectsep.model import positive_power
from reflectsep.solve.local import Termination, solve_local
from reflectsep.solve.problem import BlockProblem, normal_equations

TIGHT = Stop(tolerance=1e-14, floor=1e-26, max_iterations=100)


def reference(scene):
    """The same problem as residuals for the generic solver, differentiated by torch; l is (pixels, 4)."""
    p, lobe = scene.problem, scene.lobe

    def residual(local, shared, images, s, weight, centre, prior):
        d, B = local[..., :3], local[..., 3].exp()
        roots = d @ p.alpha.mT + (s if s.shape[-1] == len(p.alpha) else s @ p.alpha.mT)
        u = (shared[:3] + B[..., None] * d) @ p.alpha.mT
        model = positive_power(roots, lobe.n_d) + positive_power(u, shared[3])
        r = (model - images) * weight * p.light_weight.sqrt()
        return torch.cat([r, prior.sqrt() * (local - centre)], -1)

    ones, zeros = torch.ones_like(p.images), torch.zeros_like(p.images[:4])
    weight = ones if p.weight is None else p.weight
    centre, prior = (zeros, zeros) if p.prior is None else (p.prior.centre, p.prior.weight)
    return BlockProblem(residual=residual, data=tuple(m.T for m in (p.images, p.s, weight, centre, prior)))


FORMS = [{}, {"extras": True}, {"n_d": 0.8}, {"lights": 9, "n_d": 1.3, "extras": True}]


@pytest.mark.parametrize("form", FORMS)
def test_cost_gradient_and_matrix_are_those_of_automatic_differentiation(scene, form):
    made = scene(50, sigma=0.01, **form)
    p, static = made.problem, made.problem.form(made.lobe.n_d)
    maps = torch.cat(p.maps).unbind(0)
    constants = read_constants(pack_constants(p, made.lobe), static)
    found = quadratic(made.start.unbind(0), read_data(maps, static), constants, static)
    block = reference(made)
    r, J = block.linearise_local(made.start.T, made.lobe.shared)
    V, g = normal_equations(r, J, torch.ones_like(r))
    torch.testing.assert_close(found.cost, 0.5 * r.square().sum(-1))
    torch.testing.assert_close(torch.stack(found.gradient, -1), g)
    upper = torch.stack([V[:, i, j] for i in range(4) for j in range(i, 4)], -1)
    torch.testing.assert_close(torch.stack(found.V, -1), upper)


@pytest.mark.parametrize("form", FORMS)
def test_it_ends_where_the_generic_solver_ends(scene, form):
    made = scene(300, sigma=0.002, **form)
    fast = solve_pixels(made.problem, made.truth, made.lobe, TIGHT)
    slow = solve_local(
        reference(made), made.truth.T, made.lobe.shared, Termination(tolerance=1e-14, floor=1e-26, max_iterations=100)
    )
    both = slow.converged & (fast.status == CONVERGED)
    assert float(both.double().mean()) > 0.9
    # From the truth both walk down the same valley; where its floor is flat, costs agree before places do.
    same = (fast.cost - slow.cost).abs() <= 1e-6 * slow.cost + 1e-12
    assert float(same[both].double().mean()) > 0.99


def test_without_noise_the_truth_is_found(scene):
    made = scene(500)
    found = solve_pixels(made.problem, made.truth * 1.001, made.lobe, TIGHT)
    seen = found.status == CONVERGED
    assert float(seen.double().mean()) > 0.95
    assert float((found.cost[seen] < 1e-12).double().mean()) > 0.99


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 1000), st.sampled_from([64, 100, 512]))
def test_a_pixel_depends_neither_on_neighbours_nor_on_the_block_bit_for_bit(seed, block):
    from tests.kernel.conftest import make_scene

    made = make_scene(700, sigma=0.01)
    whole = solve_pixels(made.problem, made.start, made.lobe)
    order = torch.randperm(700, generator=torch.Generator().manual_seed(seed))[: 100 + seed % 600]
    part = solve_pixels(made.problem.take(order), made.start[:, order], made.lobe, block=block)
    assert torch.equal(part.local, whole.local[:, order])
    assert torch.equal(part.cost, whole.cost[order])
    assert torch.equal(part.status, whole.status[order])


def test_leftovers_move_to_a_smaller_block_unchanged(scene, monkeypatch):
    made = scene(900, sigma=0.01)
    whole = solve_pixels(made.problem, made.start, made.lobe)
    monkeypatch.setattr(kernel_local, "SMALL_BLOCK", 128)
    again = solve_pixels(made.problem, made.start, made.lobe, block=512)
    assert torch.equal(again.local, whole.local)


def test_single_precision_stops_and_reaches_the_same_cost(scene):
    made = scene(2000, sigma=0.005)
    single = scene(2000, sigma=0.005, dtype=torch.float32)
    exact = solve_pixels(made.problem, made.truth, made.lobe)
    found = solve_pixels(single.problem, single.truth, single.lobe)
    assert float((found.status == CONVERGED).double().mean()) > 0.95
    close = (found.cost.double() - exact.cost).abs() <= 1e-3 * exact.cost + 1e-9
    assert float(close.double().mean()) > 0.98


def test_bounds_hold_and_the_rest_goes_to_its_minimum(scene):
    from dataclasses import replace

    made = scene(400, sigma=0.01)
    low, high = (0.45, -float("inf"), 0.05, 0.5), (float("inf"), 0.4, float("inf"), 1.5)
    problem = replace(made.problem, bounds=Bounds(lower=low, upper=high))
    lower, upper = (torch.tensor(ends, dtype=torch.float64)[:, None] for ends in (low, high))
    start = made.truth.clamp(lower, upper)
    found = solve_pixels(problem, start, made.lobe, TIGHT)
    for k in range(4):
        assert float(found.local[k].min()) >= low[k]
        assert float(found.local[k].max()) <= high[k]
    held = (found.local[0] == low[0]).double().mean()
    assert 0.05 < float(held) < 0.95
    # First-order optimality: the gradient vanishes, or presses against a bound.
    block = reference(made)
    r, J = block.linearise_local(found.local.T, made.lobe.shared)
    gradient = normal_equations(r, J, torch.ones_like(r))[1].T
    pressed = ((found.local <= lower) & (gradient > 0)) | ((found.local >= upper) & (gradient < 0))
    free = torch.where(pressed, 0.0, gradient).abs().amax(0)[found.status == CONVERGED]
    assert float(free.quantile(0.95)) < 1e-5


def test_a_pixel_with_a_hole_in_it_fails_alone(scene):
    made = scene(100, sigma=0.01)
    made.problem.images[4, 17] = float("nan")
    found = solve_pixels(made.problem, made.start, made.lobe)
    assert int(found.status[17]) == FAILED
    assert torch.equal(found.local[:, 17], made.start[:, 17])
    assert float(found.cost[17]) == float("inf")
    assert int((found.status == FAILED).sum()) == 1


def test_out_of_iterations_says_so(scene):
    made = scene(100, sigma=0.01)
    found = solve_pixels(made.problem, made.start, made.lobe, Stop(max_iterations=2))
    assert int((found.status == EXHAUSTED).sum()) > 50
    assert found.iterations <= 200


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
def test_compiled_is_the_same_algorithm_and_as_independent_of_neighbours(scene):
    made = scene(3000, sigma=0.005)
    eager = solve_pixels(made.problem, made.start, made.lobe, speed=Speed(compile="never"))
    fused = solve_pixels(made.problem, made.start, made.lobe, speed=Speed(compile="always"))
    close = (fused.cost - eager.cost).abs() <= 1e-6 * eager.cost
    assert float(close.double().mean()) > 0.999
    order = torch.randperm(3000, generator=torch.Generator().manual_seed(3))
    mixed = solve_pixels(made.problem.take(order), made.start[:, order], made.lobe, speed=Speed(compile="always"))
    assert torch.equal(mixed.local, fused.local[:, order])


def test_cores_make_no_difference(scene, monkeypatch):
    from reflectsep.kernel import compiling

    monkeypatch.setattr(compiling, "LEAST_PART", 128)
    made = scene(900, sigma=0.01)
    one = solve_pixels(made.problem, made.start, made.lobe, speed=Speed(cores=1))
    three = solve_pixels(made.problem, made.start, made.lobe, speed=Speed(cores=3))
    assert len(Speed(cores=3).parts(900)) == 3
    assert torch.equal(one.local, three.local)
    assert one.iterations == three.iterations
