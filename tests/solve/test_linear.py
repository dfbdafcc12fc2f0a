"""Small systems of many pixels beside torch.linalg."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.solve.linear import factorise, log_determinant, solve


def matrices(size, pixels=9, seed=0, reach=1.0):
    """Symmetric positive matrices (size, size, pixels), entries over `reach` decades."""
    g = torch.Generator().manual_seed(seed)
    root = torch.randn(pixels, size, size + 2, generator=g, dtype=torch.float64)
    scale = 10.0 ** (reach * torch.rand(pixels, size, generator=g, dtype=torch.float64))
    root = root * scale[..., None]
    return (root @ root.mT).movedim(0, -1)


def right_sides(size, *columns, pixels=9):
    return torch.randn(size, *columns, pixels, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


@given(st.integers(1, 12), st.integers(0, 2**20), st.floats(0, 3))
def test_a_solution_is_that_of_linalg(size, seed, reach):
    V, b = matrices(size, seed=seed, reach=reach), right_sides(size)
    expected = torch.linalg.solve(V.movedim(-1, 0), b.mT[..., None])[..., 0].mT
    found = solve(factorise(V), b)
    # Relative to what the conditioning of a matrix leaves.
    condition = torch.linalg.cond(V.movedim(-1, 0))
    off = (found - expected).norm(dim=0) / expected.norm(dim=0)
    assert (off < 1e-13 * condition).all()


@pytest.mark.parametrize("size", [1, 4, 10])
def test_many_right_sides_are_each_alone(size):
    V, b = matrices(size), right_sides(size, 3)
    factor = factorise(V)
    together = solve(factor, b)
    for k in range(3):
        torch.testing.assert_close(together[:, k], solve(factor, b[:, k]), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(torch.einsum("ijn,jkn->ikn", V, together), b, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("size", [1, 4, 10])
def test_the_determinant_is_that_of_linalg(size):
    V = matrices(size)
    torch.testing.assert_close(log_determinant(factorise(V)), torch.logdet(V.movedim(-1, 0)), rtol=1e-9, atol=1e-9)


def test_damping_is_added_to_the_diagonal():
    V, b, damping = matrices(5), right_sides(5), torch.rand(5, 9, dtype=torch.float64)
    whole = V + torch.diag_embed(damping.mT).movedim(0, -1)
    torch.testing.assert_close(solve(factorise(V, damping), b), solve(factorise(whole), b))


def test_only_the_lower_triangle_is_read_and_nothing_is_written():
    V, b = matrices(5), right_sides(5)
    lower = torch.tril(V.movedim(-1, 0)).movedim(0, -1).contiguous()
    kept, b_kept = lower.clone(), b.clone()
    assert torch.equal(solve(factorise(lower, torch.ones(5, 9, dtype=torch.float64)), b).isfinite(), b.isfinite())
    torch.testing.assert_close(solve(factorise(lower), b), solve(factorise(V), b))
    assert torch.equal(lower, kept)
    assert torch.equal(b, b_kept)


def test_a_singular_matrix_has_a_finite_factor():
    v = right_sides(4)
    V = torch.einsum("in,jn->ijn", v, v)
    V[:, :, 0] = 0.0
    factor = factorise(V)
    assert (factor.inverse > 0).all()
    damped = factorise(V, torch.full((4, 9), 1e-6, dtype=torch.float64))
    assert solve(damped, v).isfinite().all()


def test_a_pixel_does_not_depend_on_the_others():
    V, b = matrices(6, pixels=40), right_sides(6, pixels=40)
    alone = solve(factorise(V[:, :, 7:9]), b[:, 7:9])
    torch.testing.assert_close(alone, solve(factorise(V), b)[:, 7:9], rtol=1e-9, atol=0)
