"""A GRBL 1.1 board in software: bytes in, bytes out, and the way that its carriage really takes.

It behaves as the firmware was measured to: it is deaf while it boots; its receive buffer holds 128 bytes and drops the
rest without a word; `ok` to a motion means buffered, the first step comes later; a position is latched 0.5 ms after
`?` and told 4 ms later; homing and alarms answer nothing; slower than 30.5 steps a second it runs too fast. It knows
nothing of who drives it. Time is given from outside, and only goes forward.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Mapping, Sequence

from reflectsep.rig.gcode import Dwell, Interpreter, Move, Refused
from reflectsep.rig.motion import Point, Trace
from reflectsep.rig.planner import Planner
from reflectsep.rig.reports import Reports, Seen

BUFFER = 128
BOOT_S, RESTART_S = 1.0, 0.01
LATCH_S, TELL_S = 0.0005, 0.0042
DWELL_EXTRA_S = 0.08
ALARM_S = 0.5
"""For which an alarm blocks everything; a reset that comes meanwhile after a limit was met is forgotten."""
BANNER = "\r\nGrbl 1.1h ['$' for help]\r\n"
REALTIME = b"?!~\x18\x84\x90\x91\x92\x93\x94"
SETTINGS = {
    **{0: 10.0, 1: 25.0, 10: 1.0, 13: 0.0, 20: 0.0, 21: 0.0, 22: 0.0, 23: 0.0, 24: 60.0, 25: 500.0, 26: 250.0, 27: 1.0},
    **{100: 250.0, 101: 250.0, 102: 250.0, 110: 3000.0, 111: 3000.0, 112: 3000.0},
    **{120: 100.0, 121: 100.0, 122: 100.0, 130: 200.0, 131: 200.0, 132: 200.0},
}


class Board:
    """One board.

    Args:
        settings: Changes to `SETTINGS`.
        homing_s: Least time of `$H`.
        startup: Lines that it runs by itself after a reset.
    """

    def __init__(
        self, settings: Mapping[int, float] | None = None, *, homing_s: float = 4.0, startup: Sequence[str] = ()
    ) -> None:
        self.settings = {**SETTINGS, **(settings or {})}
        self.homing_s, self.startup = homing_s, tuple(startup)
        self.planner = Planner(self.settings)
        self.slip_mm = 0.0
        """Of the carriage from where the board believes it to be, along X."""
        self.motion_lines: list[tuple[float, str]] = []
        """Every line that asked for motion, with its time: for whoever watches."""
        self._out: deque[tuple[float, bytes]] = deque()
        self._now_s = 0.0
        self._state = "Off"
        self._restart(0.0, locked=False)
        self._state = "Off"

    @property
    def trace(self) -> Trace:
        """Of the board's own belief; the carriage is `slip_mm` from it along X."""
        return self.planner.trace

    @property
    def override(self) -> int:
        """Of the feed, in per cent."""
        return self.planner.override

    @override.setter
    def override(self, percent: int) -> None:
        self.planner.override = percent
        self._reports.tell_overrides()

    def power_on(self, now_s: float) -> None:
        """Power, or the reset that opening the port causes: everything is forgotten, the position is 0."""
        self._now_s = now_s
        self.trace.jump(now_s, (0.0, 0.0, 0.0))
        self._out.clear()
        self._restart(BOOT_S, locked=self.settings[22] == 1)

    def position(self, time_s: float) -> Point:
        """Where the carriage really is."""
        x, y, z = self.trace.at(time_s)
        return (x + self.slip_mm, y, z)

    @property
    def state(self) -> str:
        """As it would report it, or Off, Boot, Dead (locked until reset)."""
        return self._state

    def receive(self, data: bytes, now_s: float) -> None:
        """Bytes from the line."""
        self.advance(now_s)
        for byte in data:
            if self._state in ("Off", "Boot"):
                continue
            one = bytes([byte])
            if one in REALTIME:
                self._realtime(one)
            elif len(self._buffer) < BUFFER:
                self._buffer += one
        self.advance(now_s)

    def transmit(self, now_s: float) -> bytes:
        """Bytes that have left the board by now."""
        self.advance(now_s)
        out = b""
        while self._out and self._out[0][0] <= now_s:
            out += self._out.popleft()[1]
        return out

    def advance(self, now_s: float) -> None:
        """Let time pass."""
        now_s = max(now_s, self._now_s)
        while True:
            event_s = self._next_s()
            if event_s is None or event_s > now_s:
                break
            self._now_s = max(self._now_s, event_s)
            if not self._happen():
                break
        self._now_s = now_s

    def alarm(self, code: int, *, dead: bool) -> None:
        """Lock, as a limit switch or a soft limit does; `dead`: until a reset."""
        if self.planner.stop(self._now_s):
            self.slip_mm += 1.0 / self.settings[100]
        self._buffer.clear()
        self._dwell_s = self._homing = None
        self._say(f"ALARM:{code}")
        self._state = "Dead" if dead else "Alarm"
        self._deaf_s = self._now_s + ALARM_S
        if dead:
            self._say("[MSG:Reset to continue]", at_s=self._deaf_s)

    def _restart(self, after_s: float, *, locked: bool) -> None:
        """Everything but the position and the settings is forgotten."""
        self._buffer = bytearray()
        self._interpreter = Interpreter()
        self.planner.clear()
        self.planner.override = 100
        self._dwell_s: float | None = None
        self._homing: float | None = None
        self._deaf_s = -math.inf
        self._reports = Reports()
        self._stale = False
        self._state, self._locked, self._busy_s = "Boot", locked, self._now_s + after_s

    def _next_s(self) -> float | None:
        """When something happens next by itself."""
        if self._state == "Boot":
            return self._busy_s
        if self._homing is not None:
            return self._homing
        times = []
        if self._state in ("Hold:1", "Door:2") or (self.planner.current is not None and self._state in ("Run", "Jog")):
            times.append(self.trace.end_s)
        if self._dwell_s is not None:
            times.append(self._dwell_s)
        elif self._line_ready():
            times.append(max(self._busy_s, self._now_s))
        return min(times, default=None)

    def _happen(self) -> bool:
        now = self._now_s
        if self._state == "Boot":
            self._booted()
        elif self._homing is not None:
            self._homed()
        elif self._state in ("Hold:1", "Door:2") and self.trace.end_s <= now:
            self._state = self._state[:-1] + "0"
        elif self.planner.current is not None and self._state in ("Run", "Jog") and self.trace.end_s <= now:
            self._go_on()
        elif self._dwell_s is not None and self._dwell_s <= now:
            self._dwell_s = None
            self._say("ok")
        elif self._dwell_s is None and self._line_ready() and self._busy_s <= now:
            self._take_line()
        else:
            return False
        return True

    def _booted(self) -> None:
        self._out.append((self._now_s, BANNER.encode()))
        self._state = "Alarm" if self._locked else "Idle"
        if self._locked:
            self._say("[MSG:'$H'|'$X' to unlock]")
        if self._stale:
            self._say("ok")  # to the motion that the alarm cut off
        if self._locked:
            return
        for line in self.startup:
            self._execute(line)
            self._say(f">{line}:ok")

    def _go_on(self) -> None:
        self.planner.go_on(self._now_s)
        self._state = "Idle" if self.planner.current is None else "Run"

    def _line_ready(self) -> bool:
        """Whether a line can be taken: a dwell waits for the end of all motion, and what comes after it waits too."""
        if b"\n" not in self._buffer or self._state in ("Dead", "Off", "Sleep") or self.planner.full:
            return False
        return not (self.planner.waits and self._buffer.lstrip()[:2].upper() == b"G4")

    def _take_line(self) -> None:
        end = self._buffer.index(b"\n")
        line = bytes(self._buffer[:end]).decode("latin1").strip().upper()
        del self._buffer[: end + 1]
        self._busy_s = self._now_s + 0.002
        answer = self._execute(line.replace(" ", ""))
        if answer:
            self._say(answer)

    def _execute(self, line: str) -> str:
        if not line:
            return "ok"
        if line.startswith("$"):
            return self._dollar(line)
        if self._state in ("Alarm", "Dead"):
            return "error:9"
        asked = self._interpreter.read(line)
        if isinstance(asked, Refused):
            return f"error:{asked.code}"
        if isinstance(asked, Dwell):
            self._dwell_s = self._now_s + asked.duration_s + DWELL_EXTRA_S
            return ""
        return "ok" if asked is None else self._move(asked)

    def _move(self, move: Move) -> str:
        target = move.target(self.planner.end(self._now_s))
        self.motion_lines.append((self._now_s, str(dict(move.axes))))
        if self.settings[20] == 1 and not all(
            -self.settings[130 + i] - 1e-6 <= v <= 1e-6 for i, v in enumerate(target)
        ):
            self.alarm(2, dead=True)
            return ""
        if self._state == "Check":
            return "ok"
        fastest = min(self.settings[110 + i] for i, a in enumerate("XYZ") if a in move.axes) / 60.0
        self.planner.add(self._now_s, target, min(fastest, move.feed_mm_s or fastest))
        if self.planner.current is not None and self._state == "Idle":
            self._state = "Run"
        return "ok"

    def _dollar(self, line: str) -> str:
        if line == "$H":
            return self._start_homing()
        if line == "$I":
            self._say("[VER:1.1h.20190830:]")
            self._say("[OPT:V,15,128]")
            return "ok"
        if line == "$$":
            if self._state not in ("Idle", "Alarm"):
                return "error:8"
            for number, value in sorted(self.settings.items()):
                self._say(f"${number}={value:.3f}" if number >= 24 else f"${number}={value:g}")
            return "ok"
        if line in ("$X", "$C", "$SLP"):
            before, after = {"$X": ("Alarm", "Idle"), "$C": ("Idle", "Check"), "$SLP": ("Idle", "Sleep")}[line]
            self._state = after if self._state == before else self._state
            return "ok"
        if line.startswith("$J="):
            return "error:15" if self.settings[20] == 1 else "ok"
        match = re.fullmatch(r"\$(\d+)=(-?\d+\.?\d*)", line)
        if match is None:
            return "error:3"
        self.settings[int(match[1])] = float(match[2])
        return "ok"

    def _start_homing(self) -> str:
        if self.settings[22] != 1:
            return "error:5"
        way = abs(self.position(self._now_s)[0])
        self._state = "Home"
        self._homing = self._now_s + self.homing_s + way / (self.settings[25] / 60.0)
        return ""

    def _homed(self) -> None:
        self._homing = None
        self.slip_mm = 0.0
        # The switch is at the high end, 0; it pulls off from it.
        self.trace.jump(self._now_s, (-self.settings[27], 0.0, 0.0))
        self._state = "Idle"
        self._say("ok")

    def _realtime(self, byte: bytes) -> None:
        forgotten = self._state == "Dead" and self._now_s < self._deaf_s
        if byte == b"\x18":
            self._reset() if not forgotten else None
        elif self._homing is not None or self._state == "Dead" or self._now_s < self._deaf_s:
            return
        elif byte == b"?":
            self._report()
        elif byte in b"!\x84":
            self._hold("Hold" if byte == b"!" else "Door")
        elif byte == b"~" and self._state in ("Hold:0", "Door:0"):
            self._go_on()
        elif byte in b"\x90\x91\x92\x93\x94":
            step = {0x90: 100 - self.override, 0x91: 10, 0x92: -10, 0x93: 1, 0x94: -1}[byte[0]]
            self.override = min(200, max(10, self.override + step))

    def _hold(self, state: str) -> None:
        if self._state not in ("Run", "Idle", "Jog"):
            return
        if state == "Door":
            self._say("[MSG:Check Door]")
        moving = self.planner.hold(self._now_s)
        self._state = state + (":0" if not moving else ":1" if state == "Hold" else ":2")

    def _reset(self) -> None:
        """Locked after it if it was before, or if it cut a motion off: then the board blocks first."""
        locked, dead = self._state in ("Alarm", "Dead", "Sleep"), self._state == "Dead"
        moving = self.trace.speed_at(self._now_s) > 0 or (self.planner.current is not None and self._state == "Run")
        cut = self._homing is not None or moving
        if cut:
            self.alarm(6 if self._homing is not None else 3, dead=False)
        self._restart(ALARM_S if cut else RESTART_S, locked=locked or cut)
        self._stale = dead

    def _report(self) -> None:
        at = self._now_s + LATCH_S
        steps = self.settings[100]
        seen = Seen(
            state=self._state,
            position_mm=tuple(round(v * steps) / steps for v in self.trace.at(at)),
            speed_mm_s=self.trace.speed_at(at),
            room=(self.planner.room, BUFFER - len(self._buffer)),
            override=self.override,
        )
        self._out.append((self._now_s + TELL_S, f"{self._reports.line(seen, int(self.settings[10]))}\r\n".encode()))

    def _say(self, text: str, at_s: float | None = None) -> None:
        # Lines leave in order, each after the ones before it.
        last = self._out[-1][0] if self._out else self._now_s
        self._out.append((max(self._now_s if at_s is None else at_s, last), f"{text}\r\n".encode()))
