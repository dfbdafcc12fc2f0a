from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from reflectsep.kernel.compiling import Speed
from reflectsep.kernel.joint import JointStop, Passes, coupled, solve_jointly
from reflectsep.kernel.problem import pack_constants, read_constants, read_data
from reflectsep.solve.joint import reduced_system
from tests.kernel.conftest import Scene
from tests.kernel.test_local import FORMS, reference

NEVER = Speed(compile="never")


@pytest.mark.parametrize("form", FORMS)
def test_the_coupling_is_that_of_automatic_differentiation(scene, form):
    made = scene(40, sigma=0.01, **form)
    p, static = made.problem, made.problem.form(made.lobe.n_d)
    constants = read_constants(pack_constants(p, made.lobe), static)
    found = coupled(made.start.unbind(0), read_data(torch.cat(p.maps).unbind(0), static), constants, static)
    r, J, K = reference(made).linearise(made.start.T, made.lobe.shared)
    W = torch.stack([torch.stack(row, -1) for row in found.W], -2)
    torch.testing.assert_close(W, J.mT @ K)
    H = K.mT @ K
    torch.testing.assert_close(
        torch.stack(found.H, -1), torch.stack([H[:, i, j] for i in range(4) for j in range(i, 4)], -1)
    )
    torch.testing.assert_close(torch.stack(found.gradient, -1), (K.mT @ r[..., None])[..., 0])


@pytest.mark.parametrize("block", [64, 1 << 14])
def test_the_blocks_add_up_to_the_generic_schur_system(scene, block):
    whole = scene(600, sigma=0.002)
    u = whole.problem.alpha @ (whole.lobe.a[:, None] + whole.truth[3].exp() * whole.truth[:3])
    seen = ((u > 0.75).sum(0) >= 3).nonzero()[:, 0]
    assert len(seen) > 130
    made = Scene(whole.problem.take(seen), whole.lobe, whole.truth[:, seen], whole.start[:, seen])
    passes = Passes(made.problem, made.lobe, NEVER, block)
    places = torch.empty_like(made.truth)
    cost, system = passes.run(made.truth, places, made.lobe, made.lobe)
    generic = reference(made)
    expected = reduced_system(generic, places.T, made.lobe.shared, 128)
    assert cost == pytest.approx(float(generic.costs(places.T, made.lobe.shared).sum()))
    # Where a lobe is hardly seen, the traces of damping that keep the two routes regular differ.
    torch.testing.assert_close(system.S, expected.S, rtol=1e-5, atol=1e-6 * float(expected.S.abs().max()))
    torch.testing.assert_close(system.gradient, expected.gradient, rtol=1e-5, atol=1e-6)


def test_the_globals_are_recovered(scene):
    made = scene(4000)
    start = replace(made.lobe, a=made.lobe.a * 0.99, n_s=13.5)
    found = solve_jointly(made.problem, made.truth, start, JointStop(tolerance=1e-9, max_iterations=60), speed=NEVER)
    assert found.cost < 1e-5
    torch.testing.assert_close(found.lobe.a, made.lobe.a, rtol=2e-3, atol=0)
    assert found.lobe.n_s == pytest.approx(14.0, rel=5e-3)


def test_the_cost_falls_and_does_not_depend_on_the_block(scene):
    made = scene(1000, sigma=0.01)
    start = replace(made.lobe, n_s=13.0)
    a = solve_jointly(made.problem, made.truth, start, speed=NEVER)
    b = solve_jointly(made.problem, made.truth, start, speed=NEVER, block=256)
    assert all(later < earlier for earlier, later in zip(a.history, a.history[1:], strict=False))
    assert b.cost == pytest.approx(a.cost, rel=1e-6)
    assert a.information.diagonal().min() > 0
