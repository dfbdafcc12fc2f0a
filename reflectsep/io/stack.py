"""The full pictures, dark pictures and mask of a capture, as stored: sizes checked, nothing linearised yet."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.data import Capture, Picture, Region, Sweep
from reflectsep.errors import CaptureError
from reflectsep.io.capture import checksum
from reflectsep.io.files import inside
from reflectsep.io.pictures import read_picture
from reflectsep.room import empty

SAME_EXPOSURE = 0.01
"""Relative difference up to which two exposures are the same."""


@dataclass(frozen=True, kw_only=True)
class RawPictures:
    """Full pictures as stored, in the order of `names`, the basis first."""

    names: tuple[str, ...]
    values: Float[Tensor, "lights channels height width"]
    """0 to 1 of an integer file; NaN where a float file has no finite value."""
    saturated: Bool[Tensor, "lights channels height width"]
    exposure_s: tuple[float | None, ...]


def read_full(capture: Capture) -> RawPictures:
    """Every full picture, in the order of `capture.names`.

    Raises:
        CaptureError: a picture that cannot be read, of another size or number of channels, or all zero.
    """
    values = saturated = None
    for i, name in enumerate(capture.names):
        picture, clipped = _read(capture, capture.full(name).file, None if values is None else values[0])
        if not picture.nan_to_num().any():
            raise CaptureError(f"{capture.folder / capture.full(name).file}: every pixel is zero; no light was on?")
        if values is None or saturated is None:
            values = empty(len(capture.names), *picture.shape, dtype=picture.dtype)
            saturated = empty(len(capture.names), *clipped.shape, dtype=clipped.dtype)
        values[i], saturated[i] = picture, clipped
    assert values is not None  # a capture has lights
    assert saturated is not None
    return RawPictures(
        names=capture.names,
        values=values,
        saturated=saturated,
        exposure_s=tuple(capture.full(name).exposure_s for name in capture.names),
    )


def read_dark(capture: Capture, exposure_s: float | None) -> Float[Tensor, "channels height width"] | None:
    """The dark picture that belongs to an exposure: the mean of those within 1 % of it.

    A single dark picture of unknown exposure belongs to all; so does a single one where `exposure_s` is unknown.

    Args:
        capture: whose dark pictures.
        exposure_s: of the picture to be corrected; None where unknown.

    Returns:
        As stored; None where there is no dark picture, or none of this exposure.

    Raises:
        CaptureError: a dark picture that cannot be read or has another size; or several, and nothing to choose by.
    """
    darks = [picture for picture in capture.images if picture.kind == "dark"]
    if not darks:
        return None
    if len(darks) == 1 and (exposure_s is None or darks[0].exposure_s is None):
        return _read(capture, darks[0].file, None)[0]
    unknown = [picture.file for picture in darks if picture.exposure_s is None]
    if exposure_s is None or unknown:
        which = f"dark picture {unknown[0]}" if unknown else "the picture"
        raise CaptureError(f"{capture.folder}: {len(darks)} dark pictures, but the exposure of {which} is not known")
    chosen = [picture for picture in darks if _same(picture, exposure_s)]
    if not chosen:
        return None
    first = _read(capture, chosen[0].file, None)[0]
    return torch.stack([first, *(_read(capture, picture.file, first)[0] for picture in chosen[1:])]).mean(0)


def read_sweep_dark(capture: Capture, sweep: Sweep) -> Float[Tensor, "channels height width"] | None:
    """The dark picture of a sweep's frames: the one it names, else the one of its exposure, else None.

    Raises:
        CaptureError: as `read_dark`.
    """
    if sweep.dark is None:
        return read_dark(capture, sweep.exposure_s)
    return _read(capture, sweep.dark, None)[0]


def read_one(capture: Capture, file: str) -> Float[Tensor, "channels height width"]:
    """A picture of the capture, as stored.

    Raises:
        CaptureError: it cannot be read, or has another size than the manifest says.
    """
    return _read(capture, file, None)[0]


def read_bracket(
    capture: Capture, light: str, like: Float[Tensor, "channels height width"]
) -> list[tuple[float, Float[Tensor, "channels height width"], Bool[Tensor, "channels height width"]]]:
    """Exposure, values as stored and clipped ones of every full picture of a light.

    Raises:
        CaptureError: one that cannot be read or has another size or number of channels than `like`.
    """
    found = []
    for picture in capture.images:
        if picture.kind == "full" and picture.light == light:
            values, clipped = _read(capture, picture.file, like)
            found.append((picture.exposure_s or 0.0, values, clipped))
    return found


def read_mask(capture: Capture) -> Bool[Tensor, "height width"]:
    """Where the object is: pixels of the mask above one half in any channel; everywhere when there is no mask.

    Raises:
        CaptureError: it cannot be read, has another size, or is empty.
    """
    if capture.mask is None:
        width, height = kept_size(capture)
        return torch.ones((height, width), dtype=torch.bool)
    values, _ = _read(capture, capture.mask, None)
    mask = (values > 0.5).any(dim=0)
    if not mask.any():
        where = "it" if capture.region is None else f"its region {capture.region}"
        raise CaptureError(f"{capture.folder / capture.mask}: the mask is empty: no pixel of {where} is above one half")
    return mask


def kept_size(capture: Capture) -> tuple[int, int]:
    """(width, height) of what is kept of a picture: its region, or all of it.

    Raises:
        CaptureError: the picture cannot be read.
    """
    if capture.region is not None:
        return capture.region.width, capture.region.height
    return picture_size(capture)


def picture_size(capture: Capture) -> tuple[int, int]:
    """(width, height) of the files: the manifest's, or that of the first basis picture.

    Raises:
        CaptureError: the picture cannot be read.
    """
    if capture.size is not None:
        return capture.size
    path = inside(capture.folder, capture.full(capture.basis[0]).file)
    values, _ = read_picture(path)
    return (values.shape[2], values.shape[1])


def windowed(path: Path | str, region: Region | None, *pictures: Tensor) -> tuple[Tensor, ...]:
    """What is to be kept of pictures (..., height, width).

    Raises:
        CaptureError: the region is not inside of them.
    """
    if region is None:
        return pictures
    for picture in pictures:
        height, width = picture.shape[-2:]
        if not region.inside((width, height)):
            raise CaptureError(
                f"{path}: {width}x{height}, but region={region} (x, y, width, height) is to be kept of it"
            )
    return tuple(region.of(picture) for picture in pictures)


def require_size(path: Path | str, values: Tensor, size: tuple[int, int]) -> None:
    """Raise CaptureError unless a picture (..., height, width) has `size` (width, height)."""
    height, width = values.shape[-2:]
    if (width, height) != tuple(size):
        raise CaptureError(f"{path}: {width}x{height}, but the manifest says {size[0]}x{size[1]}")


def require_channels(path: Path | str, values: Tensor, expected: int) -> None:
    """Raise CaptureError unless a picture (channels, height, width) has as many channels as the others."""
    if values.shape[0] != expected:
        raise CaptureError(f"{path}: {_channels(values.shape[0])}, but the full pictures have {_channels(expected)}")


def _read(capture: Capture, file: str, like: Tensor | None) -> tuple[Tensor, Tensor]:
    """A picture of the capture, of the right size and, with `like`, of as many channels."""
    path = inside(capture.folder, file)
    values, saturated = read_picture(path, checksum(capture, file))
    if capture.size is not None:
        require_size(path, values, capture.size)
    values, saturated = windowed(path, capture.region, values, saturated)
    if like is not None:
        if capture.size is None and values.shape[1:] != like.shape[1:]:
            (height, width), (tall, wide) = values.shape[1:], like.shape[1:]
            raise CaptureError(f"{path}: {width}x{height}, but the first picture is {wide}x{tall}")
        require_channels(path, values, like.shape[0])
    return values, saturated


def _same(picture: Picture, exposure_s: float) -> bool:
    return picture.exposure_s is not None and abs(picture.exposure_s / exposure_s - 1) <= SAME_EXPOSURE


def _channels(count: int) -> str:
    return "1 channel" if count == 1 else f"{count} channels"
