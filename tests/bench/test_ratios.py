"""Regression guard: the solver's time over that of the same work in C++, against a stored ratio. `pytest tests/bench`.

Ratios of processor time in one interleaved run, so that neither the machine's speed nor its other work counts.
`REFLECTSEP_BASELINE=write pytest tests/bench` stores this machine's ratios instead.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
from pathlib import Path

import pytest
import torch

SCRIPTS = Path(__file__).parents[2] / "scripts"
sys.path.insert(0, str(SCRIPTS))

from benchmark import agreement, interleaved  # noqa: E402
from benchmarks import yardstick  # noqa: E402
from benchmarks.problem import cost_of, make_case, solve  # noqa: E402

BASELINE = Path(__file__).with_name("baseline.json")
SLOWER = 1.3
"""A ratio this many times the stored one is a regression."""
ROUNDS, SIZE_PX = 7, 128
KINDS = {"grey": 1, "colour": 3}


@pytest.fixture(scope="module", params=KINDS)
def case(request):
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yardstick.solve(made := make_case(SIZE_PX, KINDS[request.param]))
    except yardstick.NotInstalled as error:
        pytest.skip(str(error))
    yield request.param, made
    torch.set_num_threads(threads)


def test_the_ratio_to_the_yardstick_is_not_worse_than_it_was(case):
    kind, made = case
    times = interleaved({"ours": lambda: solve(made), "C++": lambda: yardstick.solve(made)}, ROUNDS)
    found = statistics.median(a / b for a, b in zip(times["ours"], times["C++"], strict=True))
    stored = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    if os.environ.get("REFLECTSEP_BASELINE") == "write":
        BASELINE.write_text(json.dumps({**stored, kind: round(found, 1)}, indent=1, sort_keys=True) + "\n")
        stored[kind] = found
    assert found <= stored[kind] * SLOWER, f"{kind}: {found:.1f} times the yardstick, {stored[kind]} is stored"


def test_both_end_at_the_same_costs(case):
    _, made = case
    same = agreement(cost_of(made, solve(made).local), cost_of(made, yardstick.solve(made)[0]))
    assert same["same"] >= 0.98, same
