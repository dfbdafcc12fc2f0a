"""From what the camera gives to files in the session, and from files to the frames of a sweep."""

from __future__ import annotations

import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from reflectsep.errors import CameraError, CaptureError
from reflectsep.io.files import atomic_write
from reflectsep.io.pictures import SUFFIXES, read_picture, write_picture
from reflectsep.rig.devices import RawFrame
from reflectsep.rig.exposure import Brightness
from reflectsep.rig.session import Session
from reflectsep.rig.sync import unwrap

PREVIEW_EVERY_S = 0.5
PREVIEW_PX = 640


@dataclass(frozen=True, kw_only=True)
class Stored:
    """A frame that has been dealt with: on disk, or lost with a reason."""

    file: Path | None
    sequence: int | None
    device_time_s: float | None
    host_time_s: float | None
    fault: str | None
    level: float | None = None
    """Mean value."""


@dataclass(frozen=True, kw_only=True)
class Slot:
    """One place in the row of a sweep's frames: a frame, or the gap that it left."""

    file: Path | None
    time_s: float
    """By the camera's clock."""


class FrameStore:
    """Writes frames into the folder of a step, checks them, and keeps the preview up to date.

    Args:
        session: Where to.
        folder: Of the step's incoming files.
        size: (width, height) that every frame must have; None: that of the first.
    """

    def __init__(self, session: Session, folder: Path, size: tuple[int, int] | None) -> None:
        self._session, self._folder = session, folder
        self.size = size
        self.channels: int | None = None
        self.stored: list[Stored] = []
        self.brightest: Brightness | None = None
        self._preview_s = -PREVIEW_EVERY_S

    def add(self, frame: RawFrame) -> np.ndarray | None:
        """Store one frame.

        Returns:
            Its values from 0 to 1, (height, width) or (height, width, 3); None where it is not whole.

        Raises:
            OSError: the disk.
        """
        index = len(self.stored)
        fault, path, values = frame.fault, None, None
        if fault is None:
            try:
                path, values = self._write(frame, f"{index:06d}")
            except (CameraError, CaptureError) as error:
                fault = str(error)
        self.stored.append(
            Stored(
                file=path,
                sequence=frame.sequence,
                device_time_s=frame.device_time_s,
                host_time_s=frame.host_time_s,
                fault=fault,
                level=None if values is None else float(values.mean()),
            )
        )
        facts = {"sequence": frame.sequence, "device_time_s": frame.device_time_s, "host_time_s": frame.host_time_s}
        name = None if path is None else path.name
        self._session.event("frame", index=index, file=name, fault=fault, **facts)
        if values is not None:
            self._show(values)
        return values

    def _write(self, frame: RawFrame, name: str) -> tuple[Path, np.ndarray]:
        if frame.file is not None:
            return self._copy(frame.file, name)
        if frame.pixels is None:
            raise CameraError("a frame without pixels")
        values = frame.pixels / float(frame.largest)
        self._check(values)
        path = self._folder / f"{name}.png"
        write_picture(path, torch.from_numpy(_codes(frame.pixels, frame.largest)))
        return path, values

    def _copy(self, source: Path, name: str) -> tuple[Path, np.ndarray]:
        if source.suffix.lower() not in SUFFIXES:
            raise CameraError(f"{source}: no picture format that can be used; known are {' '.join(SUFFIXES)}")
        path = self._folder / f"{name}{source.suffix.lower()}"
        atomic_write(path, lambda temporary: shutil.copyfile(source, temporary))
        try:
            values = read_picture(path)[0].numpy().transpose(1, 2, 0).astype(float)
            values = values[..., 0] if values.shape[-1] == 1 else values
            self._check(values)
        except BaseException:
            path.unlink()
            raise
        return path, values

    def _check(self, values: np.ndarray) -> None:
        size, channels = (values.shape[1], values.shape[0]), values.shape[2] if values.ndim == 3 else 1
        if self.size is None:
            self.size, self.channels = size, channels
        if size != self.size or (self.channels or channels) != channels:
            expected = "x".join(map(str, self.size))
            raise CameraError(f"a frame of {size[0]}x{size[1]}, expected {expected}")
        self.channels = channels

    def _show(self, values: np.ndarray) -> None:
        now = time.monotonic()
        if now - self._preview_s < PREVIEW_EVERY_S:
            return
        self._preview_s = now
        skip = max(1, int(np.ceil(max(values.shape[:2]) / PREVIEW_PX)))
        small = values[::skip, ::skip].reshape(*values[::skip, ::skip].shape[:2], -1)
        shown = np.clip(small, 0, 1).transpose(2, 0, 1) ** (1 / 2.2)
        write_picture(self._session.folder / "preview.png", torch.from_numpy(np.ascontiguousarray(shown)))


def row(stored: Sequence[Stored], *, first: int, last: int | None, period_s: float) -> list[Slot]:
    """Frames of a sweep in order, without duplicates, with a gap for each that is missing or damaged.

    Args:
        stored: In the order of arrival.
        first: The camera's first count after a wrap.
        last: Its last before a wrap; None: it does not wrap.
        period_s: From frame to frame.

    Raises:
        CameraError: no frames, or none with a time.
    """
    timed = [s for s in stored if s.device_time_s is not None or s.host_time_s is not None]
    if not [s for s in timed if s.fault is None]:
        why = next((f" ({s.fault})" for s in stored if s.fault), "")
        raise CameraError(f"{len(stored)} frames came, none of them whole and with a time{why}")
    times = [s.device_time_s if s.device_time_s is not None else s.host_time_s for s in timed]
    numbers = _numbers(timed, times, first, last, period_s)
    slots: dict[int, Slot] = {}
    for frame, number, time_s in zip(timed, numbers, times, strict=True):
        if number not in slots or slots[number].file is None:
            slots[number] = Slot(file=None if frame.fault else frame.file, time_s=float(time_s or 0.0))
    present = sorted(slots)
    known = np.array([slots[n].time_s for n in present])
    if (np.diff(known) <= 0).any():
        if any(s.device_time_s is not None for s in timed):
            raise CameraError("the camera's times do not rise with its count of frames")
        # Arrivals out of order say little: the frames are as even as their count.
        known = known[0] + period_s * (np.array(present) - present[0])
        known += float(np.median(np.array([slots[n].time_s for n in present]) - known))
        slots = {n: Slot(file=slots[n].file, time_s=float(t)) for n, t in zip(present, known, strict=True)}
    everything = range(present[0], present[-1] + 1)
    filled = np.interp(np.array(everything), np.array(present), known)
    return [slots.get(n, Slot(file=None, time_s=float(t))) for n, t in zip(everything, filled, strict=True)]


def _numbers(
    stored: Sequence[Stored], times: Sequence[float | None], first: int, last: int | None, period_s: float
) -> list[int]:
    """Place of each frame in the row: by the camera's count, or by its time where it does not count."""
    sequences = [s.sequence for s in stored if s.sequence is not None]
    if len(sequences) == len(stored):
        return unwrap(sequences, first, last)
    array = np.array([t or 0.0 for t in times], dtype=float)
    order = np.argsort(array, kind="stable")
    gaps = np.maximum(1, np.rint(np.diff(array[order]) / period_s)).astype(int)
    places = np.concatenate([[0], np.cumsum(gaps)])
    numbers = np.empty(len(array), dtype=int)
    numbers[order] = places
    return [int(n) for n in numbers]


def _codes(pixels: np.ndarray, largest: int) -> np.ndarray:
    """Pixels as (channels, height, width), full scale at the largest code of their type; a camera of 12 bits has 16."""
    full = 255 if pixels.dtype == np.uint8 else 65535
    if largest != full:
        pixels = np.rint(np.minimum(pixels, largest) * (full / largest)).astype(pixels.dtype)
    planes = pixels[None] if pixels.ndim == 2 else pixels.transpose(2, 0, 1)
    return np.array(planes, order="C", copy=True)
