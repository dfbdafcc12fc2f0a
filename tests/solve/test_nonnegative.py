import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import nnls

from reflectsep.solve.nonnegative import nonnegative_least_squares


def problems(seed, unknowns, values, likeness=0.0, dtype=torch.float64):
    """Random columns, more or less alike."""
    g = torch.Generator().manual_seed(seed)
    columns = torch.randn(2 * unknowns, unknowns, values, generator=g, dtype=torch.float64)
    columns = likeness * columns[:, :1] + (1 - likeness) * columns
    y = torch.randn(2 * unknowns, values, generator=g, dtype=torch.float64)
    normal, right = torch.einsum("fip,fjp->ijp", columns, columns), torch.einsum("fip,fp->ip", columns, y)
    return columns, y, normal.to(dtype), right.to(dtype)


@given(seed=st.integers(0, 10**6), unknowns=st.integers(1, 9), likeness=st.sampled_from([0.0, 0.8]))
def test_as_scipy_one_problem_at_a_time(seed, unknowns, likeness):
    columns, y, normal, right = problems(seed, unknowns, 5, likeness)
    x = nonnegative_least_squares(normal, right)
    for i in range(5):
        expected, _ = nnls(columns[..., i].numpy(), y[:, i].numpy())
        np.testing.assert_allclose(x[:, i].numpy(), expected, rtol=1e-6, atol=1e-7)


def test_optimal_in_single_precision_where_columns_are_nearly_alike():
    _, _, normal, right = problems(1, 9, 2000, 0.9)
    x = nonnegative_least_squares(normal.float(), right.float()).double()
    gradient = ((normal * x).sum(1) - right) / torch.diagonal(normal).T.sqrt() / right.abs().amax(0)
    assert bool((x >= 0).all())
    assert float(gradient.min()) > -1e-4
    assert float((gradient * (x > 0)).abs().max()) < 1e-4


def test_a_solution_depends_on_no_other_problem():
    _, _, normal, right = problems(2, 7, 300, dtype=torch.float32)
    x = nonnegative_least_squares(normal, right)
    for cut in (slice(0, 1), slice(17, 90), slice(299, 300)):
        assert torch.equal(nonnegative_least_squares(normal[..., cut], right[:, cut]), x[:, cut])


def test_units_do_not_matter():
    _, _, normal, right = problems(3, 6, 100)
    units = torch.logspace(-6, 6, 6, dtype=torch.float64)[:, None]
    scaled = nonnegative_least_squares(normal * units[:, None] * units, right * units * 1e-9)
    torch.testing.assert_close(scaled * units * 1e9, nonnegative_least_squares(normal, right), rtol=1e-9, atol=1e-12)
