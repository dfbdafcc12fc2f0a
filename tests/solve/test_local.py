from __future__ import annotations

from itertools import pairwise

import pytest
import torch

from reflectsep.solve.local import LANES, Termination, relaxed, solve_damped, solve_local, solve_positive
from reflectsep.solve.problem import BlockProblem, normal_equations


def decay(local, shared, x, y):
    """p0 exp(-p1 x) + g - y."""
    return local[..., :1] * torch.exp(-local[..., 1:2] * x) + shared[0] - y


def decays(blocks=60, dtype=torch.float64, threshold=None):
    g = torch.Generator().manual_seed(1)
    truth = torch.rand(blocks, 2, generator=g, dtype=dtype) * 2 + 0.5
    shared = torch.tensor([0.3], dtype=dtype)
    x = torch.linspace(0, 3, 9, dtype=dtype).expand(blocks, 9).contiguous()
    y = decay(truth, shared, x, torch.zeros_like(x))
    start = torch.ones(blocks, 2, dtype=dtype)
    return BlockProblem(residual=decay, data=(x, y), threshold=threshold), start, shared, truth


@pytest.mark.parametrize(("dtype", "close"), [(torch.float64, 1e-6), (torch.float32, 1e-3)])
def test_exponentials_are_recovered(dtype, close):
    problem, start, shared, truth = decays(dtype=dtype)
    found = solve_local(problem, start, shared)
    assert found.converged.all()
    assert float((found.local - truth).abs().max()) < close
    torch.testing.assert_close(found.cost, problem.costs(found.local, shared))


def test_out_of_iterations_is_not_called_converged():
    problem, start, shared, truth = decays()
    start[:10] = truth[:10]
    found = solve_local(problem, start, shared, Termination(max_iterations=1))
    assert found.iterations == 1
    assert found.converged[:10].all()
    assert not found.converged[10:].any()


def test_the_start_is_left_alone_and_the_cost_never_rises():
    problem, start, shared, _ = decays()
    kept = start.clone()
    costs = [problem.costs(start, shared)]
    costs += [solve_local(problem, start, shared, Termination(max_iterations=n)).cost for n in (1, 2, 4, 8)]
    assert torch.equal(start, kept)
    for before, after in pairwise(costs):
        assert (after <= before).all()


def test_a_block_depends_neither_on_the_others_nor_on_their_order():
    problem, start, shared, _ = decays()
    whole = solve_local(problem, start, shared)
    for index in (torch.tensor([17]), torch.tensor([3, 50]), torch.arange(59, -1, -1), torch.arange(5, 42)):
        part = solve_local(problem.take(index), start[index], shared)
        assert torch.equal(part.local, whole.local[index])
        assert torch.equal(part.cost, whole.cost[index])
        assert torch.equal(part.converged, whole.converged[index])


def test_a_block_that_is_no_number_does_not_spoil_the_others():
    problem, start, shared, truth = decays()
    x, y = problem.data
    y = y.clone()
    y[4] = torch.nan
    broken = BlockProblem(residual=decay, data=(x, y))
    found = solve_local(broken, start, shared)
    others = torch.arange(60) != 4
    assert float((found.local - truth)[others].abs().max()) < 1e-6
    assert found.local.isfinite().all()
    assert not found.converged[4]
    assert found.converged[others].all()


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_block_without_a_finite_cost_says_so(value):
    problem, start, shared, _ = decays(blocks=3)
    x, y = problem.data
    broken = BlockProblem(residual=decay, data=(x, y.index_fill(0, torch.tensor([1]), value)))
    found = solve_local(broken, start, shared)
    assert found.cost.isfinite().tolist() == [True, False, True]
    assert found.converged.tolist() == [True, False, True]


def test_a_matrix_that_is_not_positive_is_damped_rather_than_called_the_end():
    V = torch.tensor([[1.0, 2.0], [2.0, 1.0]], dtype=torch.float64)[..., None].expand(2, 2, 2)
    gradient = torch.ones(2, 2, dtype=torch.float64)
    step, predicted = solve_damped(V, gradient, torch.tensor([1e-4, 10.0], dtype=torch.float64))
    assert (step[:, 0] == 0).all()
    assert predicted[0] == torch.inf
    assert (step[:, 1] < 0).all()
    assert predicted[1].isfinite()


def test_an_outlier_is_weighed_down():
    threshold = torch.full((9,), 0.05, dtype=torch.float64)
    problem, start, shared, truth = decays(threshold=threshold)
    x, y = problem.data
    y = y.clone()
    y[:, 4] += 1.0
    plain = solve_local(BlockProblem(residual=decay, data=(x, y)), start, shared)
    robust = solve_local(BlockProblem(residual=decay, data=(x, y), threshold=threshold), start, shared)
    far = lambda found: float((found.local - truth).abs().median())  # noqa: E731
    assert far(robust) < 0.25 * far(plain)


@pytest.mark.parametrize("at_once", [1, 100, 299])
def test_blocks_that_wait_for_a_place_end_where_they_would_have(at_once):
    problem, start, shared, _ = decays(blocks=300)
    together, in_turn = solve_local(problem, start, shared), solve_local(problem, start, shared, at_once=at_once)
    assert torch.equal(in_turn.local, together.local)
    assert torch.equal(in_turn.cost, together.cost)
    assert torch.equal(in_turn.converged, together.converged)
    assert in_turn.iterations == together.iterations


def test_no_more_blocks_are_under_way_than_may_be():
    problem, start, shared, _ = decays(blocks=300)
    sizes = []

    def watched(local, shared, x, y):
        sizes.append(len(x))
        return decay(local, shared, x, y)

    solve_local(BlockProblem(residual=watched, data=problem.data), start, shared, at_once=LANES)
    assert set(sizes) == {LANES}
    assert LANES * len(sizes) < 1.5 * solve_local(problem, start, shared).iterations * 300


def random_systems():
    g = torch.Generator().manual_seed(2)
    J = torch.randn(6, 8, 3, generator=g, dtype=torch.float64) * torch.tensor([1.0, 1e-2, 1e2], dtype=torch.float64)
    r = torch.randn(6, 8, generator=g, dtype=torch.float64)
    return J, r, torch.rand(6, 8, generator=g, dtype=torch.float64)


def test_the_damped_step_solves_its_equations():
    J, r, weight = random_systems()
    mu = torch.logspace(-6, 2, 6, dtype=torch.float64)
    V, gradient = normal_equations(r, J, weight)
    lower = V.tril().permute(1, 2, 0)  # what is above the diagonal has no say
    step, predicted = solve_damped(lower, gradient.T, mu)
    for p in range(6):
        w = torch.diag(weight[p])
        dense = J[p].T @ w @ J[p]
        torch.testing.assert_close(V[p], dense)
        system = dense + mu[p] * torch.diag(dense.diagonal())
        expected = -torch.linalg.solve(system, J[p].T @ w @ r[p])
        torch.testing.assert_close(step[:, p], expected, rtol=1e-6, atol=0)
        linear = r[p] + J[p] @ expected
        promise = 0.5 * (r[p] @ w @ r[p] - linear @ w @ linear)
        torch.testing.assert_close(predicted[p], promise, rtol=1e-6, atol=1e-12)


def test_several_right_sides_and_a_matrix_that_is_not_positive():
    J, r, weight = random_systems()
    V, _ = normal_equations(r, J, weight)
    V[4, 1, 1] = -1.0
    right = torch.randn(2, 3, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    solution = solve_positive(V.permute(1, 2, 0), V.diagonal(dim1=1, dim2=2).T, right)
    assert (solution[..., 4] == 0).all()
    for p in (0, 1, 2, 3, 5):
        torch.testing.assert_close(solution[:, :, p], torch.linalg.solve(V[p], right[:, :, p].T).T, rtol=1e-8, atol=0)


def test_a_step_as_good_as_promised_lowers_the_damping_and_one_that_barely_helps_raises_it():
    factor = relaxed(torch.tensor([1.0, 0.5, 0.0, 5.0, -3.0]))
    torch.testing.assert_close(factor, torch.tensor([0.1, 1.0, 2.0, 0.1, 2.0]))
    assert (relaxed(torch.linspace(0, 1, 20)).diff() <= 0).all()


def test_a_parameter_that_nothing_feels_stays_where_it_is():
    V = torch.tensor([[[2.0], [0.0]], [[0.0], [0.0]]], dtype=torch.float64)
    mu = torch.tensor([1e-3], dtype=torch.float64)
    step, _ = solve_damped(V, torch.tensor([[1.0], [0.0]], dtype=torch.float64), mu)
    assert step[1, 0] == 0.0
    torch.testing.assert_close(step[0, 0], torch.tensor(-0.5 / 1.001, dtype=torch.float64))
