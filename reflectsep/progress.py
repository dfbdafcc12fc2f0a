"""Progress of the stages: one callable that every stage may be handed, and two ways to show it.

A stage calls `progress(stage, done, total)` as it goes: `stage` is its name, `done` of `total` steps are behind it.
Who knows what is to come announces it by `expect`, so that a display can list it and tell the time left of the whole.
"""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Protocol, TextIO, runtime_checkable

from reflectsep.estimate import Part


class Progress(Protocol):
    """Receives how far a stage is."""

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Say that `done` of `total` steps of `stage` are behind it."""
        ...


@runtime_checkable
class Foresight(Protocol):
    """A `Progress` that wants to know what is to come."""

    def expect(self, parts: Sequence[Part]) -> None:
        """Take note of the parts to come, instead of those announced before."""
        ...


def expect(progress: Progress, parts: Sequence[Part]) -> None:
    """Announce the parts of a run to whoever shows them; others are not told."""
    if isinstance(progress, Foresight):
        progress.expect(parts)


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
    """Hands progress on, and keeps when each stage ended: the lines of a result's log file.

    Args:
        progress: where it goes.
        after: what follows the parts that are announced to this.
    """

    def __init__(self, progress: Progress = silent, after: Sequence[Part] = ()) -> None:
        self._progress = progress
        self._after = tuple(after)
        self._lines = io.StringIO()
        self._stages = Lines(self._lines)

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Take note of a step and hand it on."""
        self._stages(stage, done, total)
        self._progress(stage, done, total)

    def expect(self, parts: Sequence[Part]) -> None:
        """Hand an announcement on, with what follows."""
        expect(self._progress, [*parts, *self._after])

    def text(self) -> str:
        """One line a stage that has ended, `NAME: SECONDS s`, in their order."""
        self._stages.close()
        return self._lines.getvalue()


class Titled:
    """Hands on the stages of a run within another under a title; the other has announced them (`titled`).

    Args:
        progress: where they go.
        title: stands before their names.
    """

    def __init__(self, progress: Progress, title: str) -> None:
        self._progress = progress
        self._title = title

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Hand a step on."""
        self._progress(f"{self._title}: {stage}", done, total)

    def expect(self, parts: Sequence[Part]) -> None:
        """Nothing: what was announced before stays."""


def titled(parts: Sequence[Part], title: str) -> list[Part]:
    """Parts of a run within another, on one line of its stage list."""
    return [replace(part, name=f"{title}: {part.name}", label=title) for part in parts]


@contextmanager
def shown(
    prefix: str = "", *, parallel: bool = False, lines: bool = False, stream: TextIO | None = None
) -> Iterator[Progress]:
    """Progress as a stage list on a terminal; elsewhere nothing, or a line a stage where that is asked for.

    Args:
        prefix: Written before every line, to tell parallel runs apart.
        parallel: Other runs write to the same terminal at the same time: a line a stage, no list.
        lines: A line a stage, wherever it goes.
        stream: Where to show it; standard error unless given.
    """
    target: TextIO = sys.stderr if stream is None else stream
    if not lines and not target.isatty():
        yield silent
        return
    if not lines and not parallel:
        from reflectsep.terminal import stage_list  # rich is for those who see it

        with stage_list(target) as progress:
            yield progress
        return
    written = Lines(target, prefix)
    yield written
    written.close()  # not in a `finally`: a stage that failed has no line of its own, the error is the line
