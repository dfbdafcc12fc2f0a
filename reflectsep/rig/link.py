"""A line to a controller: text lines over anything that pyserial can open, with a deadline on every wait.

Whatever goes wrong with the line becomes a LinkLostError: unplugging shows as SerialException from read and write, as
OSError from `in_waiting` and as termios.error, which is no OSError, from `flush`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import serial
from serial.tools import list_ports

from reflectsep.errors import LinkLostError, StageError
from reflectsep.rig.clock import Clock, Deadline

try:
    from termios import error as TermiosError  # noqa: N812
except ImportError:  # not a POSIX system
    TermiosError = OSError

LONGEST_LINE = 512
"""Bytes without a line end beyond which they are noise."""
WAIT_S = 0.01
"""Of one read: how soon a deadline or an interrupt is noticed."""

Opener = Callable[..., Any]
"""As `serial.serial_for_url`."""


class SerialLink:
    """Lines out and lines in.

    Args:
        port: A device, or a URL such as `socket://host:port` or `rfc2217://host:port`.
        baud: Bits a second.
        clock: For deadlines.
        opener: Opens the port; pyserial unless given.
    """

    def __init__(self, port: str, baud: int, clock: Clock, opener: Opener | None = None) -> None:
        self.port = port
        self.baud = baud
        self._clock = clock
        self._opener = opener or serial.serial_for_url
        self._line: Any = None
        self._bytes = bytearray()

    @property
    def is_open(self) -> bool:
        """Whether the port is held."""
        return self._line is not None

    def open(self) -> None:
        """Open the port for us alone.

        Raises:
            StageError: absent, busy, or no such kind of port.
        """
        options = {"baudrate": self.baud, "timeout": WAIT_S, "write_timeout": 1.0}
        if "://" not in self.port:
            options["exclusive"] = True
        try:
            self._line = self._opener(self.port, **options)
        except (serial.SerialException, OSError, ValueError, TermiosError) as error:
            raise StageError(f"{self.port}: cannot be opened: {_reason(error)}{_others(self.port)}") from error
        self._bytes.clear()

    def write(self, data: bytes) -> None:
        """Send bytes and see them on their way.

        Raises:
            LinkLostError: the line is gone.
        """
        with self._lost("writing"):
            self._line.write(data)
            self._line.flush()

    def read_line(self, deadline: Deadline) -> str | None:
        """The next line without its end; None when the deadline comes first.

        What is not ASCII comes as `?`. A line that never ends comes in pieces.

        Raises:
            LinkLostError: the line is gone.
        """
        while True:
            line = self._taken()
            if line is not None:
                return line
            if not deadline.passed:
                self._receive()
            elif not self._came():
                return None

    def drop_input(self) -> None:
        """Forget what has come so far.

        Raises:
            LinkLostError: the line is gone.
        """
        with self._lost("reading"):
            self._line.reset_input_buffer()
        self._bytes.clear()

    def try_write(self, data: bytes) -> bool:
        """Send bytes whatever the state of the line; returns whether it took them."""
        with suppress(Exception):
            self._line.write(data)
            return True
        return False

    def close(self) -> None:
        """Let go of the port; never raises."""
        line, self._line = self._line, None
        if line is not None:
            with suppress(Exception):
                line.close()

    def _taken(self) -> str | None:
        end = self._bytes.find(b"\n")
        if end < 0 and len(self._bytes) < LONGEST_LINE:
            return None
        end = LONGEST_LINE - 1 if end < 0 or end >= LONGEST_LINE else end
        line = bytes(self._bytes[: end + 1])
        del self._bytes[: end + 1]
        return line.decode("ascii", errors="replace").replace("\ufffd", "?").strip()

    def _receive(self) -> None:
        with self._lost("reading"):
            waiting = self._line.in_waiting
            self._bytes += self._line.read(min(max(1, waiting), 4096))

    def _came(self) -> bool:
        """Take what has come, without waiting: a host that was asleep at the deadline still has it."""
        with self._lost("reading"):
            waiting = self._line.in_waiting
            got = self._line.read(min(waiting, 4096)) if waiting else b""
        self._bytes += got
        return bool(got)

    @contextmanager
    def _lost(self, doing: str) -> Iterator[None]:
        if self._line is None:
            raise LinkLostError(f"{self.port}: not open")
        try:
            yield
        except (serial.SerialException, OSError, TermiosError, TypeError) as error:
            # TypeError: pyserial reads from a descriptor that another thread, or a signal, has just closed.
            raise LinkLostError(f"{self.port}: connection lost while {doing}: {_reason(error)}") from error


def _reason(error: BaseException) -> str:
    number = getattr(error, "errno", None)
    if isinstance(number, int) and number > 0:
        return os.strerror(number)  # pyserial repeats itself around it
    return " ".join(str(error).split()) or type(error).__name__


def _others(port: str) -> str:
    """The ports that there are, for one that cannot be opened."""
    if "://" in port:
        return ""
    found = [item.device for item in list_ports.comports()]
    return f" (ports here: {', '.join(found)})" if found else " (no serial ports here)"
