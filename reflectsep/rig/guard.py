"""Ctrl-C and SIGTERM during a session: the first stops it in order, the second stops the stage at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any


class Interrupted(KeyboardInterrupt):
    """Somebody wants the session to stop."""


class Guard:
    """Context in which interrupts are turned into `Interrupted`, once; later ones call `abort`.

    Outside the main thread, where Python takes no signals, it does nothing.

    Args:
        abort: Stops the stage at once; must be quick and must not raise.
    """

    def __init__(self, abort: Callable[[], None]) -> None:
        self._abort = abort
        self._before: dict[signal.Signals, Any] = {}
        self.count = 0

    def __enter__(self) -> Guard:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._take)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def stopping(self) -> None:
        """The session is being stopped already: from now on an interrupt stops the stage at once."""
        self.count = max(1, self.count)

    def _take(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002
        self.count += 1
        if self.count > 1:
            self._abort()
            return
        raise Interrupted(signal.Signals(number).name)
