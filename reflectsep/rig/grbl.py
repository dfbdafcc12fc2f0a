"""A stage driven by GRBL 1.1 over a serial line.

`ok` to a motion means that it is buffered; the end is the `ok` to a dwell sent after it. Only homing makes a position
known again that was lost.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from reflectsep.errors import LinkLostError, SettingsError, StageError
from reflectsep.rig.axes import stage_axes, within
from reflectsep.rig.clock import Clock, Deadline, HostClock
from reflectsep.rig.devices import Axis, AxisLimits, StageReport
from reflectsep.rig.grbl_protocol import RESET, GrblProtocol
from reflectsep.rig.grbl_settings import check_settings, read_settings
from reflectsep.rig.grbl_words import Status, code_of, error_text
from reflectsep.rig.link import Opener, SerialLink

SLOWEST_STEPS_S = 31.0
"""Below 30.5 steps a second the step timer saturates: motion comes out too fast, and nothing says so."""
SILENT_REPORTS = 4


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
        self._board = GrblProtocol(self._link, self._clock, boot_s=boot_timeout_s, command_s=command_timeout_s)
        self._command_s, self._homing_s = command_timeout_s, homing_timeout_s
        self._reference = reference
        self._check_mm = check_mm
        self._identity: dict[str, str] = {}
        self._settings: dict[int, float] = {}
        self._known = False
        self._homing = False
        self._baseline_s: float | None = None
        self._arrived: dict[Axis, float] = {}
        self._still()

    def _still(self) -> None:
        self._target: tuple[Axis, float] | None = None
        self._end: Deadline | None = None
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
        return self._end is not None and self._board.alarm is None

    def connect(self) -> None:
        """Open, wait for the banner, read version and settings and hold them against the configuration."""
        try:
            self._board.boot()
            version, self._settings = read_settings(self._board)
            self._identity = {"version": version}
            self._identity |= {f"${number}": f"{value:g}" for number, value in sorted(self._settings.items())}
            check_settings(self._settings, self._axes, self._link.port)
            state = self._board.status().state
            if state not in ("Idle", "Alarm"):
                raise StageError(f"{self._link.port}: is in state {state} after a reset, expected Idle or Alarm")
        except BaseException:
            self._link.close()
            raise

    def home(self) -> None:
        """`$H`, or taking the position that a person has prepared."""
        self._known = False
        if self._reference == "here":
            self._board.refuse_alarm()
            state = self._board.status().state
            if state != "Idle":
                raise StageError(
                    f"{self._link.port}: is in state {state}: a board with homing needs stage.reference=home; without "
                    "it, put the carriage at zero and switch the board off and on"
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
        self._board.refuse_alarm()
        if not self._known:
            raise StageError(f"{self._link.port}: its position is unknown: home it first")
        within(self.limits, axis, target_mm, speed_mm_s, self._link.port)
        start = self._board.status()
        if start.state != "Idle":
            raise StageError(f"{self._link.port}: is in state {start.state}, expected Idle before a motion")
        way = abs(target_mm - start.position_mm[self._index(axis)])
        limits = self.limits[axis]
        expected_s = way / speed_mm_s + speed_mm_s / limits.acceleration_mm_s2
        letter = self._axes[axis].letter
        self._known = False  # until the motion has been seen to end where it should
        # Millimetres and feed a minute are said every time: a startup line of the board's may have set others.
        self._board.command(f"G21 G94 G53 G1 {letter}{target_mm:.4f} F{60 * speed_mm_s:.3f}")
        self._board.send("G4 P0.01")
        self._target = (axis, target_mm)
        self._end = Deadline.after(self._clock, 1.25 * expected_s + self._command_s)
        self._missed = 0

    def poll(self) -> StageReport | None:
        """Ask where it is, five times a second at most; notice the end of the motion."""
        self._board.refuse_alarm()
        if self._end is None:
            return None
        report = self._report() if self._board.question_due else None
        for answer in self._board.answers():
            self._take_answer(answer)
        if self._end is not None and self._end.passed:
            self._end = None
            raise StageError(f"{self._link.port}: no end of the motion in time; its position is unknown")
        return report

    def position(self, axis: Axis) -> float | None:
        """As reported at the end of the last motion along it."""
        return self._arrived.get(axis) if self._known else None

    def halt(self) -> str | None:
        """`!`, wait for the end of the deceleration, then reset: so the position is kept."""
        if not self._link.is_open:
            return None
        was_known = self._known or self._end is not None
        self._known = False
        self._end = None
        try:
            # While it homes only a reset stops it; after an alarm it stands still already.
            held = self._board.alarm is None and not self._homing and self._board.hold()
            self._board.reset()
        except LinkLostError:
            self._link.try_write(RESET)
            return f"{self._link.port} is gone: THE STAGE MAY STILL BE MOVING, its position is unknown; switch it off"
        except StageError:
            return f"{self._link.port} does not answer: THE STAGE MAY STILL BE MOVING, its position is unknown"
        self._homing = False
        self._known = held and was_known and self._board.alarm is None
        self._board.alarm = None if self._known else self._board.alarm or "the board was reset"
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

    def _find_home(self) -> None:
        self._board.alarm, self._known, self._homing = None, False, True
        self._arrived.clear()
        self._board.command("$H", self._homing_s)
        self._homing = False
        state = self._board.status().state
        if state != "Idle":
            raise StageError(f"{self._link.port}: is in state {state} after homing, expected Idle")
        self._known = True

    def _timed_home(self) -> float:
        """Seconds that homing takes from `check_mm` off home."""
        low, high = self._axes["x"].travel_mm
        home = self._board.status().position_mm[self._index("x")]
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

    def _take_answer(self, answer: str) -> None:
        """`ok` or an error to the dwell behind a motion."""
        code = code_of(answer, "error")
        if self._end is None:
            return
        if code is not None:
            raise StageError(f"{self._link.port}: the motion was refused: {error_text(code)}")
        self._end = None
        self._check_arrival()

    def _check_arrival(self) -> None:
        assert self._target is not None
        axis, target_mm = self._target
        status = self._board.status()
        found = status.position_mm[self._index(axis)]
        if status.state != "Idle" or abs(found - target_mm) > 1.5 * self.limits[axis].step_mm + 0.001:
            raise StageError(
                f"{self._link.port}: the motion ended in state {status.state} at {axis} = {found:g} mm, "
                f"expected Idle at {target_mm:g} mm"
            )
        self._arrived[axis] = found
        self._known = True

    def _report(self) -> StageReport | None:
        answered = self._board.ask()
        if answered is None:
            self._missed += 1
            if self._missed >= SILENT_REPORTS:
                self._end = None
                raise StageError(
                    f"{self._link.port}: {self._missed} questions without a report: the board is frozen, "
                    "it may still be moving"
                )
            return None
        self._missed = 0
        self._check_moving(answered.status)
        return StageReport(
            time_s=answered.time_s,
            uncertainty_s=answered.uncertainty_s,
            position_mm=answered.status.position_mm[self._index(self._target[0] if self._target else "x")],
            state=answered.status.state,
            override_percent=self._board.override_percent,
        )

    def _check_moving(self, status: Status) -> None:
        """Somebody's hand on the hold button, an open door, another program: the motion is not what was asked for."""
        if status.state == "Alarm":
            self._end = None
            raise self._board.lock("it is in state Alarm")
        if status.state not in ("Run", "Idle"):
            raise StageError(f"{self._link.port}: is in state {status.state} in the middle of a motion, expected Run")

    def _index(self, axis: Axis) -> int:
        return "XYZ".index(self._axes[axis].letter)
