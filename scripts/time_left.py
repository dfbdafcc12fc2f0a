"""How right a fit's stated time left is, while a real fit runs.

`python scripts/time_left.py [object=wax] [size=96] [folder=TEMPORARY]`

Simulates a capture, fits it and asks for the time left at every report, by processor time, since other work on the
machine is none of the estimate's. The first and the last tenth of the run are not asked about: there the machine's
speed is not known yet, and what is left is within seconds.
"""

from __future__ import annotations

import itertools
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import torch

from reflectsep.config import FitJob, ObjectSettings, SimulateJob
from reflectsep.estimate import Part, TimeLeft
from reflectsep.jobs import run_fit, run_simulate

UNASKED = 0.1


def within_two(said: Sequence[tuple[float, float | None]], *, from_s: float = 0.0, skip_s: float = 0.0) -> float:
    """Share of the time for which a run's stated time left is right within a factor of two.

    Args:
        said: (seconds since the begin, seconds stated to be left), in order; the last is the end.
        from_s: begin of the part that is judged.
        skip_s: an end of this length is not judged.
    """
    end_s, good, total = said[-1][0], 0.0, 0.0
    for (at_s, left_s), (next_s, _) in itertools.pairwise(said):
        true_s = end_s - at_s
        if left_s is None or at_s < from_s or true_s <= skip_s:
            continue
        total += next_s - at_s
        good += (next_s - at_s) * (0.5 <= left_s / true_s <= 2.0)
    return good / total


class Watch:
    """A progress that asks for the time left at every report."""

    def __init__(self) -> None:
        self._left = TimeLeft(time.process_time)
        self._began_s = time.process_time()
        self.said: list[tuple[float, float | None]] = []

    def expect(self, parts: Sequence[Part]) -> None:
        """Take an announcement."""
        self._left.expect(parts)

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Take a report."""
        self._left(stage, done, total)
        self.said.append((self.passed_s(), self._left.left_s()))

    def passed_s(self) -> float:
        """Processor time since the begin."""
        return time.process_time() - self._began_s


def main(arguments: Sequence[str]) -> None:
    """Print the share."""
    given = dict(argument.split("=", 1) for argument in arguments)
    # Threads that wait for each other are processor time, too, on a busy machine three times that of the work.
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(given.get("folder", temporary))
        item = ObjectSettings(name=given.get("object", "wax"), size_px=int(given.get("size", "96")))
        run_simulate(SimulateJob(object=item, out=str(folder / "capture")))
        watch = Watch()
        run_fit(FitJob(capture=str(folder / "capture"), out=str(folder / "result")), watch)
    took_s = watch.passed_s()
    share = within_two([*watch.said, (took_s, None)], from_s=UNASKED * took_s, skip_s=UNASKED * took_s)
    print(f"{took_s:.0f} s: within a factor of two for {100 * share:.0f} % of the time")


if __name__ == "__main__":
    main(sys.argv[1:])
