"""The planner of a simulated board: motions queue up, run one after another, are held and go on."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

from reflectsep.rig.motion import Point, Trace

PLANNED = 15
"""Motions that it holds besides the one under way."""
FIRST_STEP_S = 0.015
SLOWEST_STEPS_S = 30.5


class Planner:
    """Motions to come, and the way that the carriage takes.

    Args:
        settings: The board's `$` settings; they may change.
    """

    def __init__(self, settings: Mapping[int, float]) -> None:
        self._settings = settings
        self.trace = Trace()
        """Of the board's own belief."""
        self.override = 100
        """Of the feed, in per cent."""
        self.clear()

    def clear(self) -> None:
        """Forget every motion."""
        self._queue: deque[tuple[Point, float]] = deque()
        self._held: tuple[Point, float] | None = None
        self._end: Point | None = None
        self.current: tuple[Point, float] | None = None

    @property
    def waits(self) -> bool:
        """Whether anything is under way, queued or held."""
        return self.current is not None or bool(self._queue) or self._held is not None

    @property
    def full(self) -> bool:
        """Whether no further motion can be taken."""
        return len(self._queue) >= PLANNED

    @property
    def room(self) -> int:
        """Motions that can still be taken."""
        return PLANNED - len(self._queue)

    def end(self, now_s: float) -> Point:
        """Where the last motion will end."""
        return self._end if self._end is not None else self.trace.at(now_s)

    def add(self, now_s: float, target: Point, speed_mm_s: float) -> None:
        """Queue a motion; it starts by itself when nothing else is under way."""
        self._end = target
        self._queue.append((target, speed_mm_s))
        if self.current is None and self._held is None:
            self.go_on(now_s)

    def go_on(self, now_s: float) -> None:
        """The next motion, where there is one; the one that was held first."""
        if self._held is not None:
            self._queue.appendleft(self._held)
            self._held = None
        if not self._queue:
            self._end = self.current = None
            return
        self.current = target, speed = self._queue.popleft()
        self.trace.move(now_s + FIRST_STEP_S, target, self.true_speed(speed), self._settings[120])

    def hold(self, now_s: float) -> bool:
        """Decelerate to rest; returns whether anything was under way."""
        if self.current is None:
            return False
        self._held, self.current = self.current, None
        self.trace.stop(now_s, self._settings[120])
        return True

    def stop(self, now_s: float) -> bool:
        """Stop dead and forget what was to come; returns whether it was moving."""
        moving = self.trace.speed_at(now_s) > 0
        self.trace.jump(now_s, self.trace.at(now_s))
        self.clear()
        return moving

    def true_speed(self, speed_mm_s: float) -> float:
        """What override and step timer make of a speed."""
        return max(speed_mm_s * self.override / 100.0, SLOWEST_STEPS_S / self._settings[100])
