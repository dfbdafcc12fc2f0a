"""Lights and the second stage protocol, against small controllers in simulated time."""

import sys

import pytest

from reflectsep.errors import AlarmError, LightsError, RigError, StageError
from reflectsep.rig.clock import VirtualClock
from reflectsep.rig.lights import CommandLights, ManualLights, SerialLights, ask_terminal
from reflectsep.rig.marlin import MarlinStage

from .conftest import AXIS


class Controller:
    """A device that answers lines; `answer(line)` gives its lines."""

    def __init__(self, clock, answer, greeting=b""):
        self._clock, self._answer = clock, answer
        self._in, self._out = b"", greeting
        self.lines = []

    @property
    def in_waiting(self):
        return len(self._out)

    def read(self, size):
        if not self._out:
            self._clock.sleep(0.01)
        out, self._out = self._out[:size], self._out[size:]
        return out

    def write(self, data):
        self._in += data
        while b"\n" in self._in:
            line, self._in = self._in.split(b"\n", 1)
            self.lines.append(line.decode())
            self._out += "".join(f"{text}\n" for text in self._answer(line.decode())).encode()

    def flush(self):
        pass

    def reset_input_buffer(self):
        self._out = b""

    def close(self):
        pass


class Switchboard:
    """Which light is on; `stuck` stays on whatever it is told."""

    def __init__(self):
        self.on, self.stuck, self.silent = "off", None, False

    def __call__(self, line):
        if self.silent:
            return []
        if line == "?":
            return [self.stuck or self.on]
        self.on = line.removeprefix("ON ") if line.startswith("ON ") else "off"
        return ["ok"]


def serial_lights():
    clock, board = VirtualClock(), Switchboard()
    line = Controller(clock, board)
    return SerialLights(port="p", clock=clock, opener=lambda _port, **options: line), board, line


def test_serial_lights_switch_read_back_and_are_off_at_the_end():
    lights, board, line = serial_lights()
    board.on = "L9"
    lights.connect()
    assert board.on == "off"
    assert lights.switch("L2") == board.on == "L2"
    assert lights.switch(None) == "off"
    lights.switch("L3")
    lights.close()
    assert board.on == "off"
    assert line.lines[-2:] == ["?", "OFF"]


def test_serial_lights_that_say_otherwise_are_not_believed():
    lights, board, _ = serial_lights()
    lights.connect()
    board.stuck = "L1"
    with pytest.raises(LightsError, match="p: L2 was asked for, but 'L1' is on"):
        lights.switch("L2")
    board.silent = True
    with pytest.raises(LightsError, match="no answer to 'ON L2' in 2 s"):
        lights.switch("L2")


def test_a_light_is_one_line_of_ascii():
    lights, _, line = serial_lights()
    lights.connect()
    sent = len(line.lines)
    with pytest.raises(LightsError, match="one line of ASCII"):
        lights.switch("L1\nON L2")
    assert len(line.lines) == sent


def test_command_lights_hand_the_name_over_whole_and_read_back(tmp_path):
    state = tmp_path / "state"
    write = f"import sys; open({str(state)!r}, 'w').write(sys.argv[1])"
    read = f"print(open({str(state)!r}).read())"
    lights = CommandLights(
        on=[sys.executable, "-c", write, "{light}"],
        off=[sys.executable, "-c", write, "off"],
        query=[sys.executable, "-c", read],
    )
    lights.connect()
    assert lights.switch("a b; c") == "a b; c"
    state.write_text("L7")
    broken = CommandLights(on=["true"], off=["true"], query=[sys.executable, "-c", read])
    with pytest.raises(LightsError, match="L1 was asked for, but 'L7' is on"):
        broken.switch("L1")
    assert CommandLights(on=["true"], off=["true"]).switch("L1") is None
    with pytest.raises(LightsError, match="exit code 1"):
        CommandLights(on=["false"], off=["true"]).switch("L1")


def test_manual_lights_say_what_to_do_once():
    asked = []
    lights = ManualLights(ask=asked.append)
    lights.connect()
    assert lights.switch("L2") is None
    lights.switch("L2")
    lights.switch(None)
    assert asked == ["switch light L2 on and all others off", "switch all lights off"]


def test_manual_lights_need_somebody(monkeypatch, tmp_path):
    with open(tmp_path / "empty", "w+") as nobody:
        monkeypatch.setattr(sys, "stdin", nobody)
        with pytest.raises(LightsError, match="manual lights need a terminal"):
            ask_terminal("switch light L1 on")


class Printer:
    """A Marlin board whose motion takes its time."""

    def __init__(self, clock):
        self.clock, self.at, self.target, self.speed, self.since = clock, 0.0, 0.0, 1.0, 0.0
        self.killed = False

    def now(self):
        way = self.target - self.at
        gone = self.speed * (self.clock.now() - self.since)
        return self.target if gone >= abs(way) else self.at + gone * (1 if way > 0 else -1)

    def __call__(self, line):
        if self.killed:
            return ["Error:Printer halted. kill() called!"]
        if line.startswith("G1"):
            self.at, self.since = self.now(), self.clock.now()
            words = {word[0]: float(word[1:]) for word in line.split()[1:]}
            self.target, self.speed = words["X"], words["F"] / 60
        if line.startswith("G28"):
            self.at = self.target = 0.0
        if line == "M115":
            return ["FIRMWARE_NAME:Marlin 2.1 UUID:x", "ok"]
        if line.startswith("M503"):
            return ["M92 X250.00 Y250.00 Z400.00", "ok"]
        if line == "M114 R":
            return [f"X:{self.now():.3f} Y:0.000 Z:0.000 E:0.0", "ok"]
        if line == "M410":
            self.at = self.target = self.now()
        return ["ok"]


def marlin(axis=AXIS):
    clock = VirtualClock()
    printer = Printer(clock)
    line = Controller(clock, printer, greeting=b"start\nMarlin 2.1\n")
    stage = MarlinStage(port="p", axes={"x": axis}, clock=clock, opener=lambda _port, **options: line)
    return stage, printer, clock


def test_marlin_moves_reports_and_sees_the_end():
    stage, printer, clock = marlin()
    stage.connect()
    with pytest.raises(StageError, match="position is unknown"):
        stage.begin("x", -10.0, 5.0)
    stage.home()
    stage.begin("x", -10.0, 5.0)
    reports = []
    while stage.moving:
        report = stage.poll()
        if report is not None:
            assert report.position_mm == pytest.approx(printer.now(), abs=0.05)
            reports.append(report)
        clock.sleep(0.01)
    assert len(reports) > 8
    assert printer.now() == -10.0


def test_marlin_stops_loses_its_position_and_stays_stopped():
    stage, printer, clock = marlin()
    stage.connect()
    stage.home()
    stage.begin("x", -50.0, 5.0)
    clock.sleep(1.0)
    assert "position is lost" in stage.halt()
    rest = printer.now()
    clock.sleep(1.0)
    assert printer.now() == rest
    with pytest.raises(AlarmError, match="it was stopped"):
        stage.begin("x", -10.0, 5.0)


def test_marlin_that_was_killed_or_has_other_steps_says_so():
    stage, printer, _ = marlin()
    stage.connect()
    stage.home()
    printer.killed = True
    with pytest.raises(AlarmError, match="Printer halted"):
        stage.begin("x", -10.0, 5.0)
    other, _, _ = marlin({**AXIS, "steps_per_mm": 80.0})
    with pytest.raises(RigError, match=r"M92 X250\.00 .* steps_per_mm=80"):
        other.connect()
