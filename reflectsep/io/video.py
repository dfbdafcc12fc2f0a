"""Pictures of a video with their own time stamps: never the rate or the count that its header claims."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from reflectsep.errors import CaptureError
from reflectsep.io.frames import _av, _sound, _stored


def video_pictures(path: Path) -> Iterator[tuple[np.ndarray, int, float]]:
    """Every picture of a video.

    Yields:
        Pixels (height, width[, 3]), the code of full scale, and the time of its own presentation stamp in seconds.

    Raises:
        CaptureError: not a video, damaged, or a picture without a stamp.
        MissingExtraError: PyAV is not installed.
    """
    av = _av(path)
    done = 0
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise CaptureError(f"{path}: no video stream in it")
            frames = container.decode(container.streams.video[0])
            while (frame := _sound(av, frames)) is not None:
                if frame.pts is None or frame.time_base is None:
                    raise CaptureError(f"{path}: picture {done} has no time of its own")
                pixels, largest = _stored(frame)
                yield pixels, largest, float(frame.pts * frame.time_base)
                done += 1
    except (av.error.FFmpegError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise CaptureError(f"{path}: cannot be decoded at picture {done}: {reason}") from error
