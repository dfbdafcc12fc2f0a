"""What neighbours say of each other: small algebra, pooling, and messages without what came from outside."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from reflectsep.fit.neighbours import (
    SPREADS,
    WIDTHS_PX,
    Messages,
    Smoothness,
    best_smoothness,
    inverse,
    likelihood,
    messages,
    neighbours,
    plus_spread,
    pooled,
    symmetric_times,
    upper_root,
)
from reflectsep.fit.problem import UPPER, Neighbours, globals_of, log_size
from reflectsep.model import mixed, reflectance
from reflectsep.solve.levenberg import Termination, solve_blocks


def full(S):
    """(pixels, 3, 3) of an upper triangle (6, pixels)."""
    whole = S.new_zeros(S.shape[1], 3, 3)
    for entry, (i, j) in zip(S, UPPER, strict=True):
        whole[:, i, j] = whole[:, j, i] = entry
    return whole


def packed(whole):
    return torch.stack([whole[:, i, j] for i, j in UPPER])


def covariances(pixels=30, size=1.0):
    g = torch.Generator().manual_seed(1)
    root = torch.randn(pixels, 3, 4, generator=g, dtype=torch.float64)
    return packed(size * root @ root.mT)


def vectors(pixels=30):
    return torch.rand(3, pixels, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


def test_the_algebra_of_upper_triangles_is_that_of_linalg():
    S, v = covariances(), vectors()
    torch.testing.assert_close(full(inverse(S)), torch.linalg.inv(full(S)), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(symmetric_times(S, v).mT[..., None], full(S) @ v.mT[..., None])
    torch.testing.assert_close(full(plus_spread(S, 0.3)), full(S) + 0.09 * torch.eye(3, dtype=torch.float64))
    R = upper_root(S)
    upper = full(R).triu()
    torch.testing.assert_close(upper, torch.linalg.cholesky(full(S)).mT, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(Neighbours(vector=v, R=R).precision().movedim(-1, 0), full(S))


def test_roots_and_inverses_of_nothing_are_finite():
    nothing = torch.zeros(6, 2, dtype=torch.float64)
    assert upper_root(nothing).isfinite().all()
    assert inverse(nothing).isfinite().all()


def disc(size=15):
    row, column = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    return (row - size // 2) ** 2 + (column - size // 2) ** 2 < (0.48 * size) ** 2


SURE, BLANK = (torch.tensor([s, 0, 0, s, 0, s], dtype=torch.float64)[:, None] for s in (1e-6, 1e6))


@pytest.mark.parametrize("width_px", WIDTHS_PX)
def test_a_constant_field_is_its_own_neighbourhood(width_px):
    mask = disc()
    pixels = int(mask.sum())
    value = torch.tensor([0.3, 0.7, 0.5], dtype=torch.float64)[:, None].expand(3, pixels)
    said = Messages(value, SURE.expand(6, pixels))
    mean, covariance = pooled(said, mask, width_px, 0.05)
    torch.testing.assert_close(mean, value, rtol=1e-4, atol=0)
    # A pixel is within the spread of its neighbours, and the sum of many neighbours is known better than one of them.
    assert (covariance[[0, 3, 5]] > 0.05**2).all()
    assert (covariance[[0, 3, 5]] < 2 * 0.05**2).all()


def test_a_pixel_does_not_hear_itself():
    mask = disc()
    pixels = int(mask.sum())
    value = torch.full((3, pixels), 0.5, dtype=torch.float64)
    centre = pixels // 2
    value[:, centre] = 2.0
    mean, _ = pooled(Messages(value, SURE.expand(6, pixels)), mask, 1.5, 0.05)
    torch.testing.assert_close(mean[:, centre], torch.full((3,), 0.5, dtype=torch.float64), rtol=1e-4, atol=0)
    assert (mean[:, centre + 1] > 0.55).all()


def test_a_pixel_that_knows_nothing_gets_its_neighbours_mean_and_tells_them_nothing():
    mask = disc()
    pixels = int(mask.sum())
    value = vectors(pixels)
    covariance = SURE.expand(6, pixels).clone()
    centre = pixels // 2
    value[:, centre], covariance[:, centre] = 100.0, BLANK[:, 0]
    mean, _ = pooled(Messages(value, covariance), mask, 1.0, 0.05)
    place = torch.full(mask.shape, -1)
    place[mask] = torch.arange(pixels)
    row, column = (int(x) for x in (place == centre).nonzero()[0])
    total, weight = torch.zeros(3, dtype=torch.float64), 0.0
    for y in range(row - 3, row + 4):
        for x in range(column - 3, column + 4):
            if (y, x) != (row, column) and 0 <= y < 15 and 0 <= x < 15 and mask[y, x]:
                k = float(torch.exp(torch.tensor(-0.5 * ((y - row) ** 2 + (x - column) ** 2), dtype=torch.float64)))
                total += k * value[:, place[y, x]]
                weight += k
    torch.testing.assert_close(mean[:, centre], total / weight, rtol=1e-4, atol=1e-6)
    assert float(mean.max()) < 1.001


def test_a_pixel_alone_hears_nothing_that_counts():
    mask = torch.zeros(5, 5, dtype=torch.bool)
    mask[2, 2] = True
    mean, covariance = pooled(Messages(vectors(1), SURE.clone()), mask, 1.0, 0.05)
    assert mean.isfinite().all()
    assert (covariance[[0, 3, 5]] > 50).all()


def test_what_neighbours_say_is_a_mean_and_a_root_of_its_precision():
    mask = disc()
    pixels = int(mask.sum())
    said = Messages(vectors(pixels), covariances(pixels, 1e-3))
    near = neighbours(said, mask, Smoothness(1.5, 0.03))
    mean, covariance = pooled(said, mask, 1.5, 0.03)
    torch.testing.assert_close(near.vector, mean)
    torch.testing.assert_close(near.precision().movedim(-1, 0), torch.linalg.inv(full(covariance)))


def test_the_likelihood_is_that_of_a_normal_distribution():
    # Scaled so that no distance is an outlier's.
    said = Messages(vectors(), plus_spread(covariances(size=0.1), 1.0))
    mean, covariance = vectors().flip(1), plus_spread(covariances(size=0.2).flip(1), 1.0)
    normal = torch.distributions.MultivariateNormal(mean.mT, full(covariance) + full(said.covariance))
    expected = normal.log_prob(said.mean.mT) + 1.5 * torch.log(torch.tensor(2 * torch.pi, dtype=torch.float64))
    distance = -2 * (expected + 0.5 * torch.logdet(normal.covariance_matrix))
    assert 0.1 < float(distance.max()) < 25
    assert likelihood(said, mean, covariance) == pytest.approx(float(expected.mean()), rel=1e-9)


@pytest.mark.parametrize("spread", SPREADS)
def test_the_smoothness_of_a_rough_field_is_found(spread):
    mask = torch.ones(40, 40, dtype=torch.bool)
    g = torch.Generator().manual_seed(4)
    value = 0.5 + spread * torch.randn(3, 1600, generator=g, dtype=torch.float64)
    found = best_smoothness(Messages(value, SURE.expand(6, 1600)), mask)
    assert found.spread == spread
    assert found.width_px == max(WIDTHS_PX)  # noise about a constant: the more neighbours, the better


def settled(random_problem, **changes):
    """A problem whose pictures its model nearly explains, and its optimum under the pictures alone."""
    problem, local, shared = random_problem(channels=3, pixels=30, sigma=1e-3, huber=None, neighbours=None, **changes)
    obs = problem.obs
    s = obs.s[:3]
    obs = replace(obs, s=mixed(obs.alpha, s), clipped=torch.zeros_like(obs.clipped))
    d, B = problem.unpacked(local)
    g = torch.Generator().manual_seed(3)
    noise = 1e-3 * torch.randn(obs.images.shape, generator=g, dtype=torch.float64)
    images = reflectance(d, B, globals_of(shared, obs), s=s, alpha=obs.alpha) + noise
    problem = replace(problem, obs=replace(obs, images=images))
    found = solve_blocks(problem, local, shared, Termination(tolerance=1e-14, max_iterations=200))
    return problem, found.local, shared


def test_messages_tell_the_vector_and_its_covariance(random_problem):
    problem, local, shared = settled(random_problem)
    said = messages(problem, local, shared)

    def vector(local):
        d, B = problem.unpacked(local)
        f = globals_of(shared, problem.obs).f
        return B * (d + (1 - f) * problem.obs.s[:3]).mean(1) / (2 * log_size(shared, problem.obs).exp())

    torch.testing.assert_close(said.mean, vector(local))
    J = torch.stack(
        [torch.func.jvp(vector, (local,), (e[:, None].expand_as(local),))[1] for e in torch.eye(10).double()], 1
    )
    V = problem.normal(local, shared).V
    V = torch.tril(V.movedim(-1, 0)) + torch.tril(V.movedim(-1, 0), -1).mT
    expected = J.movedim(-1, 0) @ torch.linalg.solve(V, J.movedim(-1, 0).mT)
    sure = torch.linalg.cond(V) < 1e7
    assert int(sure.sum()) > 10
    torch.testing.assert_close(full(said.covariance)[sure], expected[sure], rtol=1e-2, atol=1e-12)


def test_messages_do_not_hand_back_what_the_neighbours_said(random_problem):
    problem, local, shared = settled(random_problem)
    alone = messages(problem, local, shared)
    known = (alone.covariance[[0, 3, 5]] < 1e-3).all(0)
    assert int(known.sum()) >= 8
    # Expected a tenth of a standard deviation off, and as surely: everything near the optimum is linear.
    sd = alone.covariance[[0, 3, 5]].sqrt()
    near = Neighbours(vector=alone.mean + 0.1 * sd, R=upper_root(inverse(plus_spread(alone.covariance, 1e-4))))
    pulled = replace(problem, neighbours=near)
    there = solve_blocks(pulled, local, shared, Termination(tolerance=1e-14, max_iterations=200)).local
    said = messages(pulled, there, shared)
    held = messages(replace(problem, neighbours=None), there, shared)
    off = lambda m: ((m.mean - alone.mean).abs() / sd)[:, known]  # noqa: E731
    assert float(off(held).median()) > 0.02  # the pixels did move
    assert float(off(said).median()) < 0.25 * float(off(held).median())
    ratio = (said.covariance / alone.covariance)[[0, 3, 5]][:, known]
    assert float((ratio.log().abs()).median()) < 0.05
