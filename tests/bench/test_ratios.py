"""Regression guard: our kernels' time over the C++ yardstick's, against a stored ratio. `pytest tests/bench`.

Ratios of processor time in one interleaved run, so that neither the machine's speed nor its other work counts.
`REFLECTSEP_BASELINE=write pytest tests/bench` stores this machine's ratios instead.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import time
from pathlib import Path

import pytest
import torch

SCRIPTS = Path(__file__).parents[2] / "scripts"
sys.path.insert(0, str(SCRIPTS))

from benchmarks import yardstick  # noqa: E402
from benchmarks.problem import FLOOR, ITERATIONS, TOLERANCE, WITHIN, make_case, true_cost  # noqa: E402

from reflectsep.kernel.compiling import Speed  # noqa: E402
from reflectsep.kernel.joint import Passes  # noqa: E402
from reflectsep.kernel.local import solve_pixels  # noqa: E402
from reflectsep.kernel.search import search_pixels  # noqa: E402
from reflectsep.kernel.step import Stop  # noqa: E402

BASELINE = Path(__file__).with_name("baseline.json")
SLOWER = 1.3
"""A ratio this many times the stored one is a regression."""
ROUNDS, PIXELS = 7, 200_000
STOP = Stop(tolerance=TOLERANCE, floor=FLOOR, max_iterations=ITERATIONS)


@pytest.fixture(scope="module")
def case():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yardstick.local_fit(made := make_case(PIXELS))
    except yardstick.NotInstalled as error:
        pytest.skip(str(error))
    yield made
    torch.set_num_threads(threads)


def timed(work):
    began = time.process_time()
    work()
    return time.process_time() - began


def paired(ours, theirs):
    """Median of the ratios of runs that follow each other."""
    ours(), theirs()
    return statistics.median(timed(ours) / timed(theirs) for _ in range(ROUNDS))


def one_pass(case, mode):
    passes = Passes(case.problem, case.lobe, Speed(compile=mode), 1 << 14)
    moved = case.lobe.moved(case.lobe.shared * 1.002)
    result = torch.empty_like(case.truth)
    return lambda: passes.run(case.truth, result, case.lobe, moved)


KINDS = {
    "local, compiled": (
        lambda c: lambda: solve_pixels(c.problem, c.start, c.lobe, STOP, speed=Speed(compile="always")),
        lambda c: lambda: yardstick.local_fit(c),
        3.0,
    ),
    "whole job, compiled": (
        lambda c: lambda: search_pixels(c.problem, c.lobe, speed=Speed(compile="always")),
        lambda c: lambda: yardstick.whole_fit(c),
        3.0,
    ),
    "joint pass, compiled": (
        lambda c: one_pass(c, "always"),
        lambda c: lambda: yardstick.joint_fit(c, c.truth, c.lobe, 1.0, 0),
        4.0,
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_the_ratio_to_the_yardstick_is_not_worse_than_it_was(case, kind):
    ours, theirs, goal = KINDS[kind]
    found = paired(ours(case), theirs(case))
    stored = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    if os.environ.get("REFLECTSEP_BASELINE") == "write":
        BASELINE.write_text(json.dumps({**stored, kind: round(found, 2)}, indent=1, sort_keys=True) + "\n")
        stored[kind] = found
    assert found <= stored[kind] * SLOWER, f"{kind}: {found:.2f} times the yardstick, {stored[kind]} is stored"
    assert found <= goal, f"{kind}: {found:.2f} times the yardstick, the goal is {goal}"


def test_the_whole_job_reaches_the_best_cost_on_99_of_100_pixels(case):
    found = true_cost(case, search_pixels(case.problem, case.lobe, speed=Speed(compile="always")).local)
    best = torch.minimum(found, true_cost(case, yardstick.whole_fit(case)))
    for start in (case.truth, case.start):
        other = solve_pixels(case.problem, start, case.lobe, STOP, speed=Speed(compile="always"))
        best = torch.minimum(best, true_cost(case, other.local))
    assert float((found <= best * (1.0 + WITHIN) + 1e-10).double().mean()) >= 0.99
