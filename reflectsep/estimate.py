"""How much time is left of a run: what its stages should take, corrected by what those behind it took.

A run announces its parts, each with the seconds that it is expected to take (`workload` has the figures). With E the
sum of what was expected of the parts that have ended and A of what they took, a part to come takes

    expected * (A + w) / (E + w),    w: a fiftieth of the whole, so that a first short stage does not decide alone.

Reading pictures and solving are corrected apart: a slow disk says little of the solver.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

TRUST = 0.02
"""Share of the expected whole that stands against what was seen."""
LEAST_SHARE = 0.1
"""Steps tell the time left of a part once this share of them is behind."""
OVERDUE = 0.3
"""A part that is beyond its time takes this much of what it took, again."""


Kind = Literal["reading", "solving", "drawing"]
"""Work that a machine is slow or fast at together."""
Steps = Literal["even", "limit", "uneven"]
"""What a part's steps tell: all of them come and take alike; or it converges, before the last step at the latest; or
nothing."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """A piece of work that is to come."""

    name: str
    """Of the stage whose reports are of it; the stage may add which round of how many it is: `NAME 2 of 4`."""
    label: str
    """Line of the stage list that it belongs to."""
    expected_s: float
    kind: Kind = "solving"
    steps: Steps = "limit"


@dataclass(frozen=True, kw_only=True)
class Seen:
    """Where a run is."""

    part: Part
    stage: str
    began_s: float
    done: int
    total: int
    seen_s: float = 0.0
    """From its begin to its last report."""


class TimeLeft:
    """Takes the reports of a run and tells what is left of it.

    Args:
        clock: seconds since any moment.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._ahead: list[Part] = []
        self._now: Seen | None = None
        self._ended_s = clock()
        self._took: dict[Kind, float] = {}
        self._expected: dict[Kind, float] = {}
        self._whole_s = 0.0

    @property
    def ahead(self) -> tuple[Part, ...]:
        """The parts that have not begun."""
        return tuple(self._ahead)

    def expect(self, parts: Sequence[Part]) -> None:
        """What is to come, instead of whatever was announced before."""
        self._ahead = list(parts)
        self._whole_s = sum(self._expected.values()) + sum(part.expected_s for part in parts)

    def __call__(self, stage: str, done: int, total: int) -> Part:
        """Take note of a report; returns the part that it is of."""
        at_s, now = self._clock(), self._now
        if now is None or stage != now.stage or (done < now.done and now.done >= now.total):
            if now is not None and now.done < now.total:
                self._end(now, at_s)  # it converged without saying so
            now = Seen(part=self._begun(stage), stage=stage, began_s=self._ended_s, done=0, total=total)
        if done >= total and now.done < now.total:
            self._end(now, at_s)
        self._now = replace(now, done=done, total=total, seen_s=at_s - now.began_s)
        return now.part

    def _end(self, now: Seen, at_s: float) -> None:
        if now.part.expected_s > 0:
            kind = now.part.kind
            self._took[kind] = self._took.get(kind, 0.0) + at_s - now.began_s
            self._expected[kind] = self._expected.get(kind, 0.0) + now.part.expected_s
        self._ended_s = at_s

    def _begun(self, stage: str) -> Part:
        """The part that a stage begins; parts before it were left out, and so are those that its name rules out."""
        round_of = re.fullmatch(r"(.+) (\d+) of (\d+)", stage)
        names = (stage,) if round_of is None else (stage, round_of[1])
        place = next((i for i, part in enumerate(self._ahead) if part.name in names), None)
        if place is None:
            return Part(name=stage, label=stage, expected_s=0.0, kind="reading", steps="even")
        part = self._ahead[place]
        del self._ahead[: place + 1]
        if round_of is not None:
            alike = [i for i, other in enumerate(self._ahead) if other.name == part.name]
            for i in reversed(alike[int(round_of[3]) - int(round_of[2]) :]):
                del self._ahead[i]
        return part

    def left_s(self) -> float | None:
        """Seconds until the last part ends; None where nothing tells."""
        left = sum(part.expected_s * self._slowness(part.kind) for part in self._ahead)
        now = self._now
        if now is None or now.done >= now.total:
            return left - min(left, self._clock() - self._ended_s) if self._ahead else None
        own = self._left_of(now)
        return None if own is None else own + left

    def _slowness(self, kind: Kind) -> float:
        """What a part takes, of what is expected."""
        took, expected = self._evidence(kind)
        if expected == 0 and kind == "drawing" and self._evidence("solving")[1] > 0:
            return self._tempered(*self._evidence("solving"))  # both are bound by the processor
        if expected == 0 and kind != "reading":
            # Nothing of its kind has been seen. That reading is slow makes it likely, no more, that all is.
            return math.sqrt(self._tempered(*self._evidence("reading")))
        return self._tempered(took, expected)

    def _tempered(self, took: float, expected: float) -> float:
        trust = TRUST * self._whole_s
        return (took + trust) / (expected + trust) if expected + trust > 0 else 1.0

    def _evidence(self, kind: Kind) -> tuple[float, float]:
        """Seconds taken and expected of what is behind; of the part under way as far as its steps are even."""
        took, expected = self._took.get(kind, 0.0), self._expected.get(kind, 0.0)
        now = self._now
        if now is not None and now.part.kind == kind and now.part.steps == "even" and now.done < now.total:
            share = now.done / now.total
            if share >= LEAST_SHARE:
                took += now.seen_s
                expected += share * now.part.expected_s
        return took, expected

    def _left_of(self, now: Seen) -> float | None:
        """Seconds that the part under way still takes."""
        spent = self._clock() - now.began_s
        share = now.done / now.total
        by_steps = spent * (1 - share) / share if share >= LEAST_SHARE else None
        if now.part.expected_s <= 0 or (now.part.steps == "even" and by_steps is not None):
            return by_steps
        left = max(now.part.expected_s * self._slowness(now.part.kind) - spent, OVERDUE * spent)
        return left if by_steps is None or now.part.steps == "uneven" else min(left, by_steps)


def labels(parts: Sequence[Part]) -> list[str]:
    """Lines of a stage list, in order."""
    return list(dict.fromkeys(part.label for part in parts))


def words(seconds: float | None) -> str:
    """A time left as people say it."""
    if seconds is None:
        return ""
    if seconds < 10:
        return "a few seconds left"
    if seconds < 55:
        return f"about {10 * round(seconds / 10)} s left"
    minutes = round(seconds / 60)
    if minutes < 60:
        return f"about {max(1, minutes)} min left"
    return f"about {minutes // 60} h {minutes % 60:02d} min left"
