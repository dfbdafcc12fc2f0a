"""A stage driven by Marlin firmware, as on 3-D printers: the same lines of G-code, other answers.

A report is `M114 R`, which Marlin answers between two lines, some milliseconds after it was asked: its moment is only
known to lie within the round trip. `M400` answers when all motion has ended, and blocks what comes after it, so it is
sent only when the way should be done. There is no stop that keeps the position: `M410` brakes and loses steps.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from reflectsep.errors import AlarmError, LinkLostError, StageError
from reflectsep.rig.axes import stage_axes, within
from reflectsep.rig.clock import Clock, Deadline, HostClock
from reflectsep.rig.devices import Axis, AxisLimits, StageReport
from reflectsep.rig.link import Opener, SerialLink

SLOWEST_STEPS_S = 32.0
"""Marlin keeps no time below about this many steps a second."""
REPORT_EVERY_S = 0.2
SILENT_REPORTS = 5
_POSITION = re.compile(r"X:(-?[\d.]+)\s*Y:(-?[\d.]+)\s*Z:(-?[\d.]+)")


class MarlinStage:
    """A stage on a Marlin board; positions are known after homing only.

    Args:
        port: Serial device or URL.
        axes: By axis of the picture, see `stage_axes`.
        baud: Bits a second.
        boot_timeout_s: For `start` after opening.
        command_timeout_s: For the answer to a line.
        homing_timeout_s: For `G28`.
        clock: The session's.
        opener: Opens the port.
    """

    def __init__(
        self,
        *,
        port: str,
        axes: Mapping[str, Mapping[str, Any]],
        baud: int = 115200,
        boot_timeout_s: float = 10.0,
        command_timeout_s: float = 3.0,
        homing_timeout_s: float = 90.0,
        clock: Clock | None = None,
        opener: Opener | None = None,
    ) -> None:
        self._clock = clock or HostClock()
        self._link = SerialLink(port, baud, self._clock, opener)
        self._axes = stage_axes(axes, "stage")
        self._boot_s, self._command_s, self._homing_s = boot_timeout_s, command_timeout_s, homing_timeout_s
        self._identity: dict[str, str] = {}
        self._known = False
        self._failed: str | None = None
        self._arrived: dict[Axis, float] = {}
        self._still()

    def _still(self) -> None:
        self._target: tuple[Axis, float] | None = None
        self._end: Deadline | None = None
        self._due_s = self._next_report_s = 0.0
        self._missed = 0

    @property
    def limits(self) -> Mapping[Axis, AxisLimits]:
        """By the configuration."""
        return {name: axis.limits(SLOWEST_STEPS_S) for name, axis in self._axes.items()}

    @property
    def identity(self) -> Mapping[str, str]:
        """The firmware's name and settings."""
        return dict(self._identity)

    @property
    def homes(self) -> bool:
        """It finds zero by its switches."""
        return True

    @property
    def moving(self) -> bool:
        """Whether the end of the last motion has not been seen."""
        return self._end is not None

    def connect(self) -> None:
        """Open, wait for it to start, read its name and settings."""
        self._link.open()
        try:
            deadline = Deadline.after(self._clock, self._boot_s)
            while (line := self._link.read_line(deadline)) is not None and line != "start":
                pass
            self._link.drop_input()
            name = [line for line in self._command("M115", self._command_s) if "FIRMWARE_NAME:" in line]
            if not name:
                raise StageError(f"{self._link.port}: does not tell its firmware: not a Marlin board?")
            settings = [line for line in self._command("M503 S0", self._command_s) if line.startswith("M")]
            self._identity = {"version": name[0], **{line.split()[0]: line for line in settings}}
            self._check_settings()
            self._command("G21", self._command_s)
            self._command("G90", self._command_s)
        except BaseException:
            self._link.close()
            raise

    def home(self) -> None:
        """`G28` of the axes in use."""
        self._refuse_failed()
        self._known = False
        self._arrived.clear()
        self._command("G28 " + " ".join(axis.letter for axis in self._axes.values()), self._homing_s)
        self._known = True

    def verify(self) -> float | None:
        """Homing again makes the position sure, but tells nothing of what it was."""
        return None

    def begin(self, axis: Axis, target_mm: float, speed_mm_s: float) -> None:
        """Send the motion."""
        self._refuse_failed()
        if not self._known:
            raise StageError(f"{self._link.port}: its position is unknown: home it first")
        within(self.limits, axis, target_mm, speed_mm_s, self._link.port)
        way = abs(target_mm - self._ask()[self._index(axis)])
        expected_s = way / speed_mm_s + speed_mm_s / self.limits[axis].acceleration_mm_s2
        self._known = False
        self._command(f"G1 {self._axes[axis].letter}{target_mm:.4f} F{60 * speed_mm_s:.3f}", self._command_s)
        self._target = (axis, target_mm)
        self._due_s = self._clock.now() + expected_s
        self._end = Deadline.after(self._clock, 1.25 * expected_s + self._command_s)
        self._next_report_s, self._missed = self._clock.now(), 0

    def poll(self) -> StageReport | None:
        """Ask where it is, five times a second at most; once the way should be done, wait for its end."""
        self._refuse_failed()
        if self._end is None or self._target is None or self._clock.now() < self._next_report_s:
            return None
        self._next_report_s = self._clock.now() + REPORT_EVERY_S
        axis, target_mm = self._target
        before = self._clock.now()
        position = self._ask()[self._index(axis)]
        after = self._clock.now()
        if abs(position - target_mm) <= 1.5 * self.limits[axis].step_mm + 0.005 and after >= self._due_s:
            self._command("M400", self._command_s)
            self._known, self._end = True, None
            self._arrived[axis] = position
        elif self._end.passed:
            self._end = None
            raise StageError(f"{self._link.port}: no end of the motion in time; its position is unknown")
        return StageReport(
            time_s=(before + after) / 2,
            uncertainty_s=(after - before) / 2,
            position_mm=position,
            state="Run" if self._end else "Idle",
            override_percent=None,
        )

    def position(self, axis: Axis) -> float | None:
        """As reported last at the end of a motion along it."""
        return self._arrived.get(axis) if self._known else None

    def halt(self) -> str | None:
        """`M410`: brake; the position is lost."""
        if not self._link.is_open:
            return None
        self._known, self._end = False, None
        try:
            self._link.write(b"M410\n")
            self._link.read_line(Deadline.after(self._clock, self._command_s))
        except LinkLostError:
            self._link.try_write(b"M112\n")
            return f"{self._link.port} is gone: THE STAGE MAY STILL BE MOVING, its position is unknown; switch it off"
        self._failed = "it was stopped"
        return "the stage was stopped, its position is lost: it must be homed"

    def abort(self) -> None:
        """Emergency stop."""
        self._known = False
        self._link.try_write(b"M112\n")

    def close(self) -> None:
        """Let go of the line."""
        self._link.close()
        self._known = False
        self._still()

    def _check_settings(self) -> None:
        steps = self._identity.get("M92", "")
        for name, axis in self._axes.items():
            found = re.search(rf"{axis.letter}([\d.]+)", steps)
            if found is not None and abs(float(found[1]) - axis.steps_per_mm) > 1e-3 * axis.steps_per_mm:
                raise StageError(
                    f"{self._link.port}: {steps}, but the configuration says steps_per_mm={axis.steps_per_mm:g} "
                    f"for axis {name}"
                )

    def _ask(self) -> tuple[float, float, float]:
        for line in self._command("M114 R", self._command_s):
            match = _POSITION.search(line)
            if match is not None:
                return (float(match[1]), float(match[2]), float(match[3]))
        raise StageError(f"{self._link.port}: no position in the answer to M114 R")

    def _command(self, line: str, wait_s: float) -> list[str]:
        self._link.write(line.encode("ascii") + b"\n")
        deadline, said = Deadline.after(self._clock, wait_s), []
        while (answer := self._link.read_line(deadline)) is not None:
            if answer == "start":
                self._fail("the board was reset")
            if answer.startswith(("Error:", "!!")):
                self._fail(answer)
            if answer == "ok" or answer.startswith("ok "):
                return said
            if answer.startswith("echo:busy"):
                deadline = Deadline.after(self._clock, wait_s)
            said.append(answer)
        self._known = False
        raise StageError(f"{self._link.port}: no answer to {line} in {wait_s:g} s; its position is unknown")

    def _fail(self, what: str) -> None:
        self._known, self._end, self._failed = False, None, what
        raise AlarmError(f"{self._link.port}: {what}; it must be reset and homed again")

    def _refuse_failed(self) -> None:
        if self._failed is not None:
            raise AlarmError(f"{self._link.port}: {self._failed}; connect again and home it first")

    def _index(self, axis: Axis) -> int:
        return "XYZ".index(self._axes[axis].letter)
