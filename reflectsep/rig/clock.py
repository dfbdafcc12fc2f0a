"""Time as the drivers see it: seconds that only go forward, real or simulated.

Nothing here follows the wall clock, so that a jump of it changes nothing. A simulated clock moves only when somebody
sleeps or waits: a simulated session takes no longer than its arithmetic, and is the same every time.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol


class Clock(Protocol):
    """A monotonic clock that can be slept on."""

    def now(self) -> float:
        """Seconds since some moment."""
        ...

    def sleep(self, duration_s: float) -> None:
        """Come back `duration_s` later."""
        ...


class HostClock:
    """The computer's monotonic clock."""

    def now(self) -> float:
        """Seconds since some moment."""
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        """Come back `duration_s` later."""
        time.sleep(duration_s)


class VirtualClock:
    """A clock that moves only when slept on."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._now_s = start_s

    def now(self) -> float:
        """Seconds since its start."""
        return self._now_s

    def sleep(self, duration_s: float) -> None:
        """Move on at once."""
        self._now_s += max(duration_s, 0.0)


@dataclass(frozen=True, kw_only=True)
class Deadline:
    """The end of a wait."""

    clock: Clock
    end_s: float

    @classmethod
    def after(cls, clock: Clock, duration_s: float) -> Deadline:
        """`duration_s` from now."""
        return cls(clock=clock, end_s=clock.now() + duration_s)

    @property
    def left_s(self) -> float:
        """Seconds until the end; 0 once it has passed."""
        return max(0.0, self.end_s - self.clock.now())

    @property
    def passed(self) -> bool:
        """Whether the wait is over."""
        return self.clock.now() >= self.end_s
