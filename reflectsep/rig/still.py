"""What cameras share that take one picture at a time: they do not stream, and say so."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NoReturn

from reflectsep.errors import CameraError
from reflectsep.rig.devices import ClockReading, RawFrame


class StillCamera:
    """The streaming half of a camera that has none."""

    def start(self, name: str, rate_hz: float) -> NoReturn:
        """Refuse.

        Raises:
            CameraError: always.
        """
        raise CameraError(f"{name}: this camera takes no {rate_hz:g} frames a second by itself: set motion=stepped")

    def poll(self) -> Sequence[RawFrame]:
        """Nothing comes by itself."""
        return ()

    def stop(self) -> Sequence[RawFrame]:
        """Nothing is under way."""
        return ()

    def read_clock(self) -> ClockReading | None:
        """It has no clock that frames are marked with."""
        return None
