"""OpenEXR files as named two-dimensional arrays.

OpenEXR's binding has traps, all met here and nowhere else: arrays that are not C-contiguous are silently written
wrong; (h, w, 1) and (h, w, 2) arrays come out as RGB; the dictionaries it is given are changed; numpy scalars, float64
and uint8 pixels are refused. So: one contiguous 2-D array a channel, in dictionaries of our own.
"""

from __future__ import annotations

import errno
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import torch

from reflectsep.errors import CaptureError
from reflectsep.io.files import atomic_write

_TYPES = (np.dtype(np.float16), np.dtype(np.float32), np.dtype(np.uint32))
_LINES_PER_CHUNK = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}
"""By compression code: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB."""


def read_channels(path: Path | str) -> dict[str, np.ndarray]:
    """Every channel of a single-part EXR file, in the file's order.

    Args:
        path: file to read.

    Returns:
        Arrays (height, width) by channel name: float32 (half is widened, exactly) or uint32. Row 0 is the top.

    Raises:
        CaptureError: the file is missing, truncated, not EXR, has several parts, deep or subsampled channels.
    """
    path = Path(path)
    _check_whole(path)
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            # A part whose pixels could not be read is dropped by the binding, without an exception.
            if len(file.parts) != 1:
                found = f"{len(file.parts)} parts" if file.parts else "damaged pixel data"
                raise CaptureError(f"{path}: {found}; one readable part was expected")
            channels = dict(file.channels())
            return {name: _plain(path, name, channel) for name, channel in channels.items()}
    except CaptureError:
        raise
    except (RuntimeError, ValueError, TypeError, MemoryError, OSError) as error:
        raise CaptureError(f"{path}: not a readable EXR file: {' '.join(str(error).split())}") from error


def write_channels(
    path: Path | str,
    channels: Mapping[str, np.ndarray],
    attributes: Mapping[str, str | int | float | np.generic] | None = None,
) -> None:
    """Write one EXR file (scan lines, ZIP, lossless), atomically.

    Args:
        path: file to write.
        channels: arrays (height, width) of one size by channel name; float16, float32 and uint32 are kept as they are.
        attributes: extra header entries.

    Raises:
        ValueError: no channels, a channel that is not 2-D, of another size or of another type, or a name that OpenEXR
            cannot hold.
        OSError: the disk is full or cannot be written.
    """
    if not channels:
        raise ValueError(f"{path}: no channels to write")
    shape = np.shape(next(iter(channels.values())))
    pixels: dict[str, Any] = {}
    for name, array in channels.items():
        if not name or not name.isascii() or "\0" in name:
            raise ValueError(f"{path}: {name!r} is no channel name")
        if array.ndim != 2 or array.shape != shape or 0 in shape:
            raise ValueError(f"{path}: channel {name} has shape {array.shape}, a 2-D one as of the first was expected")
        if array.dtype not in _TYPES:
            raise ValueError(f"{path}: channel {name} is {array.dtype}; float16, float32 or uint32 was expected")
        pixels[name] = np.ascontiguousarray(array)
    header: dict[str, Any] = {key: _builtin(value) for key, value in (attributes or {}).items()}
    header |= {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}

    def write(temporary: Path) -> None:
        with OpenEXR.File(header, pixels) as file:
            try:
                file.write(str(temporary))
            except RuntimeError as error:  # how the library tells of a full disk
                reason = str(error).rsplit('". ', 1)[-1].strip().rstrip(".")
                raise OSError(errno.EIO, reason, str(path)) from error

    atomic_write(path, write)


def _plain(path: Path, name: str, channel: Any) -> np.ndarray:
    """A channel's pixels as a 2-D array that owns its memory."""
    pixels = channel.pixels
    if (channel.xSampling, channel.ySampling) != (1, 1):
        raise CaptureError(f"{path}: channel {name} is subsampled; one value a pixel was expected")
    if not isinstance(pixels, np.ndarray) or pixels.ndim != 2 or pixels.dtype not in _TYPES:
        raise CaptureError(f"{path}: channel {name} holds no plain 2-D picture")
    if pixels.dtype == np.float16:
        # By torch, which has the processor widen many at a time: numpy takes ten times as long.
        wide = np.empty(pixels.shape, dtype=np.float32)
        torch.from_numpy(wide).copy_(torch.from_numpy(np.require(pixels, requirements=["C", "W"])))
        return wide
    return pixels.astype(pixels.dtype, order="C", copy=True)


def _builtin(value: Any) -> str | int | float:
    """A str, int or float; numpy scalars are refused by the binding."""
    return value.item() if isinstance(value, np.generic) else value


def _check_whole(path: Path) -> None:
    """Refuse a missing, foreign or cut-off file before the library prints about it.

    Only plain scan-line files are looked into; of others (tiles, several parts) the library is the judge.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise CaptureError(f"{path}: no such file") from None
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read: {error.strerror or error}") from error
    if data[:4] != b"\x76\x2f\x31\x01":
        raise CaptureError(f"{path}: not an EXR file ({len(data)} bytes)")
    if int.from_bytes(data[4:8], "little") & 0x1A00:  # tiled, deep or several parts
        return
    try:
        whole = _reaches_the_end(data)
    except (ValueError, IndexError, KeyError):
        raise CaptureError(f"{path}: EXR header damaged or cut off ({len(data)} bytes)") from None
    if not whole:
        raise CaptureError(f"{path}: truncated EXR: {len(data)} bytes, but its pixels go beyond that")


def _reaches_the_end(data: bytes) -> bool:
    """Whether every chunk that the offset table of a scan-line file names lies within `data`."""

    def integer(start: int, size: int) -> int:
        if start + size > len(data):
            raise IndexError(start)
        return int.from_bytes(data[start : start + size], "little", signed=size == 4)

    at, window, compression = 8, (0, 0), None
    while data[at] != 0:
        name_end = data.index(0, at)
        type_end = data.index(0, name_end + 1)
        name, size, start = data[at:name_end], integer(type_end + 1, 4), type_end + 5
        if name == b"dataWindow":
            window = (integer(start + 4, 4), integer(start + 12, 4))
        elif name == b"compression":
            compression = data[start]
        at = start + max(size, 0)
    lines = _LINES_PER_CHUNK.get(compression or 0)
    if compression is None or lines is None:
        return True  # newer than this table: let the library judge
    count = -(-(window[1] - window[0] + 1) // lines)
    if count <= 0 or at + 1 + 8 * count > len(data):
        return False
    offsets = np.frombuffer(data, "<u8", count, at + 1)
    if offsets.min() == 0 or offsets.max() + 8 > len(data):
        return False
    last = int(offsets.max())
    return last + 8 + integer(last + 4, 4) <= len(data)
