"""What a finished fit says of itself."""

import math

import pytest

from reflectsep.fit.outcome import at_its_limit
from reflectsep.fit.problem import LEAST_LOG_N_S, MOST_LOG_N_S
from reflectsep.report.advice import GENERAL, what_to_do


@pytest.mark.parametrize(
    ("log_n_s", "words"),
    [
        (MOST_LOG_N_S + 0.0005, "n_s ended at 200, the sharpest lobe"),
        (LEAST_LOG_N_S - 0.0005, "n_s ended at 4, the broadest lobe"),
    ],
)
def test_an_exponent_that_its_bound_has_stopped_is_a_warning_with_advice(log_n_s, words):
    (said,) = at_its_limit(log_n_s)
    assert words in said
    assert what_to_do(said) != GENERAL


@pytest.mark.parametrize("n_s", [5.0, 14.0, 150.0])
def test_an_exponent_between_its_bounds_is_none(n_s):
    assert at_its_limit(math.log(n_s)) == []
