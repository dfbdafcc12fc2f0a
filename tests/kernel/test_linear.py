from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.kernel.linear import PACKED, factorise, scales, solve


def packed(V):
    return [V[:, i, j] for i in range(4) for j in range(i, 4)]


@given(st.integers(0, 10_000))
def test_it_is_the_dense_solution(seed):
    g = torch.Generator().manual_seed(seed)
    J = torch.randn(3, 6, 4, generator=g, dtype=torch.float64)
    b, damping = torch.randn(3, 4, generator=g, dtype=torch.float64), torch.rand(3, 4, generator=g, dtype=torch.float64)
    V = J.mT @ J
    x = solve(factorise(packed(V), damping.unbind(1)), b.unbind(1))
    dense = torch.linalg.solve(V + torch.diag_embed(damping), b)
    torch.testing.assert_close(torch.stack(x, 1), dense, rtol=1e-7, atol=1e-9)


def test_the_places_of_the_packed_triangle():
    V = torch.arange(16.0).reshape(1, 4, 4)
    V = V + V.mT
    maps = packed(V)
    assert all(torch.equal(maps[PACKED[i][j]], V[:, i, j]) for i in range(4) for j in range(4))


def test_an_unknown_that_nothing_feels_stays():
    J = torch.randn(5, 6, 4, generator=torch.Generator().manual_seed(1))
    J[:, :, 3] = 0.0
    V = packed(J.mT @ J)
    g = (J.mT @ torch.ones(5, 6, 1))[..., 0].unbind(1)
    x = solve(factorise(V, [1e-3 * s for s in scales(V)]), g)
    assert float(x[3].abs().max()) == 0.0
    assert all(v.isfinite().all() for v in x)
