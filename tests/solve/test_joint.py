"""Blocks and what they share, beside a dense solve of everything at once."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from torch import Tensor

from reflectsep.solve.joint import following, reduced, solve_joint
from reflectsep.solve.levenberg import Normal, Status, Termination

TIMES = torch.linspace(0.0, 3.0, 8, dtype=torch.float64)[:, None]
TRUTH = torch.tensor([0.8, 0.3, 0.0], dtype=torch.float64)
END = Termination(tolerance=1e-12, max_iterations=60)


@dataclass(frozen=True)
class Decays:
    """y = x_1 exp(-g_1 t) + x_2 + g_2 t in every block; the third shared parameter has no say but its prior's."""

    y: Tensor
    prior: float = 0.0

    def __len__(self):
        return self.y.shape[1]

    def take(self, index):
        return replace(self, y=self.y[:, index])

    def residuals(self, local, shared):
        return local[0] * (-shared[0] * TIMES).exp() + local[1] + shared[1] * TIMES - self.y

    def slopes(self, local, shared):
        fall = (-shared[0] * TIMES).exp()
        J = torch.stack([fall.expand_as(self.y), torch.ones_like(self.y)], 1)
        rising = TIMES.expand_as(self.y)
        return J, torch.stack([-TIMES * local[0] * fall, rising, torch.zeros_like(rising)], 1)

    def normal(self, local, shared):
        rows, (J, _) = self.residuals(local, shared), self.slopes(local, shared)
        return Normal(
            0.5 * rows.square().sum(0), torch.einsum("rpn,rn->pn", J, rows), torch.einsum("rpn,rqn->pqn", J, J)
        )

    def coupled(self, local, shared):
        rows, (J, Jg) = self.residuals(local, shared), self.slopes(local, shared)
        at = self.normal(local, shared)
        W, H = torch.einsum("rpn,rgn->pgn", J, Jg), torch.einsum("rgn,rhn->ghn", Jg, Jg)
        return at.V, at.g, W, H, torch.einsum("rgn,rn->gn", Jg, rows)

    def shared_rows(self, shared):
        return torch.stack([self.prior * (shared[0] - 1.0), shared[2] - 0.7])

    def bounded(self, shared):
        return shared.clamp(-2.0, 2.0)


def decays(blocks=25, noise=0.0, **options):
    g = torch.Generator().manual_seed(2)
    x = 0.5 + torch.rand(2, blocks, generator=g, dtype=torch.float64)
    y = Decays(torch.zeros(8, blocks, dtype=torch.float64)).residuals(x, TRUTH)
    return Decays(y + noise * torch.randn(y.shape, generator=g, dtype=torch.float64), **options), x


def solved(problem, free=(True, True, True), chunk=10, **options):
    start = torch.ones(2, len(problem), dtype=torch.float64)
    shared = torch.tensor([0.4, 0.0, 0.0], dtype=torch.float64)
    options = {"end": END, "inner": END, "chunk": chunk} | options
    return solve_joint(problem, start, shared, torch.tensor(free), **options)


def test_shared_parameters_come_back():
    problem, x = decays()
    found = solved(problem)
    torch.testing.assert_close(found.shared[:2], TRUTH[:2], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(found.local, x, rtol=1e-4, atol=1e-4)
    assert float(found.shared[2]) == pytest.approx(0.7)
    assert found.status == Status.CONVERGED
    assert all(later < earlier for earlier, later in zip(found.history, found.history[1:], strict=False))


@pytest.mark.parametrize("prior", [0.0, 5.0])
def test_it_is_the_minimum_of_a_dense_solve(prior):
    problem, _ = decays(noise=0.05, prior=prior)

    def rows(flat):
        local, shared = torch.from_numpy(flat[:-3]).view(2, -1), torch.from_numpy(flat[-3:])
        return torch.cat([problem.residuals(local, shared).flatten(), problem.shared_rows(shared)]).numpy()

    start = np.concatenate([np.ones(50), [0.4, 0.0, 0.0]])
    dense = least_squares(rows, start, method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    found = solved(problem)
    torch.testing.assert_close(found.shared, torch.from_numpy(dense.x[-3:]), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(found.local.flatten(), torch.from_numpy(dense.x[:-3]), rtol=1e-3, atol=1e-3)
    total = float(found.cost.sum() + 0.5 * problem.shared_rows(found.shared).square().sum())
    assert total == pytest.approx(dense.cost, rel=1e-8)


def test_the_reduced_system_is_the_schur_complement_of_the_dense_one():
    problem, x = decays(noise=0.05, blocks=6, prior=2.0)
    shared = torch.tensor([0.5, 0.1, 0.2], dtype=torch.float64)
    S, right, X = reduced(problem, x, shared, 4, torch.arange(6))

    def rows(flat):
        local, g = flat[:-3].view(2, 6), flat[-3:]
        return torch.cat([problem.residuals(local, g).flatten(), problem.shared_rows(g)])

    flat = torch.cat([x.flatten(), shared])
    J, r = torch.func.jacfwd(rows)(flat), rows(flat)
    H, g = J.mT @ J, J.mT @ r
    V, W = H[:-3, :-3], H[:-3, -3:]
    torch.testing.assert_close(S, H[-3:, -3:] - W.mT @ torch.linalg.solve(V, W), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(right, -(g[-3:] - W.mT @ torch.linalg.solve(V, g[:-3])), rtol=1e-9, atol=1e-9)
    dg = torch.tensor([0.01, -0.02, 0.03], dtype=torch.float64)
    expected = -torch.linalg.solve(V, g[:-3] + W @ dg).view(2, 6)
    torch.testing.assert_close(following(X, dg), expected, rtol=1e-9, atol=1e-9)


def test_what_is_not_free_stays():
    problem, _ = decays(noise=0.05)
    found = solved(problem, free=(True, False, False))
    assert found.shared[1:].tolist() == [0.0, 0.0]
    assert float(found.shared[0]) != 0.4
    held = solved(problem, free=(False, False, False))
    assert held.shared.tolist() == [0.4, 0.0, 0.0]
    assert held.status == Status.CONVERGED
    assert float(held.cost.sum()) > float(found.cost.sum())


def test_blocks_that_the_model_does_not_explain_have_no_say():
    problem, _ = decays(blocks=40)
    problem.y[:, 3] += 2.0 * torch.cos(9.0 * TIMES[:, 0])
    problem.y[:, 17] += 3.0 * TIMES[:, 0].square()
    trimmed, whole = solved(problem, trim=0.9), solved(problem)
    off = lambda found: float((found.shared[:2] - TRUTH[:2]).abs().max())  # noqa: E731
    assert off(trimmed) < 1e-3
    assert off(whole) > 10 * off(trimmed)


def test_it_does_not_depend_on_how_the_blocks_are_cut():
    problem, _ = decays(noise=0.05)
    exact = Termination(tolerance=1e-15, max_iterations=60)
    once, thrice = (solved(problem, chunk=chunk, end=exact, inner=exact) for chunk in (100, 9))
    torch.testing.assert_close(once.shared, thrice.shared, rtol=1e-9, atol=1e-9)
    # A cost in double precision tells a minimum to the root of its rounding, about 1e-8, and no better.
    torch.testing.assert_close(once.local, thrice.local, rtol=1e-7, atol=1e-7)


def test_iterations_are_limited_and_reported():
    problem, _ = decays(noise=0.05)
    seen = []
    found = solved(problem, end=Termination(tolerance=0.0, max_iterations=2), watch=seen.append)
    assert found.status == Status.EXHAUSTED
    assert found.iterations == 2
    assert seen == [1, 2]
    assert len(found.history) == 2


def test_blocks_without_a_finite_cost_have_no_say():
    problem, _ = decays(blocks=40)
    problem.y[2, 7] = torch.nan
    found = solved(problem, trim=0.9)
    torch.testing.assert_close(found.shared[:2], TRUTH[:2], rtol=1e-5, atol=1e-5)
    problem.y[0] = torch.nan
    assert solved(problem).status == Status.FAILED


def test_a_solve_of_no_blocks_is_refused():
    problem, _ = decays()
    with pytest.raises(ValueError, match="no blocks"):
        solved(problem.take(slice(0, 0)))
