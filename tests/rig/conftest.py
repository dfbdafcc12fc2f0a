"""Test equipment: a small scene, a rig in simulated time with hooks for faults, and the table of faults."""

import json
import os
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from reflectsep.data import Light
from reflectsep.io.capture import load_capture, verify
from reflectsep.rig.board import Board
from reflectsep.rig.clock import VirtualClock
from reflectsep.rig.devices import Devices
from reflectsep.rig.finish import finish
from reflectsep.rig.grbl import GrblStage
from reflectsep.rig.plan import Plan, SlabSweep, make_stills
from reflectsep.rig.runner import Runner, RunOptions
from reflectsep.rig.session import Session
from reflectsep.rig.simulated import Bench, SimulatedCamera, SimulatedLights, SimulatedSerial

AXIS = {"letter": "X", "travel_mm": [-200.0, 0.0], "steps_per_mm": 250.0, "max_speed_mm_s": 50.0}
AXIS |= {"acceleration_mm_s2": 100.0}
NAMES = ("L1", "L2", "L3")


class Stripe:
    """A grey card, 16 x 12: the slit lights one pixel column a millimetre around -60 mm."""

    size = (16, 12)
    lights = NAMES
    largest = 255

    def render(self, view):
        noise = np.random.default_rng(zlib.crc32(view.name.encode())).integers(0, 3, (12, 16))
        values = np.full((12, 16), 4)
        if view.light is not None and view.slit is None:
            values[2:10, 2:14] = 100 + 20 * NAMES.index(view.light)
        elif view.light is not None:
            column = round(view.slit[1] + 60 + 8)
            values[2:10, 2:14] = 8
            if 2 <= column < 14:
                values[2:10, column] = 110
        return (values * view.exposure_s / 0.01 + noise).clip(0, 255).astype(np.uint8)


class Faulty(SimulatedSerial):
    """The line, with a lever for every way in which it breaks."""

    def __init__(self, rig, **options):
        super().__init__(rig.bench, **options)
        self._rig = rig

    def _maybe(self, where):
        error = self._rig.line_errors.get(where)
        if error is not None:
            raise error

    @property
    def in_waiting(self):
        self._maybe("in_waiting")
        waiting = super().in_waiting
        if self._rig.eat:
            for word in list(self._rig.eat):
                if word in self._in:
                    at = self._in.index(word)
                    del self._in[at : at + len(word)]
                    self._rig.eat.remove(word)
            waiting = len(self._in)
        return min(waiting, 3) if self._rig.partial else waiting

    def read(self, size=1):
        self._maybe("read")
        if self._rig.frozen:
            self._rig.bench.clock.sleep(self.timeout)
            return b""
        out = super().read(min(size, 3) if self._rig.partial else size)
        if self._rig.noise_in:
            out, self._rig.noise_in = self._rig.noise_in + out, b""
        return out

    def write(self, data):
        self._maybe("write")
        if self._rig.noise_out:
            data, self._rig.noise_out = self._rig.noise_out + data, b""
        return super().write(data)

    def flush(self):
        self._maybe("flush")


class HookedCamera(SimulatedCamera):
    """The simulated camera; `hooks` run at the poll of their number in a sweep and may change what came."""

    def __init__(self, rig, **settings):
        super().__init__(bench=rig.bench, **settings)
        self._rig = rig
        self._polls = 0

    def start(self, name, rate_hz):
        self._polls = 0
        super().start(name, rate_hz)

    def poll(self):
        self._polls += 1
        hook = self._rig.hooks.pop(self._polls, None)
        if hook is not None:
            hook()
        return [f for frame in super().poll() for f in self._rig.change(frame)]


@dataclass
class Rig:
    """Devices in simulated time, and the levers."""

    folder: Path
    settings: dict = field(default_factory=dict)
    stage: dict = field(default_factory=dict)
    camera: dict = field(default_factory=dict)
    sweep: dict = field(default_factory=dict)
    lights: tuple = NAMES
    hooks: dict = field(default_factory=dict)
    line_errors: dict = field(default_factory=dict)
    eat: list = field(default_factory=list)
    noise_in: bytes = b""
    noise_out: bytes = b""
    partial: bool = False
    frozen: bool = False
    told: list = field(default_factory=list)
    exposure: dict = field(default_factory=lambda: {"full": 0.01, "slab": 0.01})
    max_lost: float = 0.1
    mask: str = "auto"

    def __post_init__(self):
        self.change = lambda frame: [frame]
        self.bench = Bench(
            scene=Stripe(), clock=VirtualClock(), board=Board({22: 1, **self.settings}, homing_s=2.0), park_mm=-1.0
        )
        self.devices = self.build()

    def build(self):
        stage = GrblStage(
            **{"port": "board", "axes": {"x": AXIS}, **self.stage},
            clock=self.bench.clock,
            opener=lambda _port, **options: Faulty(self, timeout=options["timeout"]),
        )
        return Devices(
            stage=stage,
            camera=HookedCamera(self, **self.camera),
            lights=SimulatedLights(bench=self.bench),
            names={"stage": "grbl", "camera": "simulated", "lights": "simulated"},
        )

    def plan(self):
        shot = {"start_mm": -70.0, "end_mm": -50.0, "speed_mm_s": 10.0, "rate_hz": 10.0, **self.sweep}
        return Plan(
            object="card",
            lights={name: Light(name=name) for name in self.lights},
            basis=NAMES,
            stills=make_stills(self.lights, swept=True, dark_frames=2),
            sweeps=(SlabSweep(name="sweep-L1-x", light="L1", axis="x", **shot),),
            park_mm=-1.0,
            exposure_s=self.exposure,
            encoding="linear",
            mask=self.mask,
            max_lost=self.max_lost,
        )

    def run(self, *, resume=False, zeroed=False):
        session = Session(self.folder)
        session.open(resume=resume)
        try:
            options = RunOptions(resume=resume, zeroed=zeroed)
            Runner(self.plan(), self.devices, session, options, clock=self.bench.clock, tell=self.told.append).run()
            return finish(session, self.plan())
        finally:
            session.close()

    def at_rest(self):
        """Whether nothing moves any more, and no light is on."""
        now = self.bench.clock.now()
        self.bench.board.advance(now + 0.5)
        return self.bench.board.trace.speed_at(now + 0.5) == 0 and self.bench.light is None


@pytest.fixture
def rig_in(tmp_path):
    """Makes rigs over one session folder."""
    return lambda name="session", **settings: Rig(tmp_path / name, **settings)


def whole(folder):
    """Every file that the session's manifest names is there and as recorded; returns the names of the steps done."""
    path = Path(folder) / "session.json"
    if not path.exists():
        return []
    document = json.loads(path.read_text())
    session = Session(folder)
    session._document = document
    session.event = lambda *a, **k: pytest.fail(f"damaged: {a} {k}")
    return [name for name in document["steps"] if session.step(name) is not None]


def complete(folder):
    """The capture loads, and all its files are as recorded."""
    capture = load_capture(folder)
    assert verify(capture) == []
    return capture


@pytest.fixture
def record_fault(request):
    """Adds a row to the table of faults, at the path that REFLECTSEP_FAULT_TABLE names."""

    def record(fault, seen, state, disk, resumed):
        path = os.environ.get("REFLECTSEP_FAULT_TABLE")
        if path:
            cells = [fault, seen, state, disk, resumed]
            with open(path, "a") as table:
                if table.tell() == 0:
                    table.write("| fault | what is seen | the rig | on disk | resume |\n|---|---|---|---|---|\n")
                table.write("| " + " | ".join(str(cell).replace("|", "/") for cell in cells) + " |\n")

    return record
