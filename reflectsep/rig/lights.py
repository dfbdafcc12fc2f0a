"""Lights: over a serial line, by a program of the user's, or by the person at the rig."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress

from reflectsep.errors import LightsError, LinkLostError, RigError, StageError
from reflectsep.rig.clock import Clock, Deadline, HostClock
from reflectsep.rig.command import checked_arguments, run_command
from reflectsep.rig.devices import Asks
from reflectsep.rig.link import Opener, SerialLink

OFF = "off"


class SerialLights:
    """A controller that takes one line a command and answers with one.

    Args:
        port: Serial device or URL.
        on: Line that switches a light on and all others off; `{light}` stands for its name.
        off: Line that switches all off.
        query: Line that asks which light is on; the answer is its name, or `off`. Empty: the answer to a command is.
        baud: Bits a second.
        timeout_s: For every answer.
        boot_s: Wait after opening, for controllers that this resets.
        clock: The session's.
        opener: Opens the port.
    """

    def __init__(  # noqa: PLR0913  (one argument a setting of the configuration)
        self,
        *,
        port: str,
        on: str = "ON {light}",
        off: str = "OFF",
        query: str = "?",
        baud: int = 115200,
        timeout_s: float = 2.0,
        boot_s: float = 2.0,
        clock: Clock | None = None,
        opener: Opener | None = None,
    ) -> None:
        self._clock = clock or HostClock()
        self._link = SerialLink(port, baud, self._clock, opener)
        self._on, self._off, self._query = on, off, query
        self._timeout_s, self._boot_s = timeout_s, boot_s

    @property
    def identity(self) -> Mapping[str, str]:
        """Its commands."""
        return {"on": self._on, "off": self._off, "query": self._query}

    def connect(self) -> None:
        """Open the line; all off."""
        try:
            self._link.open()
            self._clock.sleep(self._boot_s)
            self._link.drop_input()
            self.switch(None)
        except StageError as error:
            self._link.close()
            raise LightsError(str(error)) from error

    def switch(self, light: str | None) -> str | None:
        """Send the command, and ask what is on."""
        wanted = light or OFF
        if any(ord(c) < 32 or ord(c) > 126 for c in wanted):
            raise LightsError(f"{self._link.port}: light {wanted!r}: a name for one line of ASCII was expected")
        try:
            said = self._ask(self._off if light is None else self._on.replace("{light}", light))
            if self._query:
                said = self._ask(self._query)
        except LinkLostError as error:
            raise LightsError(f"{error}; the light may still be on") from error
        if said != wanted:
            raise LightsError(f"{self._link.port}: {wanted} was asked for, but {said!r} is on")
        return said

    def close(self) -> None:
        """All off, and let go of the line."""
        if self._link.is_open:
            self._link.try_write(self._off.encode("ascii") + b"\n")
        self._link.close()

    def _ask(self, line: str) -> str:
        self._link.write(line.encode("ascii") + b"\n")
        said = self._link.read_line(Deadline.after(self._clock, self._timeout_s))
        if said is None:
            raise LightsError(f"{self._link.port}: no answer to {line!r} in {self._timeout_s:g} s")
        return said


class CommandLights:
    """Lights switched by a program.

    Args:
        on: Argument list that switches a light on and all others off; `{light}` stands for its name.
        off: Argument list that switches all off.
        query: Argument list of a program that prints which light is on, or `off`; None: it cannot be read back.
        timeout_s: For each.
    """

    def __init__(
        self, *, on: Sequence[str], off: Sequence[str], query: Sequence[str] | None = None, timeout_s: float = 10.0
    ) -> None:
        self._on = checked_arguments(on, "rig.devices.lights.on")
        self._off = checked_arguments(off, "rig.devices.lights.off")
        self._query = None if query is None else checked_arguments(query, "rig.devices.lights.query")
        self._timeout_s = timeout_s

    @property
    def identity(self) -> Mapping[str, str]:
        """Its commands."""
        return {"on": " ".join(self._on), "off": " ".join(self._off)}

    def connect(self) -> None:
        """All off."""
        self.switch(None)

    def switch(self, light: str | None) -> str | None:
        """Run the program, and the one that asks."""
        arguments = self._off if light is None else self._on
        run_command(arguments, {"light": light or OFF}, self._timeout_s, LightsError)
        if self._query is None:
            return None
        said = run_command(self._query, {}, self._timeout_s, LightsError)
        if said != (light or OFF):
            raise LightsError(f"{self._query[0]}: {light or OFF} was asked for, but {said!r} is on")
        return said

    def close(self) -> None:
        """All off."""
        with suppress(RigError):
            self.switch(None)


class ManualLights:
    """Lights that the person at the rig switches, told what to do.

    Args:
        ask: Asks the person; the terminal unless given.
    """

    def __init__(self, *, ask: Asks | None = None) -> None:
        self._ask = ask or ask_terminal
        self._on: str | None = "?"

    @property
    def identity(self) -> Mapping[str, str]:
        """By hand."""
        return {"by": "hand"}

    def connect(self) -> None:
        """Nothing to open."""

    def switch(self, light: str | None) -> str | None:
        """Ask for one light, or none; what is on is never known for sure."""
        if light != self._on:
            self._ask("switch all lights off" if light is None else f"switch light {light} on and all others off")
            self._on = light
        return None

    def close(self) -> None:
        """The person sees that it is over."""


def ask_terminal(text: str) -> None:
    """Ask on the terminal and wait for Enter.

    Raises:
        LightsError: there is no terminal to ask on.
    """
    if not sys.stdin.isatty():
        raise LightsError(f"{text!r}: nobody to ask: manual lights need a terminal")
    print(f"\n>>> {text}, then press Enter ", end="", file=sys.stderr, flush=True)
    if not sys.stdin.readline():
        raise LightsError(f"{text!r}: the terminal was closed")
