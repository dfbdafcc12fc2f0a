"""Progress of the stages: one callable that every stage may be handed, and two ways to show it.

A stage calls `progress(stage, done, total)` as it goes: `stage` is its name, `done` of `total` steps are behind it.
"""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol, TextIO


class Progress(Protocol):
    """Receives how far a stage is."""

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Say that `done` of `total` steps of `stage` are behind it."""
        ...


def silent(stage: str, done: int, total: int) -> None:
    """Show nothing: the default of every function that takes a `Progress`."""


class Lines:
    """One line a stage, written when the stage ends: for files, pipes and parallel runs."""

    def __init__(self, stream: TextIO, prefix: str = "") -> None:
        self._stream = stream
        self._prefix = prefix
        self._stage: str | None = None
        self._ended: str | None = None
        self._started_s = self._ended_s = time.monotonic()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Take note of a step; write the line of a stage that ended."""
        if done >= total and stage == self._ended:
            return  # an iteration that reached its limit says so once as a step and once as its end
        if stage != self._stage:
            self.close()
            # A first report that comes after steps is of a stage that began where the one before ended.
            self._stage, self._started_s = stage, self._ended_s if done else time.monotonic()
            self._ended = None
        if done >= total:
            self.close()

    def close(self) -> None:
        """Write the line of the stage under way: an iteration that converged early ends before its total."""
        if self._stage is not None:
            self._ended_s = time.monotonic()
            elapsed_s = self._ended_s - self._started_s
            print(f"{self._prefix}{self._stage}: {elapsed_s:.1f} s", file=self._stream, flush=True)
            self._ended, self._stage = self._stage, None


class Journal:
    """Hands progress on, and keeps when each stage ended: the lines of a result's log file."""

    def __init__(self, progress: Progress = silent) -> None:
        self._progress = progress
        self._lines = io.StringIO()
        self._stages = Lines(self._lines)

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Take note of a step and hand it on."""
        self._stages(stage, done, total)
        self._progress(stage, done, total)

    def text(self) -> str:
        """One line a stage that has ended, `NAME: SECONDS s`, in their order."""
        self._stages.close()
        return self._lines.getvalue()


@contextmanager
def bars(stream: TextIO) -> Iterator[Progress]:
    """One bar a stage on a terminal, with the time that is left."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as RichProgress

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with RichProgress(*columns, console=Console(file=stream)) as display:
        tasks = {}

        def show(stage: str, done: int, total: int) -> None:
            for other, task in tasks.items():
                if other != stage and not display.tasks[task].finished:
                    # The stage ended before its total (it converged): its end is where it stopped.
                    display.update(task, total=display.tasks[task].completed)
            if stage not in tasks:
                tasks[stage] = display.add_task(stage, total=total)
            elif done < total and display.tasks[tasks[stage]].finished:
                display.reset(tasks[stage])  # a stage that is done again
            display.update(tasks[stage], completed=done, total=total)

        yield show


@contextmanager
def shown(prefix: str = "", *, parallel: bool = False, stream: TextIO | None = None) -> Iterator[Progress]:
    """Progress as bars on a terminal, else (or where runs go in parallel) as a line a stage.

    Args:
        prefix: Written before every line, to tell parallel runs apart.
        parallel: Other runs write to the same terminal at the same time.
        stream: Where to show it; standard error unless given.
    """
    target: TextIO = sys.stderr if stream is None else stream
    if target.isatty() and not parallel:
        with bars(target) as progress:
            yield progress
        return
    lines = Lines(target, prefix)
    yield lines
    lines.close()  # not in a `finally`: a stage that failed has no line of its own, the error is the line
