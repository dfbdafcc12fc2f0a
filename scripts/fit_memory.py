"""Memory and disk of a whole fit, stage by stage, with few iterations.

`python scripts/fit_memory.py capture=FOLDER out=FOLDER [as_megapixels=24] [registration=all] [report=true]`

What a fit holds does not depend on how long it iterates, so a fit whose iterations are cut down to a few shows what a
whole one takes. Memory is that which the system cannot get rid of otherwise (RssAnon, and shared memory); what is in
files it writes out and reads back, and that is given beside it. Tensors go into files from a size that is to this
capture as that of `reflectsep/room.py` is to one of `as_megapixels`. `registration=none` leaves drift alone. The result
is no separation to be used.
"""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path

SAMPLED_S = 0.01
MiB = 1 << 20


def resident() -> tuple[int, int]:
    """Bytes of memory that only a swap file could take, and bytes of the mapped nameless files."""
    kept = 0
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(("RssAnon", "RssShmem")):
            kept += int(line.split()[1]) * 1024
    files = 0
    for line in Path("/proc/self/maps").read_text().splitlines():
        if line.endswith("(deleted)") and "/dev/shm" not in line:
            first, last = (int(end, 16) for end in line.split(maxsplit=1)[0].split("-"))
            files += last - first
    return kept, files


class Watch:
    """A progress that keeps the peaks of every stage, as a thread of its own samples them."""

    def __init__(self) -> None:
        self.stage, self.ended = "before", False
        self.peaks: dict[str, tuple[int, int, float]] = {}
        self._thread = threading.Thread(target=self._sample, daemon=True)
        self._thread.start()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Another stage, or the same further on; the one that ended is told, for a run that is stopped."""
        before, self.stage = self.stage, stage if done < total else f"after {stage}"
        if self.stage != before and before in self.peaks:
            print(f"{before}: {self.peaks[before][0] / MiB:.0f} MiB", file=sys.stderr, flush=True)

    def stop(self) -> None:
        """No more samples."""
        self.ended = True
        self._thread.join()

    def _sample(self) -> None:
        last = time.perf_counter()
        while not self.ended:
            kept, files = resident()
            now = time.perf_counter()
            most, most_files, seconds = self.peaks.get(self.stage, (0, 0, 0.0))
            self.peaks[self.stage] = max(most, kept), max(most_files, files), seconds + now - last
            last = now
            time.sleep(SAMPLED_S)


def hasten() -> None:
    """A few iterations wherever a pixel or the globals have many."""
    from reflectsep.fit import reflectance

    reflectance.ROUNDS = 1


def main(words: list[str]) -> int:
    """Fit, and print a line a stage."""
    import torch

    from reflectsep import jobs, room
    from reflectsep.config import CalibrationSettings, FitJob, FitSettings
    from reflectsep.io.capture import load_capture
    from reflectsep.io.stack import read_mask

    given = dict(word.split("=", 1) for word in words)
    wrong = sorted(given.keys() - {"capture", "out", "as_megapixels", "registration", "report"})
    if wrong or not {"capture", "out"} <= given.keys():
        print(f"capture=FOLDER and out=FOLDER are needed; unknown: {', '.join(wrong) or 'none'}", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    capture = load_capture(given["capture"])
    height, width = read_mask(capture).shape
    share = height * width / (1e6 * float(given.get("as_megapixels", "24")))
    room.LEAST_BYTES = int(room.LEAST_BYTES * share)
    hasten()
    report = given.get("report", "true") == "true"
    job = FitJob(
        capture=given["capture"],
        out=given["out"],
        overwrite=True,
        baseline=False,
        report=report,
        calibration=CalibrationSettings(registration=given.get("registration", "all")),  # pyright: ignore[reportArgumentType]
        fit=FitSettings(max_iterations=3),
    )
    before, watch = resident()[0], Watch()
    try:
        print(jobs.run_fit(job, watch))
    finally:
        watch.stop()
        table(watch, before, height, width)
    return 0


def table(watch: Watch, before: int, height: int, width: int) -> None:
    """Print the peaks, a line a stage."""
    from reflectsep import room

    pixels = height * width
    print(f"{width} x {height}, files from {room.LEAST_BYTES / MiB:.1f} MiB; {before / MiB:.0f} MiB before it began")
    print(f"{'stage':32s} {'memory MiB':>10s} {'B a pixel':>10s} {'in files':>9s} {'B a pixel':>10s} {'s':>7s}")
    for stage, (kept, files, seconds) in watch.peaks.items():
        each = f"{(kept - before) / pixels:10.0f} {files / MiB:9.0f} {files / pixels:10.0f} {seconds:7.1f}"
        print(f"{stage:32s} {kept / MiB:10.0f} {each}")
    most = max(kept for kept, _, _ in watch.peaks.values())
    files = max(files for _, files, _ in watch.peaks.values())
    print(f"most: {most / MiB:.0f} MiB of memory, {files / MiB:.0f} MiB of files")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
