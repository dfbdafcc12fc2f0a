"""How fast the pixel kernels are, side by side with the yardstick and other solvers, in one interleaved run.

`python scripts/benchmark.py [pixels=100000] [rounds=5] [sigma=0.005] [out=benchmark.json]`

Every round runs everyone once, in turn; a ratio is the median over rounds of a solver's time over the yardstick's in
the same round, so that what else the machine does hits both. Pin it (`taskset -c 1`) for figures of one core. Success
is a cost within 0.1 % of the best that any solver or start reaches on the pixel; costs are taken in double precision.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from benchmarks import competitors, yardstick
from benchmarks.problem import FLOOR, ITERATIONS, TOLERANCE, WITHIN, Case, make_case, true_cost
from torch import Tensor

from reflectsep.kernel.compiling import Speed
from reflectsep.kernel.joint import JointStop, solve_jointly
from reflectsep.kernel.local import solve_pixels
from reflectsep.kernel.problem import Lobe
from reflectsep.kernel.search import search_pixels
from reflectsep.kernel.step import Stop

STOP = Stop(tolerance=TOLERANCE, floor=FLOOR, max_iterations=ITERATIONS)
JOINT_STOP = JointStop(tolerance=1e-6, max_iterations=40)


@dataclass
class Entry:
    """One line of the table."""

    name: str
    pixels: int
    run: Callable[[], Any]
    times: list[float]
    result: Any = None
    missing: str = ""


def ours(case: Case, mode: str) -> Tensor:
    """The kernel from the case's start."""
    return solve_pixels(case.problem, case.start, case.lobe, STOP, speed=Speed(compile=mode)).local  # type: ignore[arg-type]


def ours_whole(case: Case, mode: str) -> Tensor:
    """Search and polish."""
    return search_pixels(case.problem, case.lobe, speed=Speed(compile=mode)).local  # type: ignore[arg-type]


def ours_joint(case: Case, local: Tensor, lobe: Lobe, mode: str) -> tuple[Tensor, Lobe, int]:
    """Pixels and globals."""
    found = solve_jointly(case.problem, local, lobe, JOINT_STOP, speed=Speed(compile=mode))  # type: ignore[arg-type]
    return found.local, found.lobe, len(found.history)


def interleaved(entries: list[Entry], rounds: int) -> None:
    """A round to warm up, then `rounds` in which everyone runs once."""
    for number in range(rounds + 1):
        for entry in entries:
            if entry.missing:
                continue
            began = time.process_time()
            try:
                entry.result = entry.run()
            except yardstick.NotInstalled as error:
                entry.missing = f"not installed: {error}"
                continue
            if number:
                entry.times.append((time.process_time() - began) / entry.pixels * 1e6)


def ratio(entry: Entry, against: Entry) -> float:
    """Median of the paired ratios."""
    return statistics.median(a / b for a, b in zip(entry.times, against.times, strict=True))


def line(entry: Entry, against: Entry, costs: str) -> dict[str, Any]:
    """A row of the table."""
    if entry.missing:
        return {"solver": entry.name, "note": entry.missing}
    return {
        "solver": entry.name,
        "pixels": entry.pixels,
        "us_per_pixel": statistics.median(entry.times),
        "times_cpp": ratio(entry, against),
        "note": costs,
    }


def show(title: str, rows: list[dict[str, Any]]) -> None:
    """A Markdown table."""
    print(f"\n### {title}\n\n| solver | pixels | us a pixel | x C++ | success, mean cost |\n|---|---|---|---|---|")
    for row in rows:
        if "pixels" not in row:
            print(f"| {row['solver']} | | | | {row['note']} |")
            continue
        figures = f"{row['pixels']} | {row['us_per_pixel']:.3g} | {row['times_cpp']:.3g}"
        print(f"| {row['solver']} | {figures} | {row['note']} |", flush=True)


def success(case: Case, local: Tensor, best: Tensor) -> str:
    """Share of pixels at the best cost, and the mean cost where it is below the median's tenfold."""
    cost = true_cost(case.head(local.shape[1]), local)
    target = best[: len(cost)]
    share = float((cost <= target * (1.0 + WITHIN) + 1e-10).double().mean())
    return f"{100 * share:.2f} %, {float(cost.mean()):.3g}"


def local_table(case: Case, rounds: int, best: Tensor) -> tuple[list[dict[str, Any]], list[Tensor]]:
    """LM from a given start."""
    few = {name: case.head(min(count, len(case.problem))) for name, count in SAMPLES.items()}
    entries = [
        Entry("C++ yardstick", len(case.problem), lambda: yardstick.local_fit(case), []),
        Entry("reflectsep, compiled", len(case.problem), lambda: ours(case, "always"), []),
        Entry("reflectsep, eager", len(case.problem), lambda: ours(case, "never"), []),
    ]
    for name, function in COMPETITORS.items():
        part = few[name]
        entries.append(Entry(name, len(part.problem), lambda f=function, p=part: f(p), []))
    interleaved(entries, rounds)
    found = [entry.result for entry in entries if entry.result is not None]
    for local in found:
        cost = true_cost(case.head(local.shape[1]), local)
        best[: len(cost)] = torch.minimum(best[: len(cost)], cost)
    return [
        line(entry, entries[0], "" if entry.result is None else success(case, entry.result, best)) for entry in entries
    ], found


def whole_table(case: Case, rounds: int, best: Tensor) -> list[dict[str, Any]]:
    """Search over B and polish."""
    entries = [
        Entry("C++ yardstick", len(case.problem), lambda: yardstick.whole_fit(case), []),
        Entry("reflectsep, compiled", len(case.problem), lambda: ours_whole(case, "always"), []),
        Entry("reflectsep, eager", len(case.problem), lambda: ours_whole(case, "never"), []),
    ]
    interleaved(entries, rounds)
    for entry in entries:
        torch.minimum(best, true_cost(case, entry.result), out=best)
    return [line(entry, entries[0], success(case, entry.result, best)) for entry in entries]


def joint_table(case: Case, rounds: int) -> list[dict[str, Any]]:
    """Pixels and four globals, from the whole job's result at globals that are 2 to 4 % off."""
    lobe = replace(case.lobe, a=case.lobe.a * 1.02, n_s=case.lobe.n_s * 0.96)
    local = search_pixels(case.problem, lobe, speed=Speed(compile="always")).local
    part = case.head(min(SAMPLES["Ceres"], len(case.problem)))
    few = local[:, : len(part.problem)].contiguous()
    stop = (JOINT_STOP.tolerance, JOINT_STOP.max_iterations)
    entries = [
        Entry("C++ yardstick", len(case.problem), lambda: yardstick.joint_fit(case, local, lobe, *stop), []),
        Entry("reflectsep, compiled", len(case.problem), lambda: ours_joint(case, local, lobe, "always"), []),
        Entry("reflectsep, eager", len(part.problem), lambda: ours_joint(part, few, lobe, "never"), []),
        Entry("Ceres, dense Schur", len(part.problem), lambda: competitors.ceres_joint(part, few, lobe, *stop), []),
        Entry("C++ yardstick on as few", len(part.problem), lambda: yardstick.joint_fit(part, few, lobe, *stop), []),
    ]
    interleaved(entries, rounds)
    rows = []
    for entry in entries:
        note = ""
        if entry.result is not None:
            places, found, passes = entry.result
            cost = true_cost(case.head(entry.pixels), places, found)
            each = statistics.median(entry.times) / passes
            note = f"mean cost {float(cost.mean()):.5g}, n_s {found.n_s:.3f}, {passes} passes of {each:.3g} us"
        rows.append(line(entry, entries[0], note))
    return rows


COMPETITORS = {
    "Theseus": competitors.theseus_lm,
    "Ceres": competitors.ceres_lm,
    "Ceres TinySolver": competitors.ceres_tiny,
    "numba": competitors.numba_lm,
    "scipy trf": competitors.scipy_trf,
}
SAMPLES = {"Theseus": 10_000, "Ceres": 5_000, "Ceres TinySolver": 20_000, "numba": 100_000, "scipy trf": 100}


def main(arguments: list[str]) -> int:
    """Run all tables and write them down."""
    given = dict(argument.split("=", 1) for argument in arguments)
    unknown = given.keys() - {"pixels", "rounds", "sigma", "out", "lights"}
    if unknown:
        print(f"unknown: {', '.join(sorted(unknown))}; known: pixels, rounds, sigma, lights, out", file=sys.stderr)
        return 2
    pixels, rounds = int(float(given.get("pixels", "1e5"))), int(given.get("rounds", "5"))
    torch.set_num_threads(1)
    case = make_case(pixels, lights=int(given.get("lights", "6")), sigma=float(given.get("sigma", "0.005")))
    from_truth = solve_pixels(case.problem, case.truth, case.lobe, STOP, speed=Speed(compile="always")).local
    best = true_cost(case, from_truth)
    whole = whole_table(case, rounds, best)
    local, _ = local_table(case, rounds, best)
    joint = joint_table(case, rounds)
    tables = {"LM from a given start": local, "whole job: search over B and polish": whole, "joint": joint}
    for title, rows in tables.items():
        show(title, rows)
    if "out" in given:
        Path(given["out"]).write_text(json.dumps(tables, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
