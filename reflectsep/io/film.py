"""Films of relit pictures: GIF through Pillow; MP4 (H.264) and FFV1 in Matroska through PyAV, an extra."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image

from reflectsep.errors import MissingExtraError, ResultError

Film = Literal["gif", "mp4", "ffv1"]
SUFFIX: dict[str, str] = {"gif": ".gif", "mp4": ".mp4", "ffv1": ".mkv"}
GIF_TICK_S = 0.01
"""Time in a GIF is counted in hundredths of a second."""
CRF = "16"
"""Of H.264: visually lossless."""
BT_709, SRGB_CURVE, LIMITED, FULL = 1, 13, 1, 2
"""Codes of ITU-T H.273 for matrix and primaries and for the curve; range as PyAV counts it."""


def require_film(path: Path, kind: Film) -> None:
    """Make sure, before any work is done, that a film of this kind can be written.

    Raises:
        MissingExtraError: PyAV is needed and not installed.
    """
    if kind != "gif":
        _av(path)


def write_film(path: Path, frames: Iterator[np.ndarray], *, kind: Film, fps: float) -> int:
    """Write a film that loops (GIF) or plays once (the others).

    Args:
        path: file to make; give it the suffix of `SUFFIX`. Not atomic: write into a folder that is.
        frames: (height, width, 3), uint8 for GIF and MP4, uint16 for FFV1; all of one size.
        kind: GIF has 256 colours a frame, exact where red, green and blue are equal; MP4 is lossy, its odd last row or
            column repeated once; FFV1 is lossless at 16 bits.
        fps: frames a second; a GIF takes the nearest hundredth of a second a frame.

    Returns:
        Number of frames.

    Raises:
        ResultError: no frame.
        MissingExtraError: PyAV is needed and not installed.
    """
    count = _write_gif(path, frames, fps) if kind == "gif" else _write_video(path, frames, kind, fps)
    if not count:
        raise ResultError(f"{path}: no picture to make a film of; expected at least one")
    return count


def _write_gif(path: Path, frames: Iterator[np.ndarray], fps: float) -> int:
    pictures = [_paletted(frame) for frame in frames]
    if pictures:
        duration_ms = 1000 * GIF_TICK_S * max(2, round(1 / fps / GIF_TICK_S))
        # Every frame is whole (disposal 1, no optimising): some viewers mend changed parts wrongly.
        pictures[0].save(
            path, save_all=True, append_images=pictures[1:], duration=duration_ms, loop=0, disposal=1, optimize=False
        )
    return len(pictures)


def _paletted(frame: np.ndarray) -> Image.Image:
    """A frame with a palette of its own; grey frames keep every value."""
    if bool((frame == frame[..., :1]).all()):
        return Image.fromarray(np.ascontiguousarray(frame[..., 0]))
    return Image.fromarray(np.ascontiguousarray(frame)).quantize(256, method=Image.Quantize.MEDIANCUT)


def _write_video(path: Path, frames: Iterator[np.ndarray], kind: Film, fps: float) -> int:
    av = _av(path)
    codec, form, stored = ("libx264", "rgb24", "yuv420p") if kind == "mp4" else ("ffv1", "gbrp16le", "gbrp16le")
    count = 0
    with av.open(str(path), "w") as container:
        stream: Any = None
        for frame in frames:
            pixels = _even(frame) if kind == "mp4" else frame
            if stream is None:
                stream = container.add_stream(codec, rate=Fraction(fps).limit_denominator(1001))
                stream.height, stream.width = pixels.shape[:2]
                stream.pix_fmt = stored
                if kind == "mp4":
                    stream.options = {"crf": CRF, "preset": "medium"}
                    _say_colours(stream.codec_context)
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format=form)
            if kind == "mp4":
                picture = picture.reformat(
                    format=stored, src_color_range=FULL, dst_colorspace=BT_709, dst_color_range=LIMITED
                )
            for packet in stream.encode(picture):
                container.mux(packet)
            count += 1
        for packet in stream.encode() if stream is not None else ():
            container.mux(packet)
    return count


def _say_colours(codec: Any) -> None:
    """Write down how colour is stored: left to guess, players take one matrix for small films and another for large."""
    codec.colorspace = codec.color_primaries = BT_709
    codec.color_trc = SRGB_CURVE
    codec.color_range = LIMITED


def _even(frame: np.ndarray) -> np.ndarray:
    """H.264 stores colour at half the resolution: sizes must be even."""
    return np.pad(frame, ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)), mode="edge")


def _av(path: Path) -> Any:
    try:
        import av
    except ImportError:
        raise MissingExtraError(
            f"{path}: films of this kind need PyAV: pip install 'reflectsep[video]', or take format=gif or format=png"
        ) from None
    return av
