"""The folder of a multirun's launcher; and of jobs that submitit sends to a cluster, what they said.

What such a job prints goes to files beside its own, and not to the terminal of the one who waits for it.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from reflectsep.errors import WorkerError

MOST_SAID = 200
"""Characters of the launcher's own words."""
_CHATTER = "submitit "
"""How the lines begin that the launcher itself writes into a job's output."""


@contextmanager
def scratch(launcher: str) -> Iterator[Path]:
    """A folder for what Hydra and its launcher insist on writing, gone afterwards.

    Submitit's stands in the working folder, which a cluster's machines share, and stays if a job was lost.

    Raises:
        WorkerError: a job that ended without an answer: cancelled, out of time or memory.
    """
    if not launcher.startswith("submitit"):
        with tempfile.TemporaryDirectory(prefix="reflectsep-") as folder:
            yield Path(folder)
        return
    place = Path(tempfile.mkdtemp(prefix=".reflectsep-jobs-", dir=Path.cwd()))
    try:
        yield place
    except Exception as error:
        repeat(place)
        if type(error).__module__.startswith("submitit"):
            said = " ".join(str(error).split())[:MOST_SAID] or type(error).__name__
            raise WorkerError(f"{place}: a job ended without an answer: {said}; what there is of it is kept") from error
        raise
    repeat(place)
    shutil.rmtree(place)


def repeat(place: Path) -> None:
    """Print what the jobs under `place` printed, job by job, errors where errors belong."""
    for suffix, stream in (("out", sys.stdout), ("err", sys.stderr)):
        for file in sorted(place.rglob(f"*_log.{suffix}")):
            lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
            for line in lines:
                if not line.startswith(_CHATTER):
                    print(line, file=stream, flush=True)
