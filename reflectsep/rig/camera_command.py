"""A camera behind a program of the user's that takes one picture and writes it to a file."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from reflectsep.errors import CameraError
from reflectsep.rig.clock import Clock, HostClock
from reflectsep.rig.command import checked_arguments, run_command
from reflectsep.rig.devices import CameraLimits, ClockReading, RawFrame
from reflectsep.rig.still import StillCamera, scratch_folder


class CommandCamera(StillCamera):
    """One picture a call of a program.

    Args:
        take: Argument list; `{file}` stands for the file to write, `{exposure_s}` for the exposure in seconds,
            `{name}` for the name of the picture.
        read_exposure: Argument list of a program that prints the exposure in seconds; None: it cannot be read.
        suffix: Of the file.
        exposure_s: Shortest and longest; None: the exposure is not the program's to set.
        timeout_s: For a picture.
        clock: The session's.
        scratch: Folder for the files until they are taken over; None: the system's.
    """

    def __init__(
        self,
        *,
        take: Sequence[str],
        read_exposure: Sequence[str] | None = None,
        suffix: str = ".png",
        exposure_s: Sequence[float] | None = None,
        timeout_s: float = 30.0,
        clock: Clock | None = None,
        scratch: Path | None = None,
    ) -> None:
        where = "rig.devices.camera"
        self._take = checked_arguments(take, f"{where}.take")
        self._read = None if read_exposure is None else checked_arguments(read_exposure, f"{where}.read_exposure")
        self._suffix, self._timeout_s = suffix, timeout_s
        self._bounds = None if exposure_s is None else (float(exposure_s[0]), float(exposure_s[1]))
        self._clock = clock or HostClock()
        self._scratch = scratch
        self._wanted_s: float | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._count = 0

    @property
    def limits(self) -> CameraLimits:
        """One frame at a time."""
        return CameraLimits(exposure_s=self._bounds, streams=False)

    @property
    def identity(self) -> Mapping[str, str]:
        """The program."""
        return {"take": " ".join(self._take)}

    def connect(self) -> None:
        """A folder for the files, apart from the session's."""
        self._folder = scratch_folder(self._scratch)

    def set_exposure(self, exposure_s: float) -> float | None:
        """Hand it to the next call."""
        self._wanted_s = exposure_s
        return self.read_exposure()

    def read_exposure(self) -> float | None:
        """Ask the program, where there is one."""
        if self._read is None:
            return None
        said = run_command(self._read, self._values(Path()), self._timeout_s, CameraError)
        try:
            value = float(said)
        except ValueError:
            value = float("nan")
        if not 0 < value < float("inf"):
            raise CameraError(f"{self._read[0]}: printed {said[:40]!r}, an exposure in seconds was expected")
        return value

    def snap(self, name: str) -> RawFrame:
        """Run the program; its file must be there afterwards."""
        if self._folder is None:
            raise CameraError("camera: not connected")
        file = Path(self._folder.name) / f"{self._count:06d}{self._suffix}"
        self._count += 1
        run_command(self._take, {**self._values(file), "name": name}, self._timeout_s, CameraError)
        if not file.is_file() or file.stat().st_size == 0:
            raise CameraError(f"{self._take[0]}: succeeded, but wrote no file {file.name}")
        return RawFrame(pixels=None, file=file, host_time_s=self._clock.now())

    def read_clock(self) -> ClockReading | None:
        """It has none."""
        return None

    def close(self) -> None:
        """The files are copied by now."""
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def _values(self, file: Path) -> dict[str, str]:
        exposure = "" if self._wanted_s is None else f"{self._wanted_s:.9g}"
        return {"file": str(file), "exposure_s": exposure}
