"""Simulated devices: a GRBL board on a line of its own, a camera, lights; they share a bench and its clock.

The stage is driven by the same GrblStage as a real one. The camera renders what its scene shows for the light that is
on and the place where the slit really is in the middle of each exposure.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from reflectsep.errors import CameraError, LightsError
from reflectsep.rig.board import Board
from reflectsep.rig.clock import Clock, VirtualClock
from reflectsep.rig.devices import Axis, CameraLimits, ClockReading, RawFrame
from reflectsep.rig.grbl import GrblStage

TICK_S = 0.001
RING = 64
"""Frames that the camera's driver holds; what comes while it is full is lost."""


class Scene(Protocol):
    """What a simulated camera looks at."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        ...

    @property
    def lights(self) -> Sequence[str]:
        """Names of the lights."""
        ...

    @property
    def largest(self) -> int:
        """Code of full scale."""
        ...

    def render(self, view: View) -> np.ndarray:
        """Codes, (height, width) or (height, width, 3), uint8 or uint16."""
        ...


@dataclass(frozen=True, kw_only=True)
class View:
    """What decides a simulated picture."""

    light: str | None
    exposure_s: float
    slit: tuple[Axis, float] | None
    """Axis and position in mm; None: the slit is out of the light."""
    blur_mm: float = 0.0
    """Way of the slit during the exposure."""
    name: str = ""
    """Of the picture: its noise is drawn from it."""


@dataclass(kw_only=True)
class Bench:
    """What simulated devices share: the scene, the time, the board, and which light is on."""

    scene: Scene
    clock: Clock = field(default_factory=VirtualClock)
    board: Board = field(default_factory=Board)
    park_mm: float = -1.0
    """On axis x, at or above which the slit is out of the light."""
    axes: Mapping[str, int] = field(default_factory=lambda: {"x": 0, "y": 1})
    """The board's axis for each of the picture's."""
    light: str | None = None

    def slit(self, time_s: float) -> tuple[Axis, float, float] | None:
        """Axis, position and speed of the slit; None where it is out of the light."""
        place = self.board.position(time_s)
        if place[1] < -2.0:
            return ("y", place[1], self.board.trace.speed_at(time_s))
        if place[0] >= self.park_mm - 0.01:
            return None
        return ("x", place[0], self.board.trace.speed_at(time_s))


class SimulatedSerial:
    """The far end of a serial line, as pyserial shows it; waiting on it lets the bench's time pass."""

    def __init__(self, bench: Bench, *, timeout: float = 0.01) -> None:
        self._bench = bench
        self.timeout = timeout
        self._in = bytearray()
        bench.board.power_on(bench.clock.now())

    @property
    def in_waiting(self) -> int:
        """Bytes that have come."""
        self._in += self._bench.board.transmit(self._bench.clock.now())
        return len(self._in)

    def write(self, data: bytes) -> int:
        """Send bytes."""
        self._bench.board.receive(data, self._bench.clock.now())
        return len(data)

    def flush(self) -> None:
        """Everything is on its way already."""

    def read(self, size: int = 1) -> bytes:
        """Bytes, or none at the end of the timeout."""
        waited = 0.0
        while not self.in_waiting and waited < self.timeout:
            self._bench.clock.sleep(TICK_S)
            waited += TICK_S
        out = bytes(self._in[:size])
        del self._in[:size]
        return out

    def reset_input_buffer(self) -> None:
        """Forget what has come."""
        self._in.clear()
        self._bench.board.transmit(self._bench.clock.now())

    def close(self) -> None:
        """Nothing to let go of."""


def simulated_stage(*, bench: Bench, **settings: Any) -> GrblStage:
    """The GRBL driver on the bench's board; `settings` as GrblStage takes them."""
    return GrblStage(
        port="simulated",
        clock=bench.clock,
        opener=lambda port, **options: SimulatedSerial(bench, timeout=options["timeout"]),  # noqa: ARG005
        **settings,
    )


class SimulatedCamera:
    """A camera with a clock of its own that is wrong by an offset and a drift, and a ring of frames.

    Args:
        bench: What it looks at.
        clock_offset_s: Its clock at the session's 0.
        clock_drift: By how much it is too fast.
        readout_s: From the end of an exposure to the arrival of the frame.
        drop_every: Lose every n-th frame of a sweep; 0: none.
        sequence_first: Count of the first frame; it wraps from 65535 to 1.
    """

    def __init__(
        self,
        *,
        bench: Bench,
        clock_offset_s: float = 1234.5,
        clock_drift: float = 40e-6,
        readout_s: float = 0.003,
        drop_every: int = 0,
        sequence_first: int = 65500,
    ) -> None:
        self._bench = bench
        self._offset_s, self._drift = clock_offset_s, clock_drift
        self._readout_s, self._drop_every, self._sequence_first = readout_s, drop_every, sequence_first
        self._exposure_s = 0.01
        self._connected = False
        self._taking: tuple[float, float, str] | None = None
        self._taken = 0
        self._ring: deque[RawFrame] = deque()

    @property
    def limits(self) -> CameraLimits:
        """Exposures from 10 us to 10 s."""
        return CameraLimits(exposure_s=(1e-5, 10.0), sequence_first=1, sequence_last=65535)

    @property
    def identity(self) -> Mapping[str, str]:
        """Its size and depth."""
        width, height = self._bench.scene.size
        return {"model": "simulated", "size": f"{width}x{height}", "largest": str(self._bench.scene.largest)}

    def connect(self) -> None:
        """Be there."""
        self._connected = True

    def set_exposure(self, exposure_s: float) -> float | None:
        """In whole microseconds, as cameras have it."""
        if self._taking is not None:
            raise CameraError("simulated camera: the exposure cannot change while frames are taken")
        self._exposure_s = round(exposure_s * 1e6) / 1e6
        return self._exposure_s

    def read_exposure(self) -> float | None:
        """As it is."""
        return self._exposure_s

    def snap(self, name: str) -> RawFrame:
        """One frame."""
        self._need()
        start = self._bench.clock.now()
        self._bench.clock.sleep(self._exposure_s + self._readout_s)
        return self._frame(start, name, 0)

    def start(self, name: str, rate_hz: float) -> None:
        """Frames from now on."""
        self._need()
        if self._exposure_s * rate_hz > 1:
            raise CameraError(f"simulated camera: {rate_hz:g} frames a second of {self._exposure_s:g} s each")
        self._taking, self._taken = (self._bench.clock.now() + 0.02, 1.0 / rate_hz, name), 0
        self._ring.clear()

    def poll(self) -> Sequence[RawFrame]:
        """What has come."""
        self._need()
        self._take(self._bench.clock.now())
        frames = list(self._ring)
        self._ring.clear()
        return frames

    def read_clock(self) -> ClockReading | None:
        """The camera's clock, latched on request."""
        now = self._bench.clock.now()
        return ClockReading(host_time_s=now, device_time_s=self._device(now), uncertainty_s=0.0)

    def stop(self) -> Sequence[RawFrame]:
        """No more frames."""
        if self._taking is None:
            return ()
        frames = self.poll()
        self._taking = None
        return frames

    def close(self) -> None:
        """Be gone."""
        self._taking, self._connected = None, False

    def _need(self) -> None:
        if not self._connected:
            raise CameraError("simulated camera: not connected")

    def _device(self, time_s: float) -> float:
        return self._offset_s + (1.0 + self._drift) * time_s

    def _take(self, now_s: float) -> None:
        if self._taking is None:
            return
        first_s, period_s, name = self._taking
        while first_s + self._taken * period_s + self._exposure_s + self._readout_s <= now_s:
            index = self._taken
            self._taken += 1
            if self._drop_every and index % self._drop_every == self._drop_every - 1:
                continue
            if len(self._ring) < RING:
                self._ring.append(self._frame(first_s + index * period_s, name, index))

    def _frame(self, start_s: float, name: str, index: int) -> RawFrame:
        middle = start_s + self._exposure_s / 2
        slit = self._bench.slit(middle)
        view = View(
            light=self._bench.light,
            exposure_s=self._exposure_s,
            slit=None if slit is None else slit[:2],
            blur_mm=0.0 if slit is None else slit[2] * self._exposure_s,
            name=name if self._taking is None else f"{name}/{index}",
        )
        last = 65535
        return RawFrame(
            pixels=self._bench.scene.render(view),
            largest=self._bench.scene.largest,
            sequence=(self._sequence_first - 1 + index) % last + 1,
            device_time_s=self._device(middle),
            host_time_s=self._bench.clock.now(),
        )


class SimulatedLights:
    """Lights that do what they are told.

    Args:
        bench: What they light.
    """

    def __init__(self, *, bench: Bench) -> None:
        self._bench = bench

    @property
    def identity(self) -> Mapping[str, str]:
        """The names of the lights."""
        return {"lights": ",".join(self._bench.scene.lights)}

    def connect(self) -> None:
        """All off."""
        self._bench.light = None

    def switch(self, light: str | None) -> str | None:
        """One on, or none."""
        if light is not None and light not in self._bench.scene.lights:
            raise LightsError(f"simulated lights: no light {light!r}; there are {', '.join(self._bench.scene.lights)}")
        self._bench.light = light
        return light or "off"

    def close(self) -> None:
        """All off."""
        self._bench.light = None
