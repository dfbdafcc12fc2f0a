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
from collections.abc import Mapping

from reflectsep.rig.motion import Point, Trace

BUFFER = 128
PLANNED = 15
"""Motions that the planner holds besides the one under way."""
BOOT_S = 1.0
LATCH_S, TELL_S = 0.0005, 0.0042
FIRST_STEP_S = 0.015
DWELL_EXTRA_S = 0.08
ALARM_S = 0.5
SLOWEST_STEPS_S = 30.5
BANNER = "\r\nGrbl 1.1h ['$' for help]\r\n"
REALTIME = b"?!~\x18\x90\x91\x92\x93\x94"
SETTINGS = {
    **{0: 10.0, 1: 25.0, 10: 1.0, 20: 0.0, 21: 0.0, 22: 0.0, 23: 0.0, 24: 60.0, 25: 500.0, 26: 250.0, 27: 1.0},
    **{100: 250.0, 101: 250.0, 102: 250.0, 110: 3000.0, 111: 3000.0, 112: 3000.0},
    **{120: 100.0, 121: 100.0, 122: 100.0, 130: 200.0, 131: 200.0, 132: 200.0},
}
_WORD = re.compile(r"([A-Z])([-+]?\d*\.?\d+)")


class Board:
    """One board.

    Args:
        settings: Changes to `SETTINGS`.
        homing_s: Least time of `$H`.
    """

    def __init__(self, settings: Mapping[int, float] | None = None, *, homing_s: float = 4.0) -> None:
        self.settings = {**SETTINGS, **(settings or {})}
        self.homing_s = homing_s
        self.trace = Trace()
        """Of the board's own belief; the carriage is `slip_mm` from it along X."""
        self.slip_mm = 0.0
        self.override = 100
        self.motion_lines: list[tuple[float, str]] = []
        """Every line that asked for motion, with its time: for whoever watches."""
        self._out: deque[tuple[float, bytes]] = deque()
        self._now_s = 0.0
        self._state = "Off"
        self._clear()

    def power_on(self, now_s: float) -> None:
        """Power, or the reset that opening the port causes: everything is forgotten, the position is 0."""
        self._now_s = now_s
        self.trace.jump(now_s, (0.0, 0.0, 0.0))
        self._out.clear()
        self._clear()
        self.override = 100
        self._state, self._busy_s = "Boot", now_s + BOOT_S

    def position(self, time_s: float) -> Point:
        """Where the carriage really is."""
        x, y, z = self.trace.at(time_s)
        return (x + self.slip_mm, y, z)

    @property
    def state(self) -> str:
        """As it would report it, or Boot, Dead (locked until reset)."""
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
        moving = self.trace.speed_at(self._now_s) > 0
        self.trace.jump(self._now_s, self.trace.at(self._now_s))
        if moving:
            self.slip_mm += 1.0 / self.settings[100]
        self._queue.clear()
        self._buffer.clear()
        self._dwell_s = self._homing = None
        self._say(f"ALARM:{code}")
        self._state = "Dead" if dead else "Alarm"
        self._deaf_s = self._now_s + ALARM_S

    def _clear(self) -> None:
        self._buffer = bytearray()
        self._queue: deque[tuple[Point, float]] = deque()
        self._planned: Point | None = None
        self._feed: float | None = None
        self._absolute, self._motion = True, 1
        self._dwell_s: float | None = None
        self._homing: float | None = None
        self._held: tuple[Point, float] | None = None
        self._current: tuple[Point, float] | None = None
        self._busy_s = self._now_s
        self._deaf_s = -math.inf

    def _next_s(self) -> float | None:
        """When something happens next by itself."""
        times = []
        if self._state == "Boot":
            return self._busy_s
        if self._homing is not None:
            return self._homing
        if self._state == "Hold:1" or (self._current is not None and self._state in ("Run", "Jog")):
            times.append(self.trace.end_s)
        if self._dwell_s is not None:
            times.append(self._dwell_s)
        elif self._line_ready():
            times.append(max(self._busy_s, self._now_s))
        return min(times, default=None)

    def _happen(self) -> bool:
        now = self._now_s
        if self._state == "Boot":
            self._out.append((now, BANNER.encode()))
            self._state = "Alarm" if self.settings[22] == 1 else "Idle"
            if self._state == "Alarm":
                self._say("[MSG:'$H'|'$X' to unlock]")
            return True
        if self._homing is not None:
            self._homed()
            return True
        if self._state == "Hold:1" and self.trace.end_s <= now:
            self._state = "Hold:0"
            return True
        if self._current is not None and self._state in ("Run", "Jog") and self.trace.end_s <= now:
            self._current = None
            self._start_next()
            return True
        if self._dwell_s is not None and self._dwell_s <= now:
            self._dwell_s = None
            self._say("ok")
            return True
        if self._dwell_s is None and self._line_ready() and self._busy_s <= now:
            self._take_line()
            return True
        return False

    def _line_ready(self) -> bool:
        """Whether a line can be taken: a dwell waits for the end of all motion, and what comes after it waits too."""
        if b"\n" not in self._buffer or self._state in ("Dead", "Off") or len(self._queue) >= PLANNED:
            return False
        waits = self._current is not None or self._queue or self._held
        return not (waits and self._buffer.lstrip()[:2].upper() == b"G4")

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
        words = _WORD.findall(line)
        if "".join(a + b for a, b in words) != line:
            return "error:1" if not line[0].isalpha() else "error:2"
        return self._gcode([(letter, float(value)) for letter, value in words])

    def _gcode(self, words: list[tuple[str, float]]) -> str:
        machine, axes, dwell = False, {}, None
        for letter, value in words:
            if letter == "G" and value in (0, 1):
                self._motion = int(value)
            elif letter == "G" and value in (90, 91):
                self._absolute = value == 90
            elif letter == "G" and value == 53:
                machine = True
            elif letter == "G" and value == 4:
                dwell = 0.0
            elif letter == "G" and value in (21, 94):
                pass
            elif letter == "F":
                self._feed = value / 60.0
            elif letter == "P" and dwell is not None:
                dwell = value
            elif letter in "XYZ":
                axes[letter] = value
            else:
                return "error:20"
        if dwell is not None:
            self._dwell_s = self._now_s + dwell + DWELL_EXTRA_S
            return ""
        return self._plan(axes, self._absolute or machine) if axes else "ok"

    def _plan(self, axes: Mapping[str, float], absolute: bool) -> str:
        if self._motion == 1 and not self._feed:
            return "error:22"
        base = self._planned if self._planned is not None else self.trace.at(self._now_s)
        x, y, z = (base[i] if a not in axes else axes[a] + (0.0 if absolute else base[i]) for i, a in enumerate("XYZ"))
        self.motion_lines.append((self._now_s, str(dict(axes))))
        if self.settings[20] == 1 and not all(
            -self.settings[130 + i] - 1e-6 <= v <= 1e-6 for i, v in enumerate((x, y, z))
        ):
            self.alarm(2, dead=True)
            return ""
        fastest = min(self.settings[110 + i] for i, a in enumerate("XYZ") if a in axes) / 60.0
        speed = min(fastest, self._feed or fastest) if self._motion == 1 else fastest
        self._planned = (x, y, z)
        self._queue.append(((x, y, z), speed))
        if self._current is None and self._held is None:
            self._start_next()
        return "ok"

    def _start_next(self) -> None:
        if not self._queue:
            self._planned = None
            if self._state in ("Run", "Jog"):
                self._state = "Idle"
            return
        self._current = target, speed = self._queue.popleft()
        self._state = "Run"
        self.trace.move(self._now_s + FIRST_STEP_S, target, self._true_speed(speed), self.settings[120])

    def _true_speed(self, speed: float) -> float:
        """What the step timer makes of it."""
        return max(speed * self.override / 100.0, SLOWEST_STEPS_S / self.settings[100])

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
        if line == "$X":
            self._state = "Idle" if self._state == "Alarm" else self._state
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
        if byte == b"\x18":
            self._reset()
        elif self._homing is not None or self._state == "Dead" or self._now_s < self._deaf_s:
            return
        elif byte == b"?":
            self._report()
        elif byte == b"!" and self._state in ("Run", "Idle", "Jog"):
            self._hold()
        elif byte == b"~" and self._state == "Hold:0":
            self._state = "Run"
            if self._held is not None:
                self._queue.appendleft(self._held)
                self._held = None
            self._start_next()
        elif byte in b"\x90\x91\x92\x93\x94":
            step = {0x90: 100 - self.override, 0x91: 10, 0x92: -10, 0x93: 1, 0x94: -1}[byte[0]]
            self.override = min(200, max(10, self.override + step))

    def _hold(self) -> None:
        if self._current is None:
            self._state = "Hold:0"
            return
        self._held, self._current = self._current, None
        self.trace.stop(self._now_s, self.settings[120])
        self._state = "Hold:1"

    def _reset(self) -> None:
        moving = self.trace.speed_at(self._now_s) > 0 or (self._current is not None and self._state == "Run")
        if self._homing is not None:
            self.alarm(6, dead=False)
        elif moving:
            self.alarm(3, dead=False)
        locked, dead = self._state in ("Alarm", "Dead"), self._state == "Dead"
        self._clear()
        self._state = "Alarm" if (locked and self.settings[22] == 1) or moving else "Idle"
        self._out.append((self._now_s + 0.01, BANNER.encode()))
        if self._state == "Alarm":
            self._out.append((self._now_s + 0.011, b"[MSG:'$H'|'$X' to unlock]\r\n"))
        if dead:
            self._out.append((self._now_s + 0.02, b"ok\r\n"))  # to the motion that the alarm cut off

    def _report(self) -> None:
        at = self._now_s + LATCH_S
        steps = self.settings[100]
        x, y, z = (round(v * steps) / steps for v in self.trace.at(at))
        speed = 60.0 * self.trace.speed_at(at)
        text = f"<{self._state}|MPos:{x:.3f},{y:.3f},{z:.3f}|FS:{speed:.0f},0|Ov:{self.override},100,100>\r\n"
        self._out.append((self._now_s + TELL_S, text.encode()))

    def _say(self, text: str) -> None:
        # Lines leave in order, each after the ones before it.
        last = self._out[-1][0] if self._out else self._now_s
        self._out.append((max(self._now_s, last), f"{text}\r\n".encode()))
