"""The problem's closed forms beside autograd, and what its rows are."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from reflectsep.fit.autograd import DifferentiatedProblem, UnknownScattering
from reflectsep.fit.problem import (
    ALPHA,
    FRESNEL,
    LOG_N_D,
    LOG_N_S,
    SHARED_NAMES,
    F,
    globals_of,
    log_size,
    refined,
    upper_times,
)
from reflectsep.model import length, lobe_of, lobe_vector, mixed, reflectance
from reflectsep.solve.levenberg import Status, Termination, solve_blocks

CASES = [
    pytest.param({}, id="grey"),
    pytest.param({"channels": 3}, id="colour"),
    pytest.param({"n_d": None}, id="grey, n_d fitted"),
    pytest.param({"channels": 3, "n_d": None}, id="colour, n_d fitted"),
    pytest.param({"channels": 3, "n_d": 1.3, "refined": True}, id="alphas refined"),
    pytest.param({"channels": 3, "n_d": None, "refined": True}, id="alphas refined, n_d fitted"),
    pytest.param({"channels": 3, "ggx": False}, id="power"),
    pytest.param({"known": False}, id="directions unknown"),
    pytest.param({"known": False, "refined": True}, id="directions unknown, alphas refined"),
    pytest.param({"channels": 3, "neighbours": None, "height_spread": math.inf}, id="pictures alone"),
    pytest.param({"neighbours": None}, id="no neighbours"),
    pytest.param({"height_spread": math.inf}, id="no height"),
    pytest.param({"huber": None}, id="plain squares"),
]


def close(found, expected, scale=None):
    """Equal to 1e-9 of the largest of what is expected."""
    size = float(expected.abs().max()) if scale is None else scale
    assert float((found - expected).abs().max()) <= 1e-9 * size


def lower(V):
    """The triangle that counts."""
    return torch.tril(V.movedim(-1, 0))


@pytest.mark.parametrize("case", CASES)
def test_closed_forms_are_those_of_autograd(random_problem, case):
    problem, local, shared = random_problem(**case)
    reference, _, _ = random_problem(DifferentiatedProblem, **case)
    rows = problem.residuals(local, shared)
    torch.testing.assert_close(problem.normal(local, shared).cost, problem.robust(rows)[0], rtol=1e-9, atol=0)
    J = reference.jacobian(local, shared)
    close(problem.jacobian(local, shared), J)
    by_globals = reference.shared_jacobian(local, shared)
    found = problem.shared_jacobian(local, shared)
    for column, name in enumerate([*SHARED_NAMES, *["alpha"] * (len(shared) - ALPHA)]):
        close(found[:, column], by_globals[:, column], max(float(by_globals[:, column].abs().max()), 1e-6))
        if name != "log_n_d" or case.get("n_d", 1.0) is None:
            assert float(by_globals[:, column].abs().max()) > 1e-3 or case.get("known") is False, name
    at, expected = problem.normal(local, shared), reference.normal(local, shared)
    close(at.cost, expected.cost)
    close(at.g, expected.g)
    close(lower(at.V), lower(expected.V))
    V, gl, W, H, gg = problem.coupled(local, shared)
    weight = problem.robust(rows)[1]
    close(lower(V), lower(expected.V))
    close(gl, expected.g)
    close(W, torch.einsum("rpn,rn,rgn->pgn", J, weight, by_globals))
    close(H, torch.einsum("rhn,rn,rgn->hgn", by_globals, weight, by_globals))
    close(gg, torch.einsum("rgn,rn->gn", by_globals, weight * rows))


def test_the_reference_itself_agrees_with_finite_differences(random_problem):
    problem, local, shared = random_problem(DifferentiatedProblem, channels=3, n_d=None, refined=True, pixels=2)
    inputs = (local.clone().requires_grad_(), shared.clone().requires_grad_())
    assert torch.autograd.gradcheck(problem.residuals, inputs)


def test_rows_are_the_pictures_the_height_and_the_neighbours(random_problem):
    problem, local, shared = random_problem(channels=3, clipped=0.5)
    obs, g = problem.obs, globals_of(shared, problem.obs)
    d, B = problem.unpacked(local)
    rows = problem.residuals(local, shared)
    assert len(rows) == 18 + 1 + 3
    model = reflectance(d, B, g, s=obs.s[:3], alpha=obs.alpha, s_lights=obs.s)
    off = (model - obs.images) * obs.share / 0.1
    brighter = obs.clipped & (off > 0)
    assert brighter.any()
    assert (obs.clipped & ~brighter).any()
    pictures = rows[:18].view(6, 3, -1)
    assert float(pictures[brighter].abs().max()) == 0.0
    torch.testing.assert_close(pictures[~brighter], off[~brighter])
    w = lobe_vector(d, obs.s[:3], B, g)
    log_C = (shared[:3] - obs.cosine.log()).mean()
    torch.testing.assert_close(rows[18], g.n_s * (length(g.M, w).log() - log_C) / 0.5)
    v = (w - g.a[:, None]) / (2 * log_C.exp())
    assert problem.neighbours is not None
    R = torch.zeros(3, 3, len(obs), dtype=torch.float64)
    for entry, place in zip(problem.neighbours.R, [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)], strict=True):
        R[place] = entry
    torch.testing.assert_close(rows[19:], torch.einsum("ijn,jn->in", R, v - problem.neighbours.vector))
    torch.testing.assert_close(problem.neighbours.precision(), torch.einsum("kin,kjn->ijn", R, R))
    torch.testing.assert_close(upper_times(problem.neighbours.R, v), torch.einsum("ijn,jn->in", R, v))


def test_huber_takes_large_residuals_of_pictures_by_their_size_and_others_by_their_square(random_problem):
    problem, local, shared = random_problem(huber=2.0, sigma=0.05)
    rows = problem.residuals(local, shared)
    rows[6:] *= 10.0
    cost, weight = problem.robust(rows)
    large = rows[:6].abs() > 2.0
    assert large.any()
    assert (~large).any()
    loss = torch.where(large, 2.0 * rows[:6].abs() - 2.0, 0.5 * rows[:6].square())
    torch.testing.assert_close(cost, loss.sum(0) + 0.5 * rows[6:].square().sum(0))
    # The weight is the loss's slope over the residual.
    torch.testing.assert_close(weight[:6] * rows[:6], rows[:6].clamp(-2.0, 2.0))
    assert (weight[6:] == 1).all()


def test_a_mirror_surface_has_the_height_that_is_expected(random_problem):
    problem, _, shared = random_problem()
    obs = problem.obs
    shared[:3] = obs.cosine.log() + math.log(0.9)
    N = torch.nn.functional.normalize(torch.randn(3, 7, generator=torch.Generator().manual_seed(3)).double(), dim=0)
    N[2] = N[2].abs()
    d = 0.5 * torch.linalg.inv(obs.M) @ N
    problem = replace(problem, obs=replace(obs, s=torch.zeros_like(obs.s)))
    local = problem.packed(d[:, None], (2 * 0.9 * N[2] / 0.5).log())
    assert float(log_size(shared, obs)) == pytest.approx(math.log(0.9))
    torch.testing.assert_close(problem.residuals(local, shared)[6], torch.zeros(7, dtype=torch.float64))


def explained(problem, local, shared):
    """The problem with pictures that its model explains but for some noise, and a start beside the unknowns."""
    g = torch.Generator().manual_seed(5)
    noise = lambda size, like: size * torch.randn(like.shape, generator=g, dtype=like.dtype)  # noqa: E731
    images, s = problem.obs.images, problem.obs.s[:3]
    d, B = problem.unpacked(local)
    obs = replace(problem.obs, s=mixed(problem.obs.alpha, s), clipped=torch.zeros_like(problem.obs.clipped))
    model = reflectance(d, B, globals_of(shared, obs), s=s, alpha=obs.alpha)
    obs = replace(obs, images=model + noise(0.02, images))
    return replace(problem, obs=obs, sigma=0.02), local + noise(0.05, local)


def test_a_pixel_does_not_depend_on_what_is_solved_beside_it(random_problem):
    problem, local, shared = random_problem(channels=3, pixels=40)
    problem, local = explained(problem, local, shared)
    end = Termination(tolerance=1e-6, max_iterations=60)
    together = solve_blocks(problem, local, shared, end)
    assert (together.status == int(Status.CONVERGED)).sum() > 30
    some = torch.tensor([3, 4, 11, 39])
    for index in (some, slice(17, 18)):
        apart = solve_blocks(problem.take(index), local[:, index], shared, end)
        torch.testing.assert_close(apart.local, together.local[:, index], rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(apart.cost, together.cost[index], rtol=1e-9, atol=0)
        assert torch.equal(apart.status, together.status[index])


def test_a_solved_pixel_has_no_slope_left(random_problem):
    problem, local, shared = random_problem(channels=3, pixels=40, huber=None)
    problem, local = explained(problem, local, shared)
    found = solve_blocks(problem, local, shared, Termination(tolerance=1e-12, max_iterations=200))
    done = found.status == int(Status.CONVERGED)
    assert float(done.double().mean()) > 0.8
    before, after = problem.normal(local, shared), problem.normal(found.local, shared)
    assert (after.cost <= before.cost).all()
    slope = (after.g.norm(dim=0) / before.g.norm(dim=0))[done]
    assert float(slope.median()) < 1e-4


def test_refined_alphas_split_into_direction_and_intensity(random_problem):
    problem, _, shared = random_problem(refined=True)
    found = refined(problem.obs, shared)
    beta = problem.obs.alpha[3:] + shared[ALPHA:].view(3, 3)
    vector = beta @ torch.linalg.inv(problem.obs.M)
    torch.testing.assert_close(found.intensity[3:], vector.norm(dim=1))
    torch.testing.assert_close(found.obs.alpha[3:] * found.intensity[3:, None], beta)
    assert torch.equal(found.obs.alpha[:3], problem.obs.alpha[:3])
    assert torch.equal(found.intensity[:3], torch.ones(3, dtype=torch.float64))
    # Light 4 has a sweep of its own; what is mixed moves with the alphas.
    assert torch.equal(found.obs.s[:4], problem.obs.s[:4])
    moved = torch.einsum("ji,icn->jcn", found.obs.alpha[4:] - problem.obs.alpha[4:], problem.obs.s[:3])
    torch.testing.assert_close(found.obs.s[4:], problem.obs.s[4:] + moved)


def test_what_is_expected_of_the_globals(random_problem):
    problem, _, shared = random_problem(n_d=None, refined=True)
    problem = replace(problem, obs=replace(problem.obs, n_d_sd=0.02), alpha_sd=0.05)
    shared[:3] = problem.obs.cosine.log() - 0.3
    rows = problem.shared_rows(shared)
    # One C_1 for all basis lights, whatever it is, is as expected.
    torch.testing.assert_close(rows[:3], torch.zeros(3, dtype=torch.float64))
    assert float(rows[3]) == pytest.approx((0.1 - math.log(1.1)) / 0.02)
    torch.testing.assert_close(rows[-9:], shared[ALPHA:] / 0.05)
    assert len(replace(problem, priors=False).shared_rows(shared)) == 3 + 1 + 9
    shared[0] += 0.01
    assert float(problem.shared_rows(shared)[:3].square().sum()) == pytest.approx(2 / 3)


def test_globals_stay_what_they_can_be(random_problem):
    problem, _, shared = random_problem()
    wild = shared.clone()
    wild[F], wild[FRESNEL], wild[LOG_N_S] = -0.2, 1.4, 30.0
    found = problem.bounded(wild)
    assert (float(found[F]), float(found[FRESNEL])) == (0.0, 1.0)
    assert float(found[LOG_N_S].exp()) == pytest.approx(5000)
    assert torch.equal(problem.bounded(shared), shared)
    assert float(globals_of(shared, replace(problem.obs, fixed_n_d=None)).n_d) == pytest.approx(
        math.exp(float(shared[LOG_N_D]))
    )


def test_unknown_scattering_is_that_of_the_unknowns(random_problem):
    problem, local, shared = random_problem(UnknownScattering, channels=3, neighbours=None)
    d, B = problem.unpacked(local)
    s = problem.scattering(local)
    assert len(local) == 2 * 9 + 1
    g = globals_of(shared, problem.obs)
    rows = problem.residuals(local, shared)[:18].view(6, 3, -1)
    alpha = problem.obs.alpha
    model = reflectance(d, B, g, s=s, alpha=alpha)
    off = (model - problem.obs.images) * problem.weight
    free = ~problem.obs.clipped
    torch.testing.assert_close(rows[free], off[free])
    assert float(lobe_of(lobe_vector(d, s, B, g), g, alpha).max()) > 1e-3


def test_locals_are_packed_and_unpacked(random_problem):
    problem, local, _ = random_problem(channels=3)
    d, B = problem.unpacked(local)
    assert d.shape == (3, 3, 7)
    assert torch.equal(local[4], d[1, 1])  # basis light by basis light, channel by channel
    torch.testing.assert_close(problem.packed(d, B.log()), local)
    cut = problem.take(slice(2, 5))
    assert len(cut) == 3
    assert torch.equal(cut.obs.images, problem.obs.images[..., 2:5])
    assert cut.neighbours is not None
    assert torch.equal(cut.neighbours.R, problem.neighbours.R[:, 2:5])
