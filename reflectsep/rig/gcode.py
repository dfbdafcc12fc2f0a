"""The part of G-code that a simulated board understands, with the state that stays from line to line."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from reflectsep.rig.motion import Point

INCH_MM = 25.4
_WORD = re.compile(r"([A-Z])([-+]?\d*\.?\d+)")


@dataclass(frozen=True, kw_only=True)
class Move:
    """A straight motion."""

    axes: Mapping[str, float]
    """Millimetres by letter, as written."""
    absolute: bool
    feed_mm_s: float | None
    """None: as fast as it goes."""

    def target(self, base: Point) -> Point:
        """From `base`, in machine coordinates."""
        x, y, z = (
            base[i] if letter not in self.axes else self.axes[letter] + (0.0 if self.absolute else base[i])
            for i, letter in enumerate("XYZ")
        )
        return (x, y, z)


@dataclass(frozen=True, kw_only=True)
class Dwell:
    """A pause once everything has ended."""

    duration_s: float


@dataclass(frozen=True, kw_only=True)
class Refused:
    """A line that cannot be carried out."""

    code: int


class Interpreter:
    """Lines in, what they ask for out."""

    def __init__(self) -> None:
        self._absolute, self._motion, self._unit_mm = True, 1, 1.0
        self._feed: float | None = None

    def read(self, line: str) -> Move | Dwell | Refused | None:
        """One line without spaces, in capitals; None: it only changed the state."""
        words = _WORD.findall(line)
        if "".join(a + b for a, b in words) != line:
            return Refused(code=2 if line[0].isalpha() else 1)
        machine, axes, dwell_s = False, {}, None
        for letter, number in words:
            value = float(number)
            if letter == "G" and value == 53:
                machine = True
            elif letter == "G" and value == 4:
                dwell_s = 0.0
            elif letter == "G" and self._mode(value):
                pass
            elif letter == "F":
                self._feed = value * self._unit_mm / 60.0
            elif letter == "P" and dwell_s is not None:
                dwell_s = value
            elif letter in "XYZ":
                axes[letter] = value * self._unit_mm
            else:
                return Refused(code=20)
        if dwell_s is not None:
            return Dwell(duration_s=dwell_s)
        if not axes:
            return None
        if self._motion == 1 and not self._feed:
            return Refused(code=22)
        feed = self._feed if self._motion == 1 else None
        return Move(axes=axes, absolute=self._absolute or machine, feed_mm_s=feed)

    def _mode(self, code: float) -> bool:
        """A code that stays in force; False where it is none that is known."""
        if code in (0, 1):
            self._motion = int(code)
        elif code in (90, 91):
            self._absolute = code == 90
        elif code in (20, 21):
            self._unit_mm = INCH_MM if code == 20 else 1.0
        else:
            return code == 94
        return True
