"""What several processes gain: a whole fit by one process and by several, as `torchrun` would start them.

    python scripts/shared_speed.py capture=captures/wax out=shared [processes=1,2]

Printed are the seconds of every process by its own clock (processor time) and by the wall, and whether the results are
the same to the bit. The gain is that of the slower process: waiting takes no processor time, so that other programs on
the machine do not count, as far as they leave its caches alone. No report is written, and drift is looked for.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from pathlib import Path


def main(words: list[str]) -> int:
    """Fit with every number of processes, and print a line each."""
    given = dict(word.split("=", 1) for word in words)
    wrong = sorted(given.keys() - {"capture", "out", "processes"})
    if wrong or not {"capture", "out"} <= given.keys():
        print(f"capture and out are needed; unknown: {', '.join(wrong) or 'none'}", file=sys.stderr)
        return 2
    alone, sums = 0.0, None
    for count in (int(number) for number in given.get("processes", "1,2").split(",")):
        out = Path(given["out"]) / f"by_{count}"
        wall_s, each_s = timed(given["capture"], out, count)
        slowest = max(each_s)
        alone = alone or slowest
        found = {path.name: path.read_bytes() for path in sorted(out.glob("*.exr"))}
        sums = sums or found
        same = "the same result" if found == sums else "ANOTHER RESULT"
        listed = ", ".join(f"{seconds:.1f}" for seconds in each_s)
        print(f"{count} processes: {listed} s each, {wall_s:.1f} s by the wall; gain {alone / slowest:.2f}; {same}")
        sys.stdout.flush()
    return 0


def timed(capture: str, out: Path, count: int) -> tuple[float, list[float]]:
    """Wall time of a fit by `count` processes, and processor time of each."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = [sys.executable, "-m", "reflectsep", "fit", f"capture={capture}", f"out={out}", "report=false"]
    base = os.environ | {"OMP_NUM_THREADS": "1", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    started = time.perf_counter()
    running = [
        subprocess.Popen([*words, "overwrite=true"], env=base | {"RANK": str(rank), "WORLD_SIZE": str(count)})
        for rank in range(count)
    ]
    seconds = []
    for process in running:
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SystemExit(f"a process ended with {process.returncode}")
        seconds.append(used.ru_utime + used.ru_stime)
    return time.perf_counter() - started, seconds


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
