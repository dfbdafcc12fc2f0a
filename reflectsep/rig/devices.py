"""What a stage, a camera and lights are to the runner: three small protocols and the values that pass between them.

Building a device touches no hardware; `connect` does. `close` leaves it safe and may be called at any time, twice too.
Times are seconds of the session's clock (reflectsep/rig/clock.py); positions are millimetres of the stage's own axis.
A number that a device could not tell is None, never what it was asked to be.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np

Axis = Literal["x", "y"]
"""Axis of the picture along which the slit moves."""


@dataclass(frozen=True, kw_only=True)
class AxisLimits:
    """What one axis of a stage can do."""

    travel_mm: tuple[float, float]
    speed_mm_s: tuple[float, float]
    """Slowest, below which the controller is silently wrong, and fastest."""
    acceleration_mm_s2: float
    step_mm: float
    """Of one motor step: the resolution."""

    def ramp_mm(self, speed_mm_s: float) -> float:
        """Way on which `speed_mm_s` is reached from rest: v^2 / 2a."""
        return speed_mm_s**2 / (2.0 * self.acceleration_mm_s2)


@dataclass(frozen=True, kw_only=True)
class StageReport:
    """Where the stage was at a moment."""

    time_s: float
    uncertainty_s: float
    """Half of the span in which the position may have been taken."""
    position_mm: float
    state: str
    override_percent: float | None
    """Of the speed; None where the controller has not said."""


class Stage(Protocol):
    """A linear stage, or two, that moves the slit."""

    @property
    def limits(self) -> Mapping[Axis, AxisLimits]:
        """By axis of the picture; known before `connect`, and held against the controller's own by it."""
        ...

    @property
    def identity(self) -> Mapping[str, str]:
        """The controller's version and settings, once connected: what must be the same for a session to go on."""
        ...

    @property
    def homes(self) -> bool:
        """Whether `home` finds the position by itself; else a person has put the carriage at zero."""
        ...

    @property
    def moving(self) -> bool:
        """Whether the motion begun last has not been reported as finished."""
        ...

    def connect(self) -> None:
        """Open the line, identify the controller and check its settings.

        Raises:
            StageError: nothing there, not what was expected, or settings that differ from the limits.
        """
        ...

    def home(self) -> None:
        """Find the position; the only motion that is allowed when it is unknown.

        Raises:
            StageError: it failed or took too long.
        """
        ...

    def verify(self) -> float | None:
        """Home again; how far the carriage was from where it was believed to be, mm, None where that cannot be told.

        Raises:
            StageError: it failed or took too long.
        """
        ...

    def begin(self, axis: Axis, target_mm: float, speed_mm_s: float) -> None:
        """Start a straight motion at constant speed; returns when the controller has taken it.

        Raises:
            StageError: outside the limits, refused, or the position is unknown.
        """
        ...

    def poll(self) -> StageReport | None:
        """A report, when one is due; None otherwise. Never blocks for longer than a report takes.

        Raises:
            StageError: an alarm, a board that has gone silent, or a motion past its deadline.
        """
        ...

    def position(self, axis: Axis) -> float | None:
        """Where the controller said that the last motion along an axis ended, mm; None: it has not said."""
        ...

    def halt(self) -> str | None:
        """Stop, keeping the position where that is possible; never raises.

        Returns:
            What is known of the stage now, for a person; None: it was not connected.
        """
        ...

    def abort(self) -> None:
        """Stop at once, whatever becomes of the position; never raises, may be called from a signal handler."""
        ...

    def close(self) -> None:
        """Let go of the line."""
        ...


@dataclass(frozen=True, kw_only=True)
class RawFrame:
    """One picture as the camera gave it."""

    pixels: np.ndarray | None
    """(height, width) or (height, width, 3), uint8 or uint16; None where `file` has it or it is not whole."""
    file: Path | None = None
    """A picture file elsewhere, complete; it is copied."""
    largest: int = 255
    """Code that stands for full scale in `pixels`."""
    sequence: int | None = None
    """The camera's own count, as it came; it may wrap."""
    device_time_s: float | None = None
    """Middle of the exposure by the camera's own clock."""
    host_time_s: float | None = None
    """When it arrived, by the session's clock."""
    fault: str | None = None
    """Why it is not whole, e.g. `missing-packets`."""


@dataclass(frozen=True, kw_only=True)
class ClockReading:
    """The camera's clock read against the session's."""

    host_time_s: float
    device_time_s: float
    uncertainty_s: float


@dataclass(frozen=True, kw_only=True)
class CameraLimits:
    """What a camera can do."""

    exposure_s: tuple[float, float] | None = None
    """Shortest and longest; None where it cannot be set."""
    sequence_first: int = 0
    sequence_last: int | None = None
    """Last count before it wraps to the first."""
    streams: bool = True
    """Whether it takes frames by itself at a steady rate; else one at a time, on request."""
    host_times: bool = True
    """Whether frames say when they arrived; else only what they show ties their clock to the session's."""


class Camera(Protocol):
    """Takes pictures."""

    @property
    def limits(self) -> CameraLimits:
        """Known once connected."""
        ...

    @property
    def identity(self) -> Mapping[str, str]:
        """Model, serial number, pixel format, size: what must be the same for a session to go on."""
        ...

    def connect(self) -> None:
        """Find the camera and put it into a known state.

        Raises:
            CameraError: absent, or not as configured.
            MissingExtraError: its library is not installed.
        """
        ...

    def set_exposure(self, exposure_s: float) -> float | None:
        """Set the exposure and read it back.

        Returns:
            What the camera says it is; None where it cannot say.
        """
        ...

    def read_exposure(self) -> float | None:
        """What the camera says its exposure is; None where it cannot say."""
        ...

    def snap(self, name: str) -> RawFrame:
        """Take one picture; `name` is what the plan calls it.

        Raises:
            CameraError: none came in time.
        """
        ...

    def start(self, name: str, rate_hz: float) -> None:
        """Begin to take frames, `rate_hz` of them a second where that can be set."""
        ...

    def poll(self) -> Sequence[RawFrame]:
        """Frames that came since the last call; never blocks.

        Raises:
            CameraError: the camera died.
        """
        ...

    def read_clock(self) -> ClockReading | None:
        """The camera's clock now; None where it cannot be read."""
        ...

    def stop(self) -> Sequence[RawFrame]:
        """Stop taking frames; returns those that were still under way."""
        ...

    def close(self) -> None:
        """Stop, and let go of the camera; never raises."""
        ...


class Lights(Protocol):
    """Switches one of the lights on, or none."""

    @property
    def identity(self) -> Mapping[str, str]:
        """What must be the same for a session to go on."""
        ...

    def connect(self) -> None:
        """Open the line; all lights are off after it.

        Raises:
            LightsError: it cannot be opened or does not answer.
        """
        ...

    def switch(self, light: str | None) -> str | None:
        """Switch `light` on and all others off; None: all off.

        Returns:
            What the lights say is on (`off` for none); None where they cannot say.

        Raises:
            LightsError: refused, or read back as something else.
        """
        ...

    def close(self) -> None:
        """All off, and let go of the line; never raises."""
        ...


@runtime_checkable
class Asks(Protocol):
    """Asks the person at the rig to do something and waits."""

    def __call__(self, text: str) -> None:
        """Show `text`, come back when it is done."""
        ...


@dataclass(frozen=True, kw_only=True)
class Devices:
    """A rig: what the runner drives."""

    stage: Stage
    camera: Camera
    lights: Lights
    names: Mapping[str, str] = field(default_factory=dict)
    """Backend by kind of device, for the record."""
