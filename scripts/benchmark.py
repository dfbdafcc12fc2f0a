"""How fast the fit's solver is, side by side with the same work in C++ and with a polynomial, in one interleaved run.

`python scripts/benchmark.py [size=160] [rounds=5] [out=benchmark.json]`

Solved are all pixels of a simulated wax, in grey and in colour, under the globals of its fit, with what the neighbours
say of every pixel, from where the fit starts: by `reflectsep.solve.levenberg` in the fit's chunks, and by
`scripts/benchmarks/yardstick.cpp`, the same algorithm written by hand for this model alone. Beside them stands a
polynomial texture map of the same pictures, which is what one would otherwise relight with. Every round runs everyone
once, in turn; a ratio is the median over rounds of the time over the C++'s in the same round, so that what else the
machine does hits both. Time is the processor's, on one thread. Costs are those of the fit's own residuals.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from benchmarks import yardstick
from benchmarks.problem import Case, cost_of, make_case, polynomials, solve
from torch import Tensor

SAME = 1e-4
"""Relative difference of two costs that are the same."""


def timed(work: Callable[[], object]) -> float:
    """Processor seconds."""
    began = time.process_time()
    work()
    return time.process_time() - began


def interleaved(works: dict[str, Callable[[], object]], rounds: int) -> dict[str, list[float]]:
    """`rounds` in which everyone runs once, after one to warm up."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for number in range(rounds + 1):
        for name, work in works.items():
            took = timed(work)
            if number:
                times[name].append(took)
    return times


def agreement(ours: Tensor, theirs: Tensor) -> dict[str, float]:
    """Shares of the pixels at which both end at the same cost, and at which either ends lower."""
    least = torch.minimum(ours, theirs)
    return {
        "same": float(((ours - theirs).abs() <= SAME * least).double().mean()),
        "ours_lower": float((ours < theirs - SAME * least).double().mean()),
        "theirs_lower": float((theirs < ours - SAME * least).double().mean()),
    }


def measured(case: Case, rounds: int) -> dict[str, Any]:
    """Times of everyone, and whether they found the same."""
    found = agreement(cost_of(case, solve(case).local), cost_of(case, yardstick.solve(case)[0]))
    works = {
        "C++": lambda: yardstick.solve(case),
        "reflectsep": lambda: solve(case),
        "polynomial": lambda: polynomials(case),
    }
    times = interleaved(works, rounds)
    pixels = len(case.problem)
    rows = {
        name: {
            "us_per_pixel": 1e6 * statistics.median(own) / pixels,
            "times_cpp": statistics.median(a / b for a, b in zip(own, times["C++"], strict=True)),
        }
        for name, own in times.items()
    }
    return {"pixels": pixels, "unknowns": len(case.start), "solvers": rows, "costs": found}


def main(arguments: list[str]) -> int:
    """Measure in grey and in colour, and print a table."""
    given = dict(argument.split("=", 1) for argument in arguments)
    unknown = given.keys() - {"size", "rounds", "out"}
    if unknown:
        print(f"unknown: {', '.join(sorted(unknown))}; known: size, rounds, out", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    size, rounds = int(given.get("size", "160")), int(given.get("rounds", "5"))
    tables: dict[str, Any] = {}
    print("| | pixels | unknowns | solver | us a pixel | x C++ |\n|---|---|---|---|---|---|")
    try:
        for name, channels in (("grey", 1), ("colour", 3)):
            tables[name] = measured(make_case(size, 1 if channels == 1 else 3), rounds)
            for solver, row in tables[name]["solvers"].items():
                lead = f"| {name} | {tables[name]['pixels']} | {tables[name]['unknowns']} | {solver}"
                print(f"{lead} | {row['us_per_pixel']:.3g} | {row['times_cpp']:.3g} |", flush=True)
    except yardstick.NotInstalled as error:
        print(f"benchmark: {error}", file=sys.stderr)
        return 1
    for name, table in tables.items():
        same, ours, theirs = (100 * table["costs"][key] for key in ("same", "ours_lower", "theirs_lower"))
        print(
            f"{name}: the same cost within {SAME:g} on {same:.2f} % of the pixels; "
            f"ours lower on {ours:.2f} %, the C++'s on {theirs:.2f} %"
        )
    if "out" in given:
        Path(given["out"]).write_text(json.dumps(tables, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
