"""Time and peak memory of the whole job against the number of pixels, pictures and processes, as a plot.

`python scripts/scaling.py [most=2.5e7] [lights=6,12,50] [processes=1,2] [rounds=3] [out=scaling.png]`

Wall and processor time of the slowest process; the plot has the latter, which other work on the machine disturbs less.
Every measurement is a process of its own (pinned to a core of its own), so that its peak memory is its own: what the
resident set rises above its size before the solve, which holds the pictures, s and the room for the results.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

WARM_PIXELS = 1 << 14
BYTES_OF_RESULTS = 4 * 4 + 4 + 1


def resident(field: str) -> int:
    """Bytes of VmRSS or VmHWM (its peak)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return int(line.split()[1]) * 1024
    raise RuntimeError(f"/proc/self/status has no {field}")


def measure(pixels: int, lights: int, begin: float) -> None:
    """In a process of its own: prints seconds and bytes a pixel as JSON."""
    import torch
    from benchmarks.problem import make_case

    from reflectsep.kernel.compiling import Speed
    from reflectsep.kernel.search import search_pixels

    torch.set_num_threads(1)
    mode = Speed(compile="always" if lights <= 12 else "never", cores=1)
    warm = make_case(WARM_PIXELS, lights=lights)
    search_pixels(warm.problem, warm.lobe, speed=mode)
    case = make_case(pixels, lights=lights)
    problem, lobe = case.problem, case.lobe
    del case, warm
    time.sleep(max(0.0, begin - time.time()))
    Path("/proc/self/clear_refs").write_text("5")
    before, began, busy = resident("VmRSS"), time.perf_counter(), time.process_time()
    found = search_pixels(problem, lobe, speed=mode)
    took, busy = time.perf_counter() - began, time.process_time() - busy
    rise = resident("VmHWM") - before - BYTES_OF_RESULTS * pixels
    figures = {"seconds": took, "processor_seconds": busy, "bytes_a_pixel": rise / pixels}
    print(json.dumps({**figures, "cost": float(found.cost.mean())}))


def run(pixels: int, lights: int, processes: int) -> dict[str, float]:
    """`processes` at once, the pixels shared out; time is the slowest one's."""
    share, begin = pixels // processes, time.time() + 40.0 + 4e-6 * pixels * lights / 6
    children = []
    for core in range(processes):
        command = [sys.executable, __file__, f"child={share},{lights},{begin if processes > 1 else 0.0}"]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        command = ["taskset", "-c", str(core), *command]
        children.append(subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True))
    texts = [child.communicate()[0] for child in children]
    if any(child.returncode for child in children):
        raise SystemExit(f"{pixels} pixels, {lights} lights: a measurement failed (too little memory?)")
    found = [json.loads(text.splitlines()[-1]) for text in texts]
    return {key: max(f[key] for f in found) for key in ("seconds", "processor_seconds", "bytes_a_pixel")}


def plot(rows: list[dict[str, float]], path: str) -> None:
    """Microseconds and bytes a pixel over the number of pixels."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), constrained_layout=True)
    for lights, processes in sorted({(r["lights"], r["processes"]) for r in rows}):
        line = [r for r in rows if (r["lights"], r["processes"]) == (lights, processes)]
        label, style = f"n = {lights}, {processes} process{'es' * (processes > 1)}", "-o" if processes == 1 else "--s"
        N = [r["pixels"] for r in line]
        axes[0].loglog(N, [1e6 * r["processor_seconds"] / r["pixels"] for r in line], style, label=label)
        axes[1].semilogx(N, [r["bytes_a_pixel"] for r in line], style, label=label)
    axes[0].set(
        xlabel="pixels", ylabel="processor time of the slowest process, us a pixel", title="search over B and polish"
    )
    axes[1].set(xlabel="pixels", ylabel="bytes a pixel beyond inputs and outputs", ylim=(-20, 400))
    axes[1].axhline(150, color="grey", lw=0.8)
    axes[0].legend(fontsize=8)
    figure.savefig(path, dpi=90)


def main(arguments: list[str]) -> int:
    """Measure everything, write the plot and the figures beside it."""
    given = dict(argument.split("=", 1) for argument in arguments)
    if "child" in given:
        pixels, lights, begin = given["child"].split(",")
        measure(int(pixels), int(lights), float(begin))
        return 0
    unknown = given.keys() - {"most", "lights", "processes", "rounds", "out"}
    if unknown:
        print(f"unknown: {', '.join(sorted(unknown))}; known: most, lights, processes, rounds, out", file=sys.stderr)
        return 2
    most, out = int(float(given.get("most", "2.5e7"))), given.get("out", "scaling.png")
    rounds, rows = int(given.get("rounds", "3")), []
    for lights in map(int, given.get("lights", "6,12,50").split(",")):
        for pixels in (10**4, 10**5, 10**6, 4 * 10**6, 25 * 10**6):
            if pixels * lights > most * 6 or pixels > most:
                continue
            for processes in map(int, given.get("processes", "1,2").split(",")):
                found = [run(pixels, lights, processes) for _ in range(rounds)]
                row = {key: statistics.median(f[key] for f in found) for key in found[0]}
                rows.append({"lights": lights, "pixels": pixels, "processes": processes, **row})
                print(json.dumps(rows[-1]), flush=True)
    plot(rows, out)
    Path(out).with_suffix(".json").write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
