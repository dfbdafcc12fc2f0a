"""Every block to its own minimum, with its own end."""

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from reflectsep.solve.levenberg import Normal, Solution, Status, Termination, solve_blocks, solve_in_chunks

NOTHING = torch.zeros(0, dtype=torch.float64)


@dataclass(frozen=True)
class Valleys:
    """Rosenbrock's valley, rows (a - x, b (y - x^2), 1), with another a and b in every block."""

    a: Tensor
    b: Tensor

    def __len__(self):
        return len(self.a)

    def take(self, index):
        return replace(self, a=self.a[index], b=self.b[index])

    def normal(self, local, shared):
        x, y = local
        rows = torch.stack([self.a - x, self.b * (y - x.square())])
        one, nothing = torch.ones_like(x), torch.zeros_like(x)
        J = torch.stack([torch.stack([-one, nothing]), torch.stack([-2 * self.b * x, self.b])])
        return Normal(
            0.5 * rows.square().sum(0) + 0.5, torch.einsum("rpn,rn->pn", J, rows), torch.einsum("rpn,rqn->pqn", J, J)
        )


def valleys(blocks=20):
    g = torch.Generator().manual_seed(3)
    rand = lambda low, high: low + (high - low) * torch.rand(blocks, generator=g, dtype=torch.float64)  # noqa: E731
    return Valleys(rand(0.5, 1.5), rand(1.0, 30.0)), torch.stack([rand(-2.0, 2.0), rand(-2.0, 2.0)])


def test_every_block_comes_to_its_minimum():
    problem, start = valleys()
    kept = start.clone()
    found = solve_blocks(problem, start, NOTHING, Termination(tolerance=1e-10, max_iterations=200))
    assert (found.status == int(Status.CONVERGED)).all()
    torch.testing.assert_close(found.local, torch.stack([problem.a, problem.a.square()]), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(found.cost, problem.normal(found.local, NOTHING).cost, rtol=1e-9, atol=1e-20)
    assert torch.equal(start, kept)


def test_a_limit_of_one_exhausts_what_is_not_there_yet():
    problem, start = valleys()
    start[:, 4] = torch.stack([problem.a, problem.a.square()])[:, 4]
    found = solve_blocks(problem, start, NOTHING, Termination(max_iterations=1))
    assert found.status[4] == int(Status.CONVERGED)
    assert (found.status == int(Status.EXHAUSTED)).sum() > 15
    before = problem.normal(start, NOTHING).cost
    assert (found.cost <= before).all()
    torch.testing.assert_close(found.cost, problem.normal(found.local, NOTHING).cost, rtol=1e-9, atol=0)


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_block_without_a_finite_cost_fails_alone(value):
    problem, start = valleys()
    end = Termination(tolerance=1e-10, max_iterations=200)
    whole = solve_blocks(problem, start, NOTHING, end)
    broken = start.clone()
    broken[0, 5] = value
    found = solve_blocks(problem, broken, NOTHING, end)
    assert found.status[5] == int(Status.FAILED)
    others = torch.arange(20) != 5
    assert (found.status[others] == int(Status.CONVERGED)).all()
    torch.testing.assert_close(found.local[:, others], whole.local[:, others], rtol=1e-9, atol=1e-9)
    nowhere = solve_blocks(problem, torch.full_like(start, torch.nan), NOTHING, end)
    assert (nowhere.status == int(Status.FAILED)).all()


@dataclass(frozen=True)
class Uphill(Valleys):
    """A bowl whose slopes lie: every step that they promise leads up."""

    def normal(self, local, shared):
        eye = torch.eye(2, dtype=torch.float64)[..., None].expand(2, 2, len(self))
        return Normal(0.5 * local.square().sum(0), -local, eye)


def test_a_block_that_no_step_helps_fails_where_it_was():
    problem, start = valleys()
    found = solve_blocks(Uphill(problem.a, problem.b), start, NOTHING, Termination(max_iterations=100))
    assert (found.status == int(Status.FAILED)).all()
    torch.testing.assert_close(found.local, start, rtol=0, atol=0)


@dataclass(frozen=True)
class Cliff(Valleys):
    """A bowl whose slope is no number where it is deepest, beyond a cliff at x < 0.1."""

    def normal(self, local, shared):
        eye = torch.eye(2, dtype=torch.float64)[..., None].expand(2, 2, len(self))
        beyond = local[0] < 0.1
        cost = 1.0 + 0.5 * local.square().sum(0)
        return Normal(torch.where(beyond, 0.5, cost), torch.where(beyond, torch.nan, local), eye)


def test_no_step_leads_to_where_there_is_no_slope():
    problem, start = valleys()
    found = solve_blocks(Cliff(problem.a, problem.b), start.abs() + 0.2, NOTHING, Termination(max_iterations=100))
    assert found.local.isfinite().all()
    beyond = solve_blocks(Cliff(problem.a, problem.b), 0.0 * start, NOTHING, Termination())
    assert (beyond.status == int(Status.FAILED)).all()
    assert (found.local[0] >= 0.1).all()
    assert (found.cost < 1.0 + 0.5 * (start.abs() + 0.2).square().sum(0)).all()


def test_a_block_does_not_depend_on_the_others():
    problem, start = valleys()
    end = Termination(tolerance=1e-10, max_iterations=200)
    together = solve_blocks(problem, start, NOTHING, end)
    apart = solve_blocks(problem.take(slice(6, 9)), start[:, 6:9], NOTHING, end)
    torch.testing.assert_close(apart.local, together.local[:, 6:9], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("chunk", [1, 7, 100])
def test_chunks_are_the_blocks_in_order(chunk):
    problem, start = valleys()
    end = Termination(tolerance=1e-10, max_iterations=200)
    whole: Solution = solve_blocks(problem, start, NOTHING, end)
    found = solve_in_chunks(20, chunk, NOTHING, end, lambda cut: (problem.take(cut), start[:, cut]))
    torch.testing.assert_close(found.local, whole.local, rtol=1e-9, atol=1e-9)
    assert found.cost.shape == whole.cost.shape
    assert torch.equal(found.status, whole.status)


def test_an_unknown_that_no_row_sees_does_no_harm():
    @dataclass(frozen=True)
    class Blind(Valleys):
        def normal(self, local, shared):
            at = super().normal(local[:2], shared)
            V = torch.nn.functional.pad(at.V, (0, 0, 0, 1, 0, 1))
            return Normal(at.cost, torch.nn.functional.pad(at.g, (0, 0, 0, 1)), V)

    problem, start = valleys()
    found = solve_blocks(
        Blind(problem.a, problem.b),
        torch.cat([start, torch.ones(1, 20, dtype=torch.float64)]),
        NOTHING,
        Termination(tolerance=1e-10, max_iterations=200),
    )
    assert (found.status == int(Status.CONVERGED)).all()
    torch.testing.assert_close(found.local[0], problem.a, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(found.local[2], torch.ones(20, dtype=torch.float64), rtol=1e-9, atol=0)
