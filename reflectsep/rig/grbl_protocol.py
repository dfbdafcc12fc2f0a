"""Talking to a GRBL 1.1 board: one line at a time, each waiting for its answer; reports on request; alarms at any time.

The board has no flow control and drops what overflows its 128 bytes, so nothing is sent before the last line was
answered; `?`, `!` and the reset are single bytes outside that order. Settings are read, never written, and a lock is
never lifted by `$X`.
"""

from __future__ import annotations

from dataclasses import dataclass

from reflectsep.errors import AlarmError, StageError
from reflectsep.rig.clock import Clock, Deadline
from reflectsep.rig.grbl_words import Status, alarm_text, code_of, error_text, parse_status
from reflectsep.rig.link import SerialLink

QUESTION_EVERY_S = 0.2
"""More than five questions a second take the board's time from its motors."""
REPORT_WAIT_S = 0.25
FORGOTTEN_S = 1.0
"""After which a question that was not answered will not be."""
LATCH_S = 0.0005
"""From sending `?` to the moment whose position is reported."""
ALARM_BLOCKS_S = 0.6
"""For 0.5 s after an alarm the board is deaf, and forgets even a reset that came meanwhile."""
SETTLE_S = 0.2
RESETS = 3
HOLD_WAIT_S = 2.0
BANNER = "Grbl 1."
RESET, HOLD, QUESTION = b"\x18", b"!", b"?"


@dataclass(frozen=True, kw_only=True)
class Answered:
    """A status report, and when its position was taken."""

    status: Status
    time_s: float
    uncertainty_s: float


class GrblProtocol:
    """The conversation with one board.

    Args:
        link: To it.
        clock: For deadlines.
        boot_s: For the banner after opening the port, which resets the board, and after a reset.
        command_s: For the answer to a line.
    """

    def __init__(self, link: SerialLink, clock: Clock, *, boot_s: float, command_s: float) -> None:
        self._link, self._clock = link, clock
        self._boot_s, self._command_s = boot_s, command_s
        self.alarm: str | None = None
        """Why nothing may be sent before the board has been reset and homed."""
        self.override_percent: float | None = None
        """Of the feed, as told last: the board tells it in every tenth or twentieth report, and when it changes."""
        self._status: Status | None = None
        self._answers: list[str] = []
        self._asked: list[float] = []
        """When the questions were sent that are not answered yet, the oldest first."""
        self._question_s = self._deaf_s = -float("inf")

    @property
    def port(self) -> str:
        """Names the board in errors."""
        return self._link.port

    def boot(self) -> None:
        """Open the port and wait for the banner; ask for it by a reset where opening did not reset the board.

        Raises:
            StageError: the port cannot be opened, or nothing there says that it is GRBL 1.
        """
        self._link.open()
        seen: list[str] = []
        if not self._saw_banner(Deadline.after(self._clock, self._boot_s / 2), seen):
            self._link.write(RESET)
            if not self._saw_banner(Deadline.after(self._clock, self._boot_s / 2), seen):
                found = f"it says {seen[0][:60]!r}" if seen else "it is silent"
                raise StageError(f"{self.port}: no GRBL banner in {self._boot_s:g} s: {found}; not a GRBL board?")
        self._settle()

    def command(self, line: str, wait_s: float | None = None) -> list[str]:
        """Send one line and wait for its answer; returns what was said before it.

        Raises:
            StageError: refused, or no answer in time.
            AlarmError: the board is locked, or locked itself meanwhile.
        """
        self.refuse_alarm()
        self.send(line)
        wait_s = self._command_s if wait_s is None else wait_s
        deadline, said = Deadline.after(self._clock, wait_s), []
        while (answer := self._link.read_line(deadline)) is not None:
            self._notice(answer)
            if answer == "ok":
                return said
            code = code_of(answer, "error")
            if code is not None:
                raise StageError(f"{self.port}: {line} was refused: {error_text(code)}")
            said.append(answer)
        raise StageError(f"{self.port}: no answer to {line} in {wait_s:g} s; its position is unknown")

    def send(self, line: str) -> None:
        """Send a line whose answer comes among `answers`."""
        self._answers.clear()
        self._link.write(line.encode("ascii") + b"\n")

    def ask(self, wait_s: float = REPORT_WAIT_S) -> Answered | None:
        """Send `?`, five times a second at most; the report, or None where none came in time.

        Raises:
            AlarmError: the board locked itself, or was reset.
        """
        self._clock.sleep(max(0.0, self._question_s - self._clock.now()))
        self._listen()
        self._status = None
        before = self._clock.now()
        self._question_s = before + QUESTION_EVERY_S
        self._asked = [*(sent_s for sent_s in self._asked if before - sent_s < FORGOTTEN_S), before]
        self._link.write(QUESTION)
        after = self._clock.now()
        deadline = Deadline.after(self._clock, wait_s)
        # A report that comes late answers an earlier question, or this one: its position is of any moment between.
        since = self._asked[0]
        while self._status is None and (line := self._link.read_line(deadline)) is not None:
            self._sort(line)
        if self._status is None:
            return None
        return Answered(status=self._status, time_s=(since + after) / 2 + LATCH_S, uncertainty_s=(after - since) / 2)

    @property
    def question_due(self) -> bool:
        """Whether `ask` would not wait before it asks."""
        return self._clock.now() >= self._question_s

    def status(self) -> Status:
        """A report, asked for until it comes.

        Raises:
            StageError: none in the time of a command.
        """
        deadline = Deadline.after(self._clock, self._command_s)
        while (answered := self.ask()) is None:
            if deadline.passed:
                raise StageError(f"{self.port}: no status report in {self._command_s:g} s; is it frozen?")
        return answered.status

    def answers(self) -> list[str]:
        """`ok` and `error:N` that came since the last line was sent, each once; looks at what has come."""
        self._listen()
        taken, self._answers = self._answers, []
        return taken

    def hold(self) -> bool:
        """Ask for a hold and wait for the end of the deceleration; False where none was reported in time."""
        self._link.write(HOLD)
        deadline = Deadline.after(self._clock, HOLD_WAIT_S)
        while not deadline.passed:
            try:
                answered = self.ask(min(deadline.left_s, REPORT_WAIT_S))
            except AlarmError:
                return False
            if answered is not None and answered.status.state == "Hold:0":
                return True
        return False

    def reset(self) -> None:
        """Reset the board and wait until it has said so.

        Raises:
            StageError: it says nothing.
        """
        self._clock.sleep(max(0.0, self._deaf_s - self._clock.now()))
        for _ in range(RESETS):
            self._link.write(RESET)
            if self._saw_banner(Deadline.after(self._clock, self._boot_s / RESETS), []):
                self._asked.clear()
                self._settle()
                return
        raise StageError(f"{self.port}: no answer to a reset")

    def refuse_alarm(self) -> None:
        """Nothing is sent to a board that is locked.

        Raises:
            AlarmError: it is.
        """
        if self.alarm is not None:
            raise AlarmError(f"{self.port}: {self.alarm}; it must be reset and homed first")

    def lock(self, why: str) -> AlarmError:
        """Remember that the position is lost; returns the error that says so."""
        self.alarm = why
        return AlarmError(f"{self.port}: {why}; it must be homed again")

    def _saw_banner(self, deadline: Deadline, seen: list[str]) -> bool:
        while (line := self._link.read_line(deadline)) is not None:
            if line.startswith(BANNER):
                return True
            if line:
                seen.append(line)
        return False

    def _settle(self) -> None:
        """Let what follows the banner (a lock's message, startup lines, a stale `ok`) come and go."""
        quiet = Deadline.after(self._clock, SETTLE_S)
        while self._link.read_line(quiet) is not None:
            pass

    def _notice(self, line: str) -> None:
        """What may come at any time: an alarm, the banner of a board that was reset, a report."""
        code = code_of(line, "ALARM")
        if code is not None:
            self._deaf_s = self._clock.now() + ALARM_BLOCKS_S
            raise self.lock(alarm_text(code))
        if line.startswith(BANNER):
            raise self.lock("the board was reset (power, or its button)")
        status = parse_status(line)
        if status is not None:
            self._status = status
            del self._asked[:1]
            if status.override_percent is not None:
                self.override_percent = status.override_percent

    def _listen(self) -> None:
        """Take in what has come, without waiting."""
        while (line := self._link.read_line(Deadline.after(self._clock, 0.0))) is not None:
            self._sort(line)

    def _sort(self, line: str) -> None:
        """A line that came while no command was waiting for it."""
        self._notice(line)
        if line == "ok" or code_of(line, "error") is not None:
            self._answers.append(line)
