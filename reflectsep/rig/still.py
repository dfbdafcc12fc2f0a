"""What cameras share that take one picture at a time: they do not stream, and say so."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
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


def scratch_folder(parent: Path | None) -> tempfile.TemporaryDirectory[str]:
    """A folder for pictures until they are taken over; in a session's folder, what a crash left of it is swept away."""
    return tempfile.TemporaryDirectory(prefix=".camera.", suffix=".part", dir=parent)
