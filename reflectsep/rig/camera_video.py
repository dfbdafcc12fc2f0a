"""A camera that records by itself: a video file a shot, handed over after it; its pictures carry their own times.

Its clock and the session's meet where the frames show the light going on and off (reflectsep/rig/marks.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from reflectsep.errors import CameraError, CaptureError, SettingsError
from reflectsep.io.video import video_pictures
from reflectsep.rig.clock import Clock, Deadline, HostClock
from reflectsep.rig.devices import CameraLimits, ClockReading, RawFrame

LOOK_S = 0.1


class VideoCamera:
    """Takes the pictures of a shot from the video of its name.

    Args:
        path: Of the videos; `{name}` stands for the name of the shot.
        timeout_s: After the shot, for its file.
        settle_s: For which the file must not have changed.
        clock: The session's.
    """

    def __init__(
        self, *, path: str, timeout_s: float = 120.0, settle_s: float = 1.0, clock: Clock | None = None
    ) -> None:
        if "{name}" not in path:
            raise SettingsError(f"rig.devices.camera.path={path}: expected {{name}} in it, for the name of the shot")
        self._path, self._timeout_s, self._settle_s = path, timeout_s, settle_s
        self._clock = clock or HostClock()
        self._taking: str | None = None

    @property
    def limits(self) -> CameraLimits:
        """It records by itself, and knows nothing of the session's clock."""
        return CameraLimits(host_times=False)

    @property
    def identity(self) -> Mapping[str, str]:
        """Where the videos are."""
        return {"path": self._path}

    def connect(self) -> None:
        """Nothing to open yet."""

    def set_exposure(self, exposure_s: float) -> float | None:  # noqa: ARG002
        """Not ours to set."""
        return None

    def read_exposure(self) -> float | None:
        """Not ours to know."""
        return None

    def snap(self, name: str) -> RawFrame:
        """The middle picture of a video."""
        frames = self._frames(name)
        return frames[len(frames) // 2]

    def start(self, name: str, rate_hz: float) -> None:  # noqa: ARG002
        """The recording runs."""
        self._taking = name

    def poll(self) -> Sequence[RawFrame]:
        """Nothing before the end."""
        return ()

    def read_clock(self) -> ClockReading | None:
        """Not over a wire."""
        return None

    def stop(self) -> Sequence[RawFrame]:
        """All of the video."""
        name, self._taking = self._taking, None
        return () if name is None else self._frames(name)

    def close(self) -> None:
        """Nothing to let go of."""
        self._taking = None

    def _frames(self, name: str) -> list[RawFrame]:
        path = Path(self._path.replace("{name}", name.replace("/", "-")))
        self._await(path)
        frames = []
        try:
            for pixels, largest, time_s in video_pictures(path):
                frames.append(RawFrame(pixels=pixels, largest=largest, device_time_s=time_s))
        except CaptureError as error:
            if not frames:
                raise CameraError(str(error)) from error
            frames.append(RawFrame(pixels=None, device_time_s=None, fault=str(error)))
        if not frames:
            raise CameraError(f"{path}: no picture in it")
        return frames

    def _await(self, path: Path) -> None:
        """Wait until the file is there and has not changed for a while."""
        deadline, size, since_s = Deadline.after(self._clock, self._timeout_s), -1, self._clock.now()
        while not deadline.passed:
            now_size = path.stat().st_size if path.is_file() else -1
            if now_size != size:
                size, since_s = now_size, self._clock.now()
            elif size > 0 and self._clock.now() - since_s >= self._settle_s:
                return
            self._clock.sleep(LOOK_S)
        raise CameraError(f"{path}: no whole video in {self._timeout_s:g} s")
