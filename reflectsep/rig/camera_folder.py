"""A watched folder: another program takes the pictures and drops their files; new whole ones are taken up in order."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from reflectsep.errors import CameraError, CaptureError
from reflectsep.io.pictures import SUFFIXES, read_picture
from reflectsep.rig.clock import Clock, Deadline, HostClock
from reflectsep.rig.devices import CameraLimits, ClockReading, RawFrame

LOOK_S = 0.05


class FolderCamera:
    """Takes up files that appear in a folder, by name, once they are whole.

    A file is whole when it can be decoded and its size has not changed for a while. In a sweep their numbers, the last
    digits in their names, are the count of frames; the exposure is the other program's affair, and unknown.

    Args:
        folder: To watch.
        timeout_s: For a picture.
        settle_s: For which a file must not have changed.
        clock: The session's.
    """

    def __init__(
        self, *, folder: str, timeout_s: float = 60.0, settle_s: float = 0.2, clock: Clock | None = None
    ) -> None:
        self._folder = Path(folder)
        self._timeout_s, self._settle_s = timeout_s, settle_s
        self._clock = clock or HostClock()
        self._seen: set[str] = set()
        self._sizes: dict[str, tuple[int, float, float]] = {}

    @property
    def limits(self) -> CameraLimits:
        """It neither sets the exposure nor knows a clock."""
        return CameraLimits()

    @property
    def identity(self) -> Mapping[str, str]:
        """The folder."""
        return {"folder": str(self._folder.resolve())}

    def connect(self) -> None:
        """What is there already is not ours."""
        if not self._folder.is_dir():
            raise CameraError(f"{self._folder}: no such folder to watch")
        self._seen = {path.name for path in self._folder.iterdir()}

    def set_exposure(self, exposure_s: float) -> float | None:  # noqa: ARG002
        """Not ours to set."""
        return None

    def read_exposure(self) -> float | None:
        """Not ours to know."""
        return None

    def snap(self, name: str) -> RawFrame:
        """The next new picture."""
        deadline = Deadline.after(self._clock, self._timeout_s)
        while not deadline.passed:
            frames = self._whole(limit=1)
            if frames:
                return frames[0]
            self._clock.sleep(LOOK_S)
        waiting = sorted(self._sizes)
        found = f"{waiting[0]} is there, but not whole" if waiting else "nothing new came"
        raise CameraError(f"{self._folder}: no picture for {name} in {self._timeout_s:g} s: {found}")

    def start(self, name: str, rate_hz: float) -> None:  # noqa: ARG002
        """From now on everything new belongs to the sweep."""
        self._seen |= {path.name for path in self._folder.iterdir()}
        self._sizes.clear()

    def poll(self) -> Sequence[RawFrame]:
        """New whole files."""
        return self._whole()

    def read_clock(self) -> ClockReading | None:
        """None."""
        return None

    def stop(self) -> Sequence[RawFrame]:
        """What is still being written."""
        frames: list[RawFrame] = []
        deadline = Deadline.after(self._clock, max(1.0, 4 * self._settle_s))
        while not deadline.passed:
            frames += self._whole()
            self._clock.sleep(LOOK_S)
        for name, (_, _, first_s) in sorted(self._sizes.items()):
            self._seen.add(name)
            number = _number(Path(name).stem)
            frames.append(
                RawFrame(pixels=None, sequence=number, host_time_s=first_s, fault=f"{name} stayed half-written")
            )
        self._sizes.clear()
        return frames

    def close(self) -> None:
        """Nothing to let go of."""

    def _whole(self, limit: int | None = None) -> list[RawFrame]:
        now, frames = self._clock.now(), []
        for path in sorted(self._folder.iterdir(), key=lambda p: (_number(p.stem) or 0, p.name)):
            if path.name in self._seen or path.suffix.lower() not in SUFFIXES or path.name.startswith("."):
                continue
            try:
                state = path.stat()
            except FileNotFoundError:
                continue  # renamed between the listing and now
            size, changed_s, first_s = self._sizes.get(path.name, (-1, now, now))
            if state.st_size != size:
                self._sizes[path.name] = (state.st_size, now, first_s)
                continue
            if now - changed_s < self._settle_s or not _decodes(path):
                continue
            self._seen.add(path.name)
            del self._sizes[path.name]
            frames.append(RawFrame(pixels=None, file=path, sequence=_number(path.stem), host_time_s=first_s))
            if limit is not None and len(frames) >= limit:
                break
        return frames


def _number(stem: str) -> int | None:
    found = re.search(r"(\d+)\D*$", stem)
    return int(found[1]) if found else None


def _decodes(path: Path) -> bool:
    try:
        read_picture(path)
    except CaptureError:
        return False
    return True
