from __future__ import annotations

import pytest
import torch

from reflectsep.kernel import compiling, search
from reflectsep.kernel.compiling import Speed
from reflectsep.kernel.local import solve_pixels
from reflectsep.kernel.search import Scan, cubic_minimum, hermite, scan_pixels, search_pixels


def test_without_noise_nearly_every_pixel_finds_its_truth(scene):
    made = scene(3000)
    found = search_pixels(made.problem, made.lobe)
    assert float((found.cost < 1e-9).double().mean()) > 0.98


@pytest.mark.parametrize("form", [{}, {"n_d": 0.8}, {"extras": True}])
def test_it_finds_what_a_start_at_the_truth_finds(scene, form):
    made = scene(2000, sigma=0.005, **form)
    best = solve_pixels(made.problem, made.truth, made.lobe).cost
    found = search_pixels(made.problem, made.lobe)
    assert float((found.cost <= 1.001 * best).double().mean()) > 0.95


def test_the_basis_pictures_are_met_at_every_minimum(scene):
    made = scene(500, sigma=0.002)
    minima = scan_pixels(made.problem, made.lobe, Scan(offsets=tuple(torch.linspace(-1.2, 1.6, 200).tolist())))
    best = minima[0]
    d, B = best[2:], best[1].exp()
    u = made.lobe.a[:, None] + B * d
    model = (d + made.problem.s).clamp_min(0.0) + u.clamp_min(0.0) ** made.lobe.n_s
    assert float((model - made.problem.images[:3]).abs().quantile(0.99)) < 1e-3
    assert bool((minima[0, 0] <= minima[1, 0]).all())
    assert bool((minima[1, 0] <= minima[2, 0]).all())


def test_more_minima_never_cost_more(scene):
    made = scene(1000, sigma=0.01)
    costs = [search_pixels(made.problem, made.lobe, Scan(polish=k)).cost for k in (1, 2, 3)]
    assert bool((costs[1] <= costs[0]).all())
    assert bool((costs[2] <= costs[1]).all())


def test_pixels_at_once_make_no_difference(scene, monkeypatch):
    made = scene(600, sigma=0.01)
    whole = search_pixels(made.problem, made.lobe)
    monkeypatch.setattr(search, "AT_ONCE", 250)
    parts = search_pixels(made.problem, made.lobe)
    assert torch.equal(parts.local, whole.local)
    assert parts.iterations == whole.iterations


def test_cores_make_no_difference(scene, monkeypatch):
    monkeypatch.setattr(compiling, "LEAST_PART", 64)
    made = scene(900, sigma=0.01)
    one = search_pixels(made.problem, made.lobe, speed=Speed(cores=1))
    monkeypatch.setattr(search, "AT_ONCE", 300)
    three = search_pixels(made.problem, made.lobe, speed=Speed(cores=3))
    assert torch.equal(one.local, three.local)
    assert torch.equal(one.cost, three.cost)
    assert torch.equal(one.status, three.status)
    assert one.iterations == three.iterations


def test_small_parts_of_a_large_problem_are_compiled_like_the_whole(scene, monkeypatch):
    made, seen = scene(600, sigma=0.01), []
    monkeypatch.setattr(compiling, "WORTH_COMPILING", 500)
    monkeypatch.setattr(compiling, "LEAST_PART", 64)
    monkeypatch.setattr(compiling, "has_compiler", lambda: True)
    monkeypatch.setattr(search, "AT_ONCE", 100)

    def plain(function, form):
        seen.append(function.__name__)
        return lambda *tensors: function(*tensors, *form)

    monkeypatch.setattr(compiling, "compiled", plain)
    search_pixels(made.problem, made.lobe, speed=Speed(cores=1))
    assert len(seen) == 3 * len(Speed(cores=1).parts(600, 100))


def test_the_cubic_and_its_minimum():
    t = torch.linspace(0, 1, 1001, dtype=torch.float64)
    cubic = lambda x: 2.0 + (x - 0.3) ** 2 * (1.0 + 0.5 * x)  # noqa: E731
    slope = lambda x: 2.0 * (x - 0.3) * (1.0 + 0.5 * x) + 0.5 * (x - 0.3) ** 2  # noqa: E731
    ends = [torch.tensor(v, dtype=torch.float64) for v in (cubic(0), slope(0), cubic(1), slope(1))]
    torch.testing.assert_close(hermite(t, *ends), cubic(t))
    at, value = cubic_minimum(*ends)
    assert float(at) == pytest.approx(0.3)
    assert float(value) == pytest.approx(2.0)
