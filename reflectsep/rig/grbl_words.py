"""What a GRBL 1.1 board says, taken apart; and its numbered errors and alarms in words."""

from __future__ import annotations

import re
from dataclasses import dataclass

ERRORS = {
    1: "a letter was expected",
    2: "a number cannot be read",
    3: "no such $ command",
    5: "homing is switched off ($22=0)",
    8: "only possible while it stands still",
    9: "locked after an alarm or at boot: home it",
    11: "the line is too long",
    13: "the safety door is open",
    14: "the line is too long for its memory",
    15: "the jog leaves the travel",
    20: "no such command",
    21: "two commands of one group in a line",
    22: "no feed rate was given",
}
ALARMS = {
    1: "a limit switch was hit: the position is lost",
    2: "the motion would leave the travel (soft limits)",
    3: "it was reset while moving: the position is lost",
    6: "homing was interrupted",
    7: "the door was opened while homing",
    8: "homing could not leave the switch",
    9: "homing did not find the switch",
}
_STATUS = re.compile(r"<(Idle|Run|Hold:\d|Jog|Alarm|Door:\d|Check|Home|Sleep)\|([MW])Pos:([-\d.,]+)((?:\|[^<>]*)?)>")
_NUMBER = re.compile(r"-?\d+\.\d+|-?\d+")


@dataclass(frozen=True, kw_only=True)
class Status:
    """One status report."""

    state: str
    position_mm: tuple[float, float, float]
    """X, Y, Z of the machine."""
    override_percent: float | None


def parse_status(line: str) -> Status | None:
    """A report of machine positions; None for anything else, work positions and damaged reports among it."""
    match = _STATUS.fullmatch(line)
    if match is None or match[2] != "M":
        return None
    numbers = match[3].split(",")
    if not 3 <= len(numbers) <= 6 or not all(_NUMBER.fullmatch(number) for number in numbers):
        return None
    override = None
    for part in match[4].split("|"):
        if part.startswith("Ov:"):
            first = part[3:].split(",")[0]
            if not first.isdigit():
                return None
            override = float(first)
    x, y, z = (float(number) for number in numbers[:3])  # boards with a fourth axis tell it behind
    return Status(state=match[1], position_mm=(x, y, z), override_percent=override)


def parse_setting(line: str) -> tuple[int, float] | None:
    """`$100=250.000` as its number and value."""
    match = re.fullmatch(r"\$(\d{1,3})=(-?\d+(?:\.\d+)?)", line)
    return (int(match[1]), float(match[2])) if match else None


def error_text(code: int) -> str:
    """`error:22 (no feed rate was given)`."""
    return f"error:{code} ({ERRORS.get(code, 'see its manual')})"


def alarm_text(code: int) -> str:
    """`ALARM:1 (...)`."""
    return f"ALARM:{code} ({ALARMS.get(code, 'see its manual')})"


def code_of(line: str, word: str) -> int | None:
    """The number of `error:9` or `ALARM:1`; None where the line is not that."""
    match = re.fullmatch(rf"{word}:(\d{{1,3}})", line)
    return int(match[1]) if match else None
