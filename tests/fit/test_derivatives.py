"""The closed form against forward mode, column by column, wherever the residual has another branch."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from reflectsep.fit.blocks import build_problem
from reflectsep.fit.problem import SHARED_NAMES, Locals, Observations, Priors
from reflectsep.solve.local import LANES
from reflectsep.solve.problem import forward_jacobian

PIXELS, LIGHTS = 40, 7


CASES = [
    {},
    {"channels": 3},
    {"channels": 3, "s_unknown": True},
    {"s_unknown": True, "n_d": None},
    {"channels": 3, "n_d": 0.8, "clipped": True},
    {"lights_known": False, "n_d": None, "channels": 3},
    {"alphas": True},
    {"alphas": True, "lights_known": False, "channels": 3, "s_unknown": True},
    {"alphas": True, "n_d": 0.8, "clipped": True, "s_unknown": True, "swept": (True,) * 4 + (False,) * 3},
]


def random_case(*, channels=1, s_unknown=False, n_d=1.0, lights_known=True, clipped=False, swept=(), alphas=False):
    """Observations, priors and parameters without any structure; shadows, lobes and clipped values among them."""
    g = torch.Generator().manual_seed(7)

    def rand(*shape):
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    basis = torch.nn.functional.normalize(rand(3, 3) - 0.5 + torch.eye(3), dim=-1)
    view = torch.tensor([0.1, -0.05, 1.0], dtype=torch.float64)
    images = rand(PIXELS, channels, LIGHTS)
    alpha = torch.cat([torch.eye(3, dtype=torch.float64), rand(LIGHTS - 3, 3) * 1.6 - 0.3])
    obs = Observations(
        images=images,
        s=rand(PIXELS, channels, LIGHTS) * 0.3,
        weight=5.0 + rand(PIXELS, channels, LIGHTS),
        clipped=(rand(PIXELS, channels, LIGHTS) < 0.3) & clipped,
        alpha=alpha,
        normal_map=torch.linalg.inv(basis),
        view=view / view.norm(),
        cosine=0.5 + 0.5 * rand(3),
        lights_known=lights_known,
        n_d=n_d,
        s_unknown=s_unknown,
        swept=swept,
    )
    priors = Priors(
        shape=7.0,
        parallel=1.0 + rand(PIXELS),
        ratio=1.0 + rand(PIXELS),
        ratio_weight=2.0 + rand(PIXELS),
        lobe=rand(PIXELS, 3),
        lobe_weight=3.0 + rand(PIXELS),
        facing=torch.nn.functional.normalize(rand(PIXELS, 3), dim=-1),
        facing_weight=2.0 + rand(PIXELS),
        s_weight=4.0 + rand(PIXELS),
    )
    d = rand(PIXELS, channels, 3) * 1.2 - 0.4
    local = Locals(d, rand(PIXELS) * 2.0, rand(PIXELS, channels, 3) * 0.3 if s_unknown else None).pack()
    shared = torch.tensor([-0.2, -0.3, -0.25, 1.1, 0.3, 0.4, 0.5, -0.1], dtype=torch.float64)
    if alphas:
        shared = torch.cat([shared, 0.2 * rand(3 * (LIGHTS - 3)) - 0.1])
    return obs, priors, local, shared


@pytest.mark.parametrize("case", CASES, ids=str)
@pytest.mark.parametrize("softness", [0.0, 0.4])
@pytest.mark.parametrize("ggx", [0.0, 1.0])
def test_closed_form_is_the_derivative(case, softness, ggx):
    obs, priors, local, shared = random_case(**case)
    shared[SHARED_NAMES.index("softness")] = softness
    shared[SHARED_NAMES.index("ggx")] = ggx
    problem = build_problem(obs, priors, robust=5.0)
    r, J, K = forward_jacobian(problem.residual, local, shared, problem.data)
    own = problem.linearise(local, shared)
    alone = problem.linearise_local(local, shared)
    for mine, reference in zip((*own, *alone), (r, J, K, r, J), strict=True):
        torch.testing.assert_close(mine, reference, rtol=1e-9, atol=1e-9)
    # Every unknown is felt by the pictures, or the comparison would be of zeros.
    assert (J[:, : obs.images[0].numel()].abs().amax((0, 1)) > 0).all()
    assert (K[:, : obs.images[0].numel(), 8:].abs().amax((0, 1)) > 0).all()


def test_the_fit_uses_the_closed_form():
    obs, priors, local, shared = random_case()
    problem = build_problem(obs, priors, robust=None)

    def forbidden(*_):
        raise AssertionError("forward mode was used")

    fast = replace(problem, residual=forbidden)
    assert fast.linearise(local, shared)[1].shape == (PIXELS, problem.residuals(local, shared).shape[1], 4)


@pytest.mark.parametrize("case", CASES, ids=str)
@pytest.mark.parametrize("softness", [0.0, 0.4])
@pytest.mark.parametrize("ggx", [0.0, 1.0])
@pytest.mark.parametrize("robust", [None, 0.5])
def test_normal_equations_are_those_of_the_rows(case, softness, ggx, robust):
    obs, priors, local, shared = random_case(**case)
    shared[SHARED_NAMES.index("softness")] = softness
    shared[SHARED_NAMES.index("ggx")] = ggx
    problem = build_problem(obs, priors, robust=robust)
    of_rows = replace(problem, normal=None, coupled=None)
    (cost, gradient, V), at = problem.normal_equations(local, shared), problem.coupled_equations(local, shared)
    by_rows, coupled = of_rows.normal_equations(local, shared), of_rows.coupled_equations(local, shared)

    def same(mine, reference):
        assert (mine - reference).abs().max() <= 1e-12 * reference.abs().max()

    lower = torch.ones(local.shape[1], local.shape[1], dtype=torch.bool).tril()
    for mine, reference in zip((cost, gradient, V[lower]), (*by_rows[:2], by_rows[2][lower]), strict=True):
        same(mine, reference)
    same(at.V[lower], coupled.V[lower])
    for name in ("gradient", "W", "shared_gradient", "H"):
        same(getattr(at, name), getattr(coupled, name))


@pytest.mark.parametrize("case", [{"channels": 3, "s_unknown": True}, {"n_d": 0.8, "clipped": True}], ids=str)
def test_normal_equations_of_a_pixel_do_not_depend_on_the_others(case, monkeypatch):
    monkeypatch.setitem(globals(), "PIXELS", 5 * LANES)
    obs, priors, local, shared = random_case(**case)
    problem = build_problem(obs, priors, robust=5.0)
    whole = problem.normal_equations(local, shared)
    for part in (slice(LANES, 2 * LANES), slice(0, 3 * LANES)):
        for some, of_all in zip(problem.take(part).normal_equations(local[part], shared), whole, strict=True):
            assert torch.equal(some, of_all[..., part])
