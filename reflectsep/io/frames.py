"""Frames of a sweep, one at a time: from files, or from a video through PyAV (an extra), each with its own decoding.

PyAV reads grey 16-bit FFV1 exactly; it is asked for the stored planes wherever they are grey or planar RGB, so that
deep video is not squeezed through 8 bits.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from reflectsep.data import Capture, Frame, FrameStream, Region, Sweep
from reflectsep.errors import CaptureError, MissingExtraError
from reflectsep.io.ahead import Lead, in_order, lead_for
from reflectsep.io.files import inside
from reflectsep.io.manifest import frame_file
from reflectsep.io.pictures import developed, read_picture, require_checksum
from reflectsep.io.stack import picture_size, require_channels, require_size, windowed

BYTES_A_VALUE = 5
"""A float and whether it is clipped."""


def open_sweep(capture: Capture, sweep: Sweep) -> FrameStream:
    """A stream of the frames of `sweep`, values as stored (0 to 1 of integers), clipped ones marked.

    It can be gone through any number of times, and holds few frames at a time (`io/ahead.py`).

    Args:
        capture: whose sweep it is; the first basis picture is read, for the number of channels.
        sweep: one of `capture.sweeps`.

    Raises:
        CaptureError: the first basis picture cannot be read; while iterating, a frame that is missing, damaged, of
            another size or number of channels, or without one finite value.
        MissingExtraError: a video, and PyAV is not installed.
    """
    first = inside(capture.folder, capture.full(capture.basis[0]).file)
    channels = int(read_picture(first)[0].shape[0])
    size = picture_size(capture)
    if sweep.video is None:
        return FileFrames(sweep=sweep, folder=capture.folder, size=size, channels=channels, region=capture.region)
    _av(capture.folder / sweep.video)
    path = inside(capture.folder, sweep.video)
    return VideoFrames(sweep=sweep, path=path, size=size, channels=channels, region=capture.region)


class Shown:
    """A stream of frames that shows itself in a notebook."""

    sweep: Sweep

    def _repr_html_(self) -> str:
        return self.sweep._repr_html_()

    def plot(self, frames: int = 6) -> Any:
        """Some frames as a matplotlib figure, with one white for all."""
        return import_module("reflectsep.notebook").stream_plot(self, frames)


@dataclass(frozen=True, kw_only=True)
class FileFrames(Shown):
    """Frames with a file each."""

    sweep: Sweep
    folder: Path
    size: tuple[int, int]
    """(width, height) of the files."""
    channels: int
    region: Region | None = None
    """What is kept of a frame."""
    lead: Lead | None = None
    """How far decoding runs ahead; None: as far as cores and memory allow."""

    def __len__(self) -> int:
        return self.sweep.count

    def __iter__(self) -> Iterator[Frame]:
        received = (index for index in range(self.sweep.count) if index not in self.sweep.lost)
        lead = self.lead or lead_for(self.size[0] * self.size[1] * self.channels * BYTES_A_VALUE)
        return in_order(self._read, received, lead)

    def _read(self, index: int) -> Frame:
        path = inside(self.folder, frame_file(self.sweep, index))
        recorded = self.sweep.sha256[index] if self.sweep.sha256 else None
        values, saturated = read_picture(path, recorded)
        require_size(path, values, self.size)
        require_channels(path, values, self.channels)
        values, saturated = windowed(path, self.region, values, saturated)
        return Frame(index=index, values=values, saturated=saturated)


@dataclass(frozen=True, kw_only=True)
class VideoFrames(Shown):
    """Frames of a video, from `video_start` on; lost ones are not in it, so those after them follow at once."""

    sweep: Sweep
    path: Path
    size: tuple[int, int]
    """(width, height) of the files."""
    channels: int
    region: Region | None = None
    """What is kept of a frame."""

    def __len__(self) -> int:
        return self.sweep.count

    def __iter__(self) -> Iterator[Frame]:
        if not self.path.is_file():
            raise CaptureError(f"{self.path}: no such file")
        if self.sweep.sha256 and self.sweep.sha256[0]:
            require_checksum(self.path, self.sweep.sha256[0])
        present = [index for index in range(self.sweep.count) if index not in self.sweep.lost]
        pictures = _decoded(self.path, self.sweep.video_start + len(present))
        number = -1
        for number, (pixels, largest) in enumerate(pictures):
            if number < self.sweep.video_start:
                continue
            index = present[number - self.sweep.video_start]
            place = f"{self.path}, frame {index}"
            values, saturated = developed(place, pixels, largest)
            require_size(place, values, self.size)
            require_channels(place, values, self.channels)
            values, saturated = windowed(place, self.region, values, saturated)
            yield Frame(index=index, values=values, saturated=saturated)
        expected = self.sweep.video_start + len(present)
        if number + 1 < expected:
            raise CaptureError(f"{self.path}: {number + 1} frames, but the manifest needs {expected}")


def _av(path: Path) -> Any:
    try:
        import av
    except ImportError:
        raise MissingExtraError(f"{path}: reading a video needs PyAV: pip install 'reflectsep[video]'") from None
    return av


def _decoded(path: Path, count: int) -> Iterator[tuple[np.ndarray, int]]:
    """The first `count` pictures of a video (height, width[, 3]) and the value that stands for 1."""
    av = _av(path)
    done = 0
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise CaptureError(f"{path}: no video stream in it")
            stream = container.streams.video[0]
            stream.codec_context.options = {"err_detect": "crccheck+explode"}
            frames = container.decode(stream)
            while done < count and (frame := _sound(av, frames)) is not None:
                yield _stored(frame)
                done += 1
    except (av.error.FFmpegError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise CaptureError(f"{path}: cannot be decoded at frame {done} of the video: {reason}") from error


def _sound(av: Any, frames: Iterator[Any]) -> Any:
    """The next frame, None after the last.

    FFV1 fills a damaged slice up from the frame before, marks nothing and only logs it; so the log is listened to.

    Raises:
        ValueError: the decoder complained.
    """
    level = av.logging.get_level()
    av.logging.set_level(av.logging.ERROR)
    try:
        with av.logging.Capture(local=False) as complaints:
            frame = next(frames, None)
    finally:
        av.logging.set_level(level)
    if complaints:
        raise ValueError(f"{complaints[0][1]}: {complaints[0][2]}")
    if frame is not None and frame.is_corrupt:
        raise ValueError("damaged")
    return frame


def _stored(frame: Any) -> tuple[np.ndarray, int]:
    """A video frame's pixels as they are stored, or, where they are not grey or RGB, converted to RGB."""
    name, bits = frame.format.name, frame.format.components[0].bits
    if name.startswith("gray") and bits <= 16 and not name.startswith("grayf"):
        return _plane(frame, 0, name, bits), 2**bits - 1
    if name.startswith("gbrp") and bits <= 16 and not name.startswith("gbrpf"):
        green, blue, red = (_plane(frame, plane, name, bits) for plane in range(3))
        return np.stack([red, green, blue], axis=-1), 2**bits - 1
    if bits <= 8:
        return frame.to_ndarray(format="rgb24"), 255
    # White of a deep YUV picture comes out somewhere from 255 * 256 on, according to its depth: all of that is clipped.
    white = 255 * 256
    return np.minimum(frame.to_ndarray(format="rgb48le"), white), white


def _plane(frame: Any, index: int, name: str, bits: int) -> np.ndarray:
    """One stored plane (height, width), without the padding of its lines."""
    plane = frame.planes[index]
    kind = np.dtype(np.uint8) if bits <= 8 else np.dtype(">u2" if name.endswith("be") else "<u2")
    lines = np.frombuffer(plane, dtype=kind).reshape(-1, plane.line_size // kind.itemsize)
    return lines[: frame.height, : frame.width].astype(np.uint8 if bits <= 8 else np.uint16)
