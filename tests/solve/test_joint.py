from __future__ import annotations

import pytest
import torch

from reflectsep.solve.joint import (
    JointOptions,
    follow,
    inverse,
    local_in_chunks,
    promised,
    reduced_system,
    shared_step,
    solve_joint,
)
from reflectsep.solve.local import Termination
from reflectsep.solve.problem import BlockProblem, robust_weight

BLOCKS, LOCAL, SHARED = 11, 3, 2


def curve(local, shared, x, y):
    """A decay of every block's own over a bend that all share."""
    own = local[..., :1] * torch.exp(-local[..., 1:2] * x) + local[..., 2:3] * x
    return own + shared[0] * torch.sin(shared[1] * x) - y


def prior(shared):
    return torch.stack([0.1 * (shared[0] - 0.5), 0.2 * shared.sum()])


def curves(*, threshold=None, shared_residual=None, noise=0.0):
    g = torch.Generator().manual_seed(5)
    rand = lambda *n: torch.rand(*n, generator=g, dtype=torch.float64)  # noqa: E731
    truth, shared = rand(BLOCKS, LOCAL) + 0.5, torch.tensor([0.4, 2.5], dtype=torch.float64)
    x = torch.linspace(0, 4, 12, dtype=torch.float64).expand(BLOCKS, 12).contiguous()
    y = curve(truth, shared, x, torch.zeros_like(x)) + noise * (rand(BLOCKS, 12) - 0.5)
    problem = BlockProblem(residual=curve, data=(x, y), threshold=threshold, shared_residual=shared_residual)
    return problem, truth, shared


def dense_system(problem, local, shared):
    """J^T w J and J^T w r of everything at once, block after block, the shared parameters last; slow and obvious."""
    n, P, G = *local.shape, len(shared)
    H = torch.zeros(n * P + G, n * P + G, dtype=torch.float64)
    gradient = torch.zeros(n * P + G, dtype=torch.float64)
    for p in range(n):
        data = [d[p] for d in problem.data]
        r = problem.residual(local[p], shared, *data)
        by_local, by_shared = torch.autograd.functional.jacobian(
            lambda x, g, data=data: problem.residual(x, g, *data), (local[p], shared)
        )
        row = torch.zeros(len(r), n * P + G, dtype=torch.float64)
        row[:, p * P : (p + 1) * P], row[:, n * P :] = by_local, by_shared
        w = torch.diag(robust_weight(r[None], problem.threshold)[0])
        H, gradient = H + row.T @ w @ row, gradient + row.T @ w @ r
    if problem.shared_residual is not None:
        Q = torch.autograd.functional.jacobian(problem.shared_residual, shared)
        H[n * P :, n * P :] += Q.T @ Q
        gradient[n * P :] += Q.T @ problem.shared_residual(shared)
    return H, gradient


@pytest.mark.parametrize("threshold", [None, 0.02])
@pytest.mark.parametrize("shared_residual", [None, prior])
def test_the_schur_step_is_the_dense_gauss_newton_step(threshold, shared_residual):
    limits = None if threshold is None else torch.full((12,), threshold, dtype=torch.float64)
    problem, truth, shared = curves(threshold=limits, shared_residual=shared_residual)
    local, shared = truth + 0.02, shared + 0.01
    H, gradient = dense_system(problem, local, shared)
    dense = -torch.linalg.solve(H, gradient)

    step = shared_step(reduced_system(problem, local, shared, 4), 0.0, None)
    torch.testing.assert_close(step, dense[-SHARED:], rtol=1e-5, atol=1e-9)

    moved = follow(problem, local, shared, step, 4)
    expected = local + dense[:-SHARED].view(BLOCKS, LOCAL)
    better = problem.costs(expected, shared + step) < problem.costs(local, shared + step)
    assert better.sum() > BLOCKS // 2
    torch.testing.assert_close(moved[better], expected[better], rtol=1e-5, atol=1e-7)
    assert torch.equal(moved[~better], local[~better])


def test_a_block_follows_only_where_that_lowers_its_cost():
    problem, truth, shared = curves()
    local = truth.clone()
    local[:4] += 0.3
    step = torch.tensor([0.5, -1.0], dtype=torch.float64)
    moved = follow(problem, local, shared, step, 100)
    assert (problem.costs(moved, shared + step) <= problem.costs(local, shared + step)).all()


def test_information_is_the_inverse_of_the_marginal_covariance():
    problem, truth, shared = curves(shared_residual=prior)
    H, _ = dense_system(problem, truth, shared)
    marginal = torch.linalg.inv(H)[-SHARED:, -SHARED:]
    system = reduced_system(problem, truth, shared, 5)
    torch.testing.assert_close(system.S, torch.linalg.inv(marginal), rtol=1e-5, atol=1e-8)


def test_chunks_add_up():
    problem, truth, shared = curves()
    whole = reduced_system(problem, truth + 0.05, shared, 100)
    for chunk in (1, 3, 11):
        part = reduced_system(problem, truth + 0.05, shared, chunk)
        torch.testing.assert_close(part.S, whole.S, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(part.gradient, whole.gradient, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("chunk", [1, 3, 11])
def test_a_block_is_bit_for_bit_the_same_in_any_chunk(chunk):
    problem, truth, shared = curves(noise=0.05)
    whole = local_in_chunks(problem, truth + 0.1, shared, Termination(), 100)
    part = local_in_chunks(problem, truth + 0.1, shared, Termination(), chunk)
    assert torch.equal(part.local, whole.local)
    assert torch.equal(part.cost, whole.cost)
    step = torch.tensor([0.01, 0.02], dtype=torch.float64)
    assert torch.equal(
        follow(problem, truth + 0.1, shared, step, chunk), follow(problem, truth + 0.1, shared, step, 100)
    )


def test_blocks_and_shared_parameters_are_recovered():
    problem, truth, shared = curves()
    watched = []
    found = solve_joint(
        problem,
        truth + 0.1,
        shared + torch.tensor([0.1, -0.2], dtype=torch.float64),
        JointOptions(tolerance=1e-12, chunk=4),
        watch=lambda i, cost: watched.append((i, cost)),
    )
    assert found.converged
    torch.testing.assert_close(found.shared, shared, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(found.local, truth, rtol=1e-3, atol=1e-4)
    assert list(found.history) == sorted(found.history, reverse=True)
    assert [cost for _, cost in watched] == list(found.history[1:])
    assert [i for i, _ in watched] == list(range(1, len(watched) + 1))


def test_the_optimum_has_no_gradient():
    problem, truth, shared = curves(noise=0.1, shared_residual=prior)
    found = solve_joint(problem, truth, shared, JointOptions(tolerance=1e-14, inner=Termination(max_iterations=30)))
    H, gradient = dense_system(problem, found.local, found.shared)
    # In standard deviations of the parameters.
    assert float((gradient * torch.linalg.inv(H).diagonal().sqrt()).abs().max()) < 1e-4


def test_blocks_say_whether_they_came_to_their_end():
    problem, truth, shared = curves(noise=0.1)
    step = shared + torch.tensor([0.05, -0.05], dtype=torch.float64)
    whole = solve_joint(problem, truth + 0.1, step)
    assert bool(whole.settled.all())
    hurried = solve_joint(
        problem, truth + 0.1, step, JointOptions(inner=Termination(max_iterations=1), max_iterations=1)
    )
    assert not bool(hurried.settled.any())


def test_it_stops_where_no_step_promises_more_than_the_tolerance():
    problem, truth, shared = curves(noise=0.1)
    rough = solve_joint(problem, truth, shared + 0.1, JointOptions(tolerance=1e-2))
    fine = solve_joint(problem, truth, shared + 0.1, JointOptions(tolerance=1e-12))
    assert rough.converged
    assert fine.converged
    assert rough.iterations < fine.iterations
    assert promised(reduced_system(problem, rough.local, rough.shared, 100), None) <= 1e-2 * rough.cost
    assert promised(reduced_system(problem, fine.local, fine.shared, 100), None) <= 1e-12 * fine.cost
    # What is promised at the rough end is what the fine one gains, to second order.
    gain = rough.cost - fine.cost
    assert promised(reduced_system(problem, rough.local, rough.shared, 100), None) == pytest.approx(gain, rel=0.2)


@pytest.mark.parametrize("held", [0, 1])
def test_what_is_not_free_stays_bit_for_bit(held):
    problem, truth, shared = curves()
    start = shared + torch.tensor([0.1, -0.1], dtype=torch.float64)
    free = torch.ones(2, dtype=torch.bool)
    free[held] = False
    found = solve_joint(problem, truth + 0.1, start, free=free)
    assert found.shared[held] == start[held]
    assert found.shared[1 - held] != start[1 - held]


def test_the_iteration_limit_is_no_convergence():
    problem, truth, shared = curves()
    found = solve_joint(
        problem, truth + 0.3, shared + 0.2, JointOptions(max_iterations=1, inner=Termination(max_iterations=1))
    )
    assert not found.converged
    assert found.iterations == 1


def test_inverse_is_the_inverse_and_ignores_what_nothing_feels():
    g = torch.Generator().manual_seed(8)
    J = torch.randn(4, 9, 3, generator=g, dtype=torch.float64) * torch.tensor([1.0, 1e-3, 1e3], dtype=torch.float64)
    V = J.mT @ J
    unit = torch.eye(3, dtype=torch.float64).expand(4, 3, 3)
    scale = V.diagonal(dim1=-2, dim2=-1).rsqrt()
    torch.testing.assert_close((inverse(V) @ V) * scale[:, None, :] / scale[:, :, None], unit, rtol=1e-6, atol=1e-6)
    nothing = inverse(torch.zeros(1, 2, 2, dtype=torch.float64))
    assert nothing.isfinite().all()
