"""A stage driven by GRBL 1.1 over a serial line.

One line at a time, each waiting for its answer: the board has no flow control and drops what overflows its 128 bytes.
`ok` to a motion means that it is buffered; the end is the `ok` to a dwell sent after it. Settings are read, never
written, and a lock is never lifted by `$X`: only homing makes a position known again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from reflectsep.errors import AlarmError, LinkLostError, SettingsError, StageError
from reflectsep.rig.axes import stage_axes, within
from reflectsep.rig.clock import Clock, Deadline, HostClock
from reflectsep.rig.devices import Axis, AxisLimits, StageReport
from reflectsep.rig.grbl_words import Status, alarm_text, code_of, error_text, parse_setting, parse_status
from reflectsep.rig.link import Opener, SerialLink

SLOWEST_STEPS_S = 31.0
"""Below 30.5 steps a second the step timer saturates: motion comes out too fast, and nothing says so."""
LATCH_S = 0.0005
"""From sending `?` to the moment whose position is reported."""
REPORT_EVERY_S = 0.2
REPORT_WAIT_S = 0.25
SILENT_REPORTS = 4
HOLD_WAIT_S = 2.0
ALARM_BLOCKS_S = 0.6
"""For 0.5 s after an alarm the board is deaf."""
RESET = b"\x18"


class GrblStage:
    """A stage on a GRBL 1.1 board.

    Args:
        port: Serial device or URL.
        axes: By axis of the picture, see `stage_axes`; positions are the machine's own (MPos).
        reference: `home`: find zero with the switches; `here`: a person has put the carriage at zero before power-on.
        baud: Bits a second.
        boot_timeout_s: For the banner after opening, which resets the board.
        command_timeout_s: For the answer to a line.
        homing_timeout_s: For `$H`, during which the board answers nothing.
        check_mm: Way from home from which homing is timed, to find steps that a stalled motor lost; 0: no check.
        clock: The session's.
        opener: Opens the port.
    """

    def __init__(  # noqa: PLR0913  (one argument a setting of the configuration)
        self,
        *,
        port: str,
        axes: Mapping[str, Mapping[str, Any]],
        reference: Literal["home", "here"] = "home",
        baud: int = 115200,
        boot_timeout_s: float = 6.0,
        command_timeout_s: float = 3.0,
        homing_timeout_s: float = 90.0,
        check_mm: float = 5.0,
        clock: Clock | None = None,
        opener: Opener | None = None,
    ) -> None:
        if reference not in ("home", "here"):
            raise SettingsError(f"stage.reference={reference}: expected home or here")
        self._clock = clock or HostClock()
        self._link = SerialLink(port, baud, self._clock, opener)
        self._axes = stage_axes(axes, "stage")
        for name, axis in self._axes.items():
            if axis.letter not in ("X", "Y", "Z"):
                raise SettingsError(f"stage.axes.{name}.letter={axis.letter}: expected X, Y or Z")
        self._boot_s, self._command_s, self._homing_s = boot_timeout_s, command_timeout_s, homing_timeout_s
        self._reference = reference
        self._check_mm = check_mm
        self._identity: dict[str, str] = {}
        self._settings: dict[int, float] = {}
        self._known = False
        self._alarm: str | None = None
        self._override: float | None = None
        self._status: Status | None = None
        self._baseline_s: float | None = None
        self._still()

    def _still(self) -> None:
        self._target: tuple[Axis, float] | None = None
        self._end: Deadline | None = None
        self._next_report_s = 0.0
        self._missed = 0

    @property
    def limits(self) -> Mapping[Axis, AxisLimits]:
        """By the configuration."""
        return {name: axis.limits(SLOWEST_STEPS_S) for name, axis in self._axes.items()}

    @property
    def identity(self) -> Mapping[str, str]:
        """Version and settings."""
        return dict(self._identity)

    @property
    def homes(self) -> bool:
        """Whether it finds zero by itself."""
        return self._reference == "home"

    @property
    def moving(self) -> bool:
        """Whether the dwell after the last motion has not been answered."""
        return self._end is not None

    def connect(self) -> None:
        """Open, wait for the banner, read version and settings and hold them against the configuration."""
        self._link.open()
        try:
            self._boot()
            self._read_identity()
            self._check_settings()
            status = self._ask_status(self._command_s)
            self._say_unless(status.state in ("Idle", "Alarm"), f"is in state {status.state} after a reset")
        except BaseException:
            self._link.close()
            raise

    def home(self) -> None:
        """`$H`, or taking the position that a person has prepared."""
        self._known = False
        if self._reference == "here":
            self._refuse_alarm()
            status = self._ask_status(self._command_s)
            if status.state != "Idle":
                raise StageError(
                    f"{self._link.port}: is in state {status.state}: a board with homing needs stage.reference=home"
                )
            self._known = True
            return
        self._find_home()
        self._baseline_s = None
        if self._check_mm > 0:
            self._baseline_s = self._timed_home()

    def verify(self) -> float | None:
        """How far the carriage is from where the board believes it to be, by homing again; None where it cannot.

        Homing from a known distance takes a known time; steps that a stalled motor lost make it longer or shorter.

        Raises:
            StageError: homing failed.
        """
        if self._reference == "here" or self._baseline_s is None:
            return None
        return (self._timed_home() - self._baseline_s) * self._settings[25] / 60.0

    def begin(self, axis: Axis, target_mm: float, speed_mm_s: float) -> None:
        """Send the motion and the dwell that marks its end."""
        self._refuse_alarm()
        if not self._known:
            raise StageError(f"{self._link.port}: its position is unknown: home it first")
        within(self.limits, axis, target_mm, speed_mm_s, self._link.port)
        start = self._ask_status(self._command_s)
        if start.state != "Idle":
            raise StageError(f"{self._link.port}: is in state {start.state}, expected Idle before a motion")
        way = abs(target_mm - start.position_mm[self._index(axis)])
        limits = self.limits[axis]
        expected_s = way / speed_mm_s + speed_mm_s / limits.acceleration_mm_s2
        letter = self._axes[axis].letter
        self._known = False  # until the motion has been seen to end where it should
        self._command(f"G53 G1 {letter}{target_mm:.4f} F{60 * speed_mm_s:.3f}", self._command_s)
        self._link.write(b"G4 P0.01\n")
        self._target = (axis, target_mm)
        self._end = Deadline.after(self._clock, 1.25 * expected_s + self._command_s)
        self._next_report_s, self._missed = self._clock.now(), 0

    def poll(self) -> StageReport | None:
        """Ask where it is, five times a second at most; notice the end of the motion."""
        self._refuse_alarm()
        if self._end is None:
            return None
        report = None
        if self._clock.now() >= self._next_report_s:
            self._next_report_s = self._clock.now() + REPORT_EVERY_S
            report = self._report()
        while (line := self._link.read_line(Deadline.after(self._clock, 0.0))) is not None:
            self._sort_answer(line)
        if self._end is not None and self._end.passed:
            self._end = None
            raise StageError(f"{self._link.port}: no end of the motion in time; its position is unknown")
        return report

    def halt(self) -> str:
        """`!`, wait for the end of the deceleration, then reset: so the position is kept."""
        if not self._link.is_open:
            return "the stage is not connected"
        was_known = self._known or self._end is not None
        self._known = False
        self._end = None
        try:
            held = self._alarm is None and self._held()
            self._link.write(RESET)
            self._await_banner(Deadline.after(self._clock, self._boot_s))
        except LinkLostError:
            self._link.try_write(RESET)
            return f"{self._link.port} is gone: THE STAGE MAY STILL BE MOVING, its position is unknown; switch it off"
        except StageError:
            return f"{self._link.port} does not answer: THE STAGE MAY STILL BE MOVING, its position is unknown"
        self._known = held and was_known and self._alarm is None
        self._alarm = None if self._known else self._alarm or "the board was reset"
        return f"the stage stands still, its position is {'known' if self._known else 'lost: it must be homed'}"

    def abort(self) -> None:
        """Reset at once."""
        self._known = False
        self._link.try_write(RESET)

    def close(self) -> None:
        """Let go of the line."""
        self._link.close()
        self._known = False
        self._still()

    def _boot(self) -> None:
        """Wait for the banner; ask for it by a reset where opening the port did not reset the board."""
        seen: list[str] = []
        half = Deadline.after(self._clock, self._boot_s / 2)
        if not self._saw_banner(half, seen):
            self._link.write(RESET)
            if not self._saw_banner(Deadline.after(self._clock, self._boot_s / 2), seen):
                found = f"it says {seen[0][:60]!r}" if seen else "it is silent"
                raise StageError(f"{self._link.port}: no GRBL banner in {self._boot_s:g} s: {found}; not a GRBL board?")
        self._settle()

    def _saw_banner(self, deadline: Deadline, seen: list[str]) -> bool:
        while (line := self._link.read_line(deadline)) is not None:
            if line.startswith("Grbl 1."):
                return True
            if line:
                seen.append(line)
        return False

    def _settle(self) -> None:
        """Let what follows the banner (a lock's message, a stale `ok`) come and go."""
        quiet = Deadline.after(self._clock, 0.2)
        while self._link.read_line(quiet) is not None:
            pass

    def _await_banner(self, deadline: Deadline) -> None:
        if not self._saw_banner(deadline, []):
            raise StageError(f"{self._link.port}: no answer to a reset")
        self._settle()

    def _read_identity(self) -> None:
        lines = self._command("$I", self._command_s)
        version = [line for line in lines if line.startswith("[VER:")]
        self._say_unless(bool(version), "does not tell its version")
        for line in self._command("$$", self._command_s):
            if (pair := parse_setting(line)) is not None:
                self._settings[pair[0]] = pair[1]
        self._identity = {"version": version[0].strip("[]")}
        self._identity |= {f"${number}": f"{value:g}" for number, value in sorted(self._settings.items())}
        # The units and the kind of distance are not kept over a reset.
        self._command("G21 G90 G94", self._command_s, locked_is_fine=True)

    def _check_settings(self) -> None:
        """The controller's own numbers against the configured ones."""
        if int(self._settings.get(10, 1)) & 1 == 0 or self._settings.get(13, 0) != 0:
            raise StageError(f"{self._link.port}: must report machine positions in mm: expected an odd $10, and $13=0")
        for name, axis in self._axes.items():
            index = self._index(name)
            low, high = axis.travel_mm
            steps, speed, acceleration, travel = (
                self._settings.get(100 + index + 10 * row, float("nan")) for row in range(4)
            )
            where = f"{self._link.port}: axis {axis.letter}"
            self._match(where, f"${100 + index}", steps, axis.steps_per_mm, "steps_per_mm")
            self._match(where, f"${120 + index}", acceleration, axis.acceleration_mm_s2, "acceleration_mm_s2")
            if not speed / 60.0 >= axis.max_speed_mm_s * (1 - 1e-6):
                raise StageError(
                    f"{where}: ${110 + index}={speed:g} mm/min is {speed / 60:g} mm/s, less than "
                    f"max_speed_mm_s={axis.max_speed_mm_s:g}"
                )
            if self._settings.get(20) == 1 and not (-travel - 1e-6 <= low and high <= 1e-6):
                raise StageError(f"{where}: soft limits allow {-travel:g} to 0 mm, but travel_mm=[{low:g},{high:g}]")

    def _match(self, where: str, number: str, found: float, expected: float, name: str) -> None:
        if not abs(found - expected) <= 1e-3 * expected:
            raise StageError(f"{where}: {number}={found:g}, but the configuration says {name}={expected:g}")

    def _find_home(self) -> None:
        self._alarm = None
        self._command("$H", self._homing_s)
        status = self._ask_status(self._command_s)
        self._say_unless(status.state == "Idle", f"is in state {status.state} after homing, expected Idle")
        self._known = True

    def _timed_home(self) -> float:
        """Seconds that homing takes from `check_mm` off home."""
        letter_index = self._index("x")
        low, high = self._axes["x"].travel_mm
        home = self._ask_status(self._command_s).position_mm[letter_index]
        if self._baseline_s is None:
            self._check_at = home + (self._check_mm if home < (low + high) / 2 else -self._check_mm)
        self._go("x", self._check_at)
        started = self._clock.now()
        self._find_home()
        return self._clock.now() - started

    def _go(self, axis: Axis, target_mm: float) -> None:
        self.begin(axis, target_mm, self._axes[axis].max_speed_mm_s)
        while self.moving:
            self.poll()
            self._clock.sleep(0.005)

    def _held(self) -> bool:
        """Ask for a hold and wait for its end; False where none was reported in time."""
        self._link.write(b"!")
        deadline = Deadline.after(self._clock, HOLD_WAIT_S)
        while not deadline.passed:
            try:
                status = self._status_after_question(min(deadline.left_s, REPORT_WAIT_S))
            except AlarmError:
                return False
            if status is not None and status.state == "Hold:0":
                return True
            self._clock.sleep(0.02)
        return False

    def _command(self, line: str, wait_s: float, *, locked_is_fine: bool = False) -> list[str]:
        """Send one line and wait for its answer; returns what was said before it."""
        self._refuse_alarm()
        self._link.write(line.encode("ascii") + b"\n")
        deadline, said = Deadline.after(self._clock, wait_s), []
        while (answer := self._link.read_line(deadline)) is not None:
            self._notice(answer)
            if answer == "ok":
                return said
            code = code_of(answer, "error")
            if code == 9 and locked_is_fine:
                return said
            if code is not None:
                raise StageError(f"{self._link.port}: {line} was refused: {error_text(code)}")
            said.append(answer)
        self._known = False
        raise StageError(f"{self._link.port}: no answer to {line} in {wait_s:g} s; its position is unknown")

    def _notice(self, line: str) -> None:
        """What may come at any time: an alarm, or the banner of a board that was reset."""
        code = code_of(line, "ALARM")
        if code is not None:
            self._known, self._end = False, None
            self._alarm = alarm_text(code)
            raise AlarmError(f"{self._link.port}: {self._alarm}; it must be homed again")
        if line.startswith("Grbl 1."):
            self._known, self._end = False, None
            self._alarm = "the board was reset"
            raise AlarmError(f"{self._link.port}: the board was reset (power, or its button); it must be homed again")
        status = parse_status(line)
        if status is not None:
            self._status = status
            if status.override_percent is not None:
                self._override = status.override_percent
            if status.state == "Alarm" and self._end is not None:
                self._known, self._end, self._alarm = False, None, "Alarm"
                raise AlarmError(f"{self._link.port}: it is in state Alarm; it must be homed again")

    def _refuse_alarm(self) -> None:
        if self._alarm is not None:
            raise AlarmError(f"{self._link.port}: {self._alarm}; it must be reset and homed first")

    def _status_after_question(self, wait_s: float) -> Status | None:
        """Send `?`; the report, or None where none came in time."""
        self._status = None
        self._link.write(b"?")
        deadline = Deadline.after(self._clock, wait_s)
        while self._status is None and (line := self._link.read_line(deadline)) is not None:
            self._sort_answer(line)
        return self._status

    def _ask_status(self, wait_s: float) -> Status:
        deadline = Deadline.after(self._clock, wait_s)
        while True:
            status = self._status_after_question(min(REPORT_WAIT_S, max(deadline.left_s, 0.01)))
            if status is not None:
                return status
            if deadline.passed:
                raise StageError(f"{self._link.port}: no status report in {wait_s:g} s; is it frozen?")

    def _sort_answer(self, line: str) -> None:
        """A line that came while something is moving, or while a report is awaited."""
        self._notice(line)
        code = code_of(line, "error")
        if code is not None and self._end is not None:
            raise StageError(f"{self._link.port}: the motion was refused: {error_text(code)}")
        if line == "ok" and self._end is not None:
            self._end = None
            self._check_arrival()

    def _check_arrival(self) -> None:
        assert self._target is not None
        axis, target_mm = self._target
        status = self._ask_status(self._command_s)
        found = status.position_mm[self._index(axis)]
        if status.state != "Idle" or abs(found - target_mm) > 1.5 * self.limits[axis].step_mm + 0.001:
            raise StageError(
                f"{self._link.port}: the motion ended in state {status.state} at {axis} = {found:g} mm, "
                f"expected Idle at {target_mm:g} mm"
            )
        self._known = True

    def _report(self) -> StageReport | None:
        before = self._clock.now()
        self._status = None
        self._link.write(b"?")
        after = self._clock.now()
        deadline = Deadline.after(self._clock, REPORT_WAIT_S)
        axis = self._target[0] if self._target else "x"
        while self._status is None and (line := self._link.read_line(deadline)) is not None:
            self._sort_answer(line)
        status = self._status
        if status is None:
            self._missed += 1
            if self._missed >= SILENT_REPORTS:
                self._known, self._end = False, None
                raise StageError(
                    f"{self._link.port}: {self._missed} questions without a report: the board is frozen, "
                    "it may still be moving"
                )
            return None
        self._missed = 0
        return StageReport(
            time_s=(before + after) / 2 + LATCH_S,
            uncertainty_s=(after - before) / 2,
            position_mm=status.position_mm[self._index(axis)],
            state=status.state,
            override_percent=self._override,
        )

    def _index(self, axis: Axis) -> int:
        return "XYZ".index(self._axes[axis].letter)

    def _say_unless(self, holds: bool, text: str) -> None:
        if not holds:
            raise StageError(f"{self._link.port}: {text}")
