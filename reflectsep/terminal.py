"""The stage list on a terminal: what is behind, what is under way and what is to come, and the time left of it all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, ProgressColumn, Task, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import Progress as RichProgress
from rich.text import Text

from reflectsep.estimate import Part, TimeLeft, labels, words


class _Left(ProgressColumn):
    """The time left of the whole run, beside the first stage that is not behind."""

    max_refresh = 0.5

    def __init__(self, left: TimeLeft) -> None:
        self._left = left
        self.display: RichProgress | None = None
        super().__init__()

    def render(self, task: Task) -> Text:
        """What is left, on one line."""
        tasks = () if self.display is None else self.display.tasks
        first = next((other.id for other in tasks if not other.finished), None)
        return Text(words(self._left.left_s()) if task.id == first else "", style="cyan")


class StageList:
    """A line a stage; those to come stand there from the start."""

    def __init__(self, display: RichProgress, left: TimeLeft) -> None:
        self._display = display
        self._left = left
        self._tasks: dict[str, TaskID] = {}
        self._rounds: dict[str, int] = {}
        self._under_way: str | None = None
        self._stage = ("", 0, 0)

    def lines(self) -> list[str]:
        """The stages that are listed, from the top."""
        return list(self._tasks)

    def expect(self, parts: Sequence[Part]) -> None:
        """List what is to come; what was announced before and has not begun goes."""
        self._left.expect(parts)
        for label in [name for name in self._tasks if not self._task(name).started]:
            self._remove(label)
        for label in labels(parts):
            if label not in self._tasks:
                self._tasks[label] = self._display.add_task(label, start=False, total=1, steps="")

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show a report."""
        part = self._left(stage, done, total)
        label = part.label
        if label != self._under_way:
            self._finish(label)
            self._under_way = label
        last, last_done, last_total = self._stage
        if stage != last or (done < last_done and last_done >= last_total):
            self._rounds[label] = self._rounds.get(label, 0) + 1
        self._stage = (stage, done, total)
        if label not in self._tasks:
            self._tasks[label] = self._display.add_task(label, start=False, total=1, steps="")
        task = self._tasks[label]
        rounds = self._rounds[label]
        of = rounds + sum(other.label == label for other in self._left.ahead)
        self._display.start_task(task)
        behind = rounds - 1 + done / max(1, total)
        if behind < of and self._task(label).finished:
            self._display.reset(task)  # a stage that is done again
        steps = f"{done}/{total}" if of == 1 else f"{rounds} of {of}: {done}/{total}"
        self._display.update(task, completed=behind, total=of, steps=steps)

    def _task(self, label: str) -> Task:
        return next(task for task in self._display.tasks if task.id == self._tasks[label])

    def _finish(self, begins: str) -> None:
        """The stage that was under way has ended: perhaps before its last step; those left out before it go."""
        if self._under_way is not None:
            task, (_, done, total) = self._task(self._under_way), self._stage
            steps = task.fields["steps"].replace(f"{done}/{total}", f"{done}/{done}")
            self._display.update(task.id, total=max(1e-9, task.completed), steps=steps)
        waiting = {begins, *(part.label for part in self._left.ahead)}
        for label in list(self._tasks):
            if not self._task(label).started and label not in waiting:
                self._remove(label)

    def _remove(self, label: str) -> None:
        self._display.remove_task(self._tasks.pop(label))


@contextmanager
def stage_list(stream: TextIO) -> Iterator[StageList]:
    """A stage list on a terminal, for as long as the context lasts."""
    left = TimeLeft()
    beside = _Left(left)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TextColumn("{task.fields[steps]}"),
        TimeElapsedColumn(),
        beside,
    )
    with RichProgress(*columns, console=Console(file=stream)) as display:
        beside.display = display
        yield StageList(display, left)
