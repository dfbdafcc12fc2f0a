from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.solve.problem import BlockProblem, forward_jacobian, robust_cost, robust_weight


def bend(local, shared, x):
    """Residuals that use every unknown nonlinearly; block by block and in batch alike."""
    return (
        local[..., :1] * torch.exp(-local[..., 1:2] * x)
        + shared[0] * x.square()
        + torch.sin(shared[1] * local[..., :1])
    )


def some_blocks(blocks=7, samples=5):
    g = torch.Generator().manual_seed(3)
    local = torch.rand(blocks, 2, generator=g, dtype=torch.float64) + 0.2
    shared = torch.rand(2, generator=g, dtype=torch.float64)
    x = torch.rand(blocks, samples, generator=g, dtype=torch.float64)
    return local, shared, x


def test_forward_jacobian_is_that_of_every_block_on_its_own():
    local, shared, x = some_blocks()
    r, J, K = forward_jacobian(bend, local, shared, (x,))
    assert torch.equal(r, bend(local, shared, x))
    for p in range(len(local)):
        by_local, by_shared = torch.autograd.functional.jacobian(
            lambda own, g, p=p: bend(own, g, x[p]), (local[p], shared)
        )
        torch.testing.assert_close(J[p], by_local, rtol=1e-12, atol=1e-14)
        torch.testing.assert_close(K[p], by_shared, rtol=1e-12, atol=1e-14)


def test_forward_jacobian_agrees_with_finite_differences():
    local, shared, x = some_blocks()
    _, J, K = forward_jacobian(bend, local, shared, (x,))
    h = 1e-6
    for p in range(2):
        step = torch.zeros(2, dtype=torch.float64)
        step[p] = h
        by_local = (bend(local + step, shared, x) - bend(local - step, shared, x)) / (2 * h)
        by_shared = (bend(local, shared + step, x) - bend(local, shared - step, x)) / (2 * h)
        torch.testing.assert_close(J[..., p], by_local, rtol=1e-7, atol=1e-9)
        torch.testing.assert_close(K[..., p], by_shared, rtol=1e-7, atol=1e-9)


def test_a_closed_form_jacobian_is_used_where_given():
    local, shared, x = some_blocks()
    given_form = (torch.ones(7, 5), torch.ones(7, 5, 2), torch.ones(7, 5, 2))
    problem = BlockProblem(residual=bend, data=(x,), jacobian=lambda *_, with_shared: given_form)
    assert all(a is b for a, b in zip(problem.linearise(local, shared), given_form, strict=True))
    assert all(a is b for a, b in zip(problem.linearise_local(local, shared), given_form[:2], strict=True))


def test_take_cuts_data_and_keeps_the_rest():
    local, shared, x = some_blocks()
    problem = BlockProblem(residual=bend, data=(x,), threshold=torch.full((5,), 0.3, dtype=torch.float64))
    index = torch.tensor([5, 0, 2])
    part = problem.take(index)
    assert len(part) == 3
    assert torch.equal(part.costs(local[index], shared), problem.costs(local, shared)[index])
    assert len(problem.take(slice(2, 6))) == 4


def test_shared_cost_is_half_the_square():
    _, shared, x = some_blocks()
    plain = BlockProblem(residual=bend, data=(x,))
    assert float(plain.shared_cost(shared)) == 0.0
    bound = BlockProblem(residual=bend, data=(x,), shared_residual=lambda g: torch.stack([g[0] * 3, g[1] - 2]))
    expected = 0.5 * ((3 * shared[0]) ** 2 + (shared[1] - 2) ** 2)
    torch.testing.assert_close(bound.shared_cost(shared), expected)


def scalar_huber(r: float, t: float) -> float:
    return 0.5 * r * r if abs(r) <= t else t * (abs(r) - 0.5 * t)


@given(st.floats(-50, 50), st.floats(0.1, 10))
def test_huber_cost_is_its_definition(r, t):
    cost = robust_cost(torch.tensor([[r]], dtype=torch.float64), torch.tensor([t], dtype=torch.float64))
    torch.testing.assert_close(cost, torch.tensor([scalar_huber(r, t)], dtype=torch.float64))


@given(st.floats(-50, 50).filter(lambda r: abs(r) > 1e-3), st.floats(0.1, 10))
def test_huber_weight_is_the_slope_of_the_cost_over_r(r, t):
    h = 1e-6
    slope = (scalar_huber(r + h, t) - scalar_huber(r - h, t)) / (2 * h)
    weight = robust_weight(torch.tensor([[r]], dtype=torch.float64), torch.tensor([t], dtype=torch.float64))
    torch.testing.assert_close(weight, torch.tensor([[slope / r]], dtype=torch.float64), rtol=1e-4, atol=1e-5)


def test_thresholds_are_taken_residual_by_residual_and_inf_is_least_squares():
    r = torch.tensor([[3.0, -3.0, 0.0]], dtype=torch.float64)
    threshold = torch.tensor([1.0, torch.inf, torch.inf], dtype=torch.float64)
    assert float(robust_cost(r, threshold)) == (3.0 - 0.5) + 4.5
    torch.testing.assert_close(robust_weight(r, threshold), torch.tensor([[1 / 3, 1.0, 1.0]], dtype=torch.float64))
    assert torch.equal(robust_cost(r, None), torch.tensor([9.0], dtype=torch.float64))
    assert torch.equal(robust_weight(r, None), torch.ones_like(r))


def test_a_residual_that_is_no_number_costs_infinitely_much():
    r = torch.tensor([[1.0, torch.nan], [1.0, 1.0]], dtype=torch.float64)
    cost = robust_cost(r, torch.full((2,), 2.0, dtype=torch.float64))
    assert cost[0] == torch.inf
    assert cost[1] == 1.0
