"""Pictures as (channels, height, width) tensors, whatever the file: EXR, 8 or 16-bit PNG, TIFF and JPEG, camera raw.

Values are as stored: nothing is linearised, integers are divided by the largest value that their type can hold.
"""

from __future__ import annotations

import io
from pathlib import Path

import imagecodecs
import numpy as np
import tifffile
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from reflectsep.errors import CaptureError
from reflectsep.io.exr import read_channels, write_channels
from reflectsep.io.files import atomic_write, sha256
from reflectsep.io.raw import read_raw

RAW_SUFFIXES = (".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf", ".orf", ".rw2", ".pef")
"""Of camera raw files, read through rawpy (an extra)."""
SUFFIXES = (".exr", ".png", ".tif", ".tiff", ".jpg", ".jpeg", *RAW_SUFFIXES)
"""Of the files that `read_picture` reads, in lower case."""

_PNG_END = b"IEND\xaeB`\x82"


def read_picture(
    path: Path | str, checksum: str | None = None
) -> tuple[Float[Tensor, "channels height width"], Bool[Tensor, "channels height width"]]:
    """Read one picture.

    Args:
        path: file to read; its suffix says which format.
        checksum: recorded SHA-256, to be met by the file.

    Returns:
        Float32 values, and which of them are clipped (integer files: at their type's largest value; float files: none).
        One channel or R, G, B; alpha is dropped; a lone channel of any name is grey. Row 0 is the top. Values of a
        float file that are not finite come back as NaN.

    Raises:
        CaptureError: missing, truncated, damaged, of an unknown kind, no number in it, or not what `checksum` says.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise CaptureError(f"{path}: no picture format has the suffix {suffix!r}; known are {' '.join(SUFFIXES)}")
    if not path.is_file():
        raise CaptureError(f"{path}: no such file")
    if checksum is not None:
        require_checksum(path, checksum)
    if suffix == ".exr":
        return developed(path, _read_exr(path))
    if suffix in RAW_SUFFIXES:
        return read_raw(path)
    decode = {".png": _read_png, ".tif": _read_tiff, ".tiff": _read_tiff}.get(suffix, _read_jpeg)
    try:
        pixels = decode(path.read_bytes())
    except Exception as error:
        # The codecs have a dozen exception classes of their own, some of them plain RuntimeError or struct.error.
        reason = " ".join(str(error).split()) or type(error).__name__
        raise CaptureError(f"{path}: not a readable {suffix[1:].upper()} file: {reason}") from error
    return developed(path, pixels)


def developed(
    path: Path | str, pixels: np.ndarray, largest: int | None = None
) -> tuple[Float[Tensor, "channels height width"], Bool[Tensor, "channels height width"]]:
    """Stored pixels (height, width[, channels]) as values and the mask of those that are clipped.

    Args:
        path: names the picture in errors.
        pixels: unsigned integers or floats, 1 to 4 channels last; the second of two and the fourth of four are alpha.
            Contiguous planes of single-precision floats are taken over, not copied.
        largest: value that stands for 1 in an integer picture; by default the largest of its type.

    Raises:
        CaptureError: another type or number of channels, no pixels, or none of them a number.
    """
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or pixels.shape[-1] not in (1, 2, 3, 4) or pixels.size == 0:
        raise CaptureError(f"{path}: pixels of shape {pixels.shape}; height x width of 1 or 3 channels was expected")
    pixels = pixels[..., : {1: 1, 2: 1, 3: 3, 4: 3}[pixels.shape[-1]]].transpose(2, 0, 1)
    if pixels.dtype == bool:
        pixels, largest = pixels.astype(np.uint8), 1
    if pixels.dtype in (np.uint8, np.uint16):
        largest = largest or int(np.iinfo(pixels.dtype).max)
        # A quotient of two exact floats, rounded once: k / largest is the same float32 however it is made.
        values = np.empty(pixels.shape, dtype=np.float32)
        np.divide(pixels, np.float32(largest), out=values)
        clipped = np.empty(pixels.shape, dtype=bool)
        np.greater_equal(pixels, largest, out=clipped)
        return torch.from_numpy(values), torch.from_numpy(clipped)
    if not np.issubdtype(pixels.dtype, np.floating):
        raise CaptureError(f"{path}: pixels of type {pixels.dtype}; 8 or 16 unsigned bits or floats were expected")
    with np.errstate(over="ignore"):
        values = np.require(pixels, np.float32, ["C", "W"])
    finite = np.isfinite(values)
    if not finite.any():
        raise CaptureError(f"{path}: not one finite value in it")
    if not finite.all():
        values = np.where(finite, values, np.float32(np.nan))
    return torch.from_numpy(values), torch.zeros(values.shape, dtype=torch.bool)


def write_picture(path: Path | str, picture: Shaped[Tensor, "channels height width"], *, bits: int = 8) -> None:
    """Write one picture of 1 or 3 channels, atomically.

    Args:
        path: `.exr` (half for a float16 tensor, else float32; channels Y, or R, G, B) or `.png`.
        picture: floats; for PNG 0 to 1 (clipped to that), or uint8 or uint16 codes written as they are.
        bits: of a PNG made from floats, 8 or 16.

    Raises:
        ValueError: another suffix, depth or number of channels, or a value that is not a number in a PNG.
    """
    path = Path(path)
    if picture.ndim != 3 or picture.shape[0] not in (1, 3) or picture.numel() == 0:
        raise ValueError(f"{path}: a picture of shape {tuple(picture.shape)}; (1 or 3, height, width) was expected")
    pixels = picture.detach().cpu()
    if path.suffix.lower() == ".exr":
        kind = torch.float16 if pixels.dtype == torch.float16 else torch.float32
        names = "Y" if pixels.shape[0] == 1 else "RGB"
        write_channels(path, {name: plane.to(kind).numpy() for name, plane in zip(names, pixels, strict=True)})
    elif path.suffix.lower() == ".png":
        codes = _codes(path, pixels.numpy(), bits).transpose(1, 2, 0)
        codes = codes[..., 0] if codes.shape[-1] == 1 else codes
        # A copy, not ascontiguousarray: that one leaves odd strides on axes of length 1, which the codec refuses.
        # Low bits of 16 are noise: a search for repetitions (zlib's default) takes eight times longer and finds none.
        quick = {"level": 1, "strategy": 3} if codes.dtype == np.uint16 else {}
        data = imagecodecs.png_encode(np.array(codes, order="C", copy=True), **quick)
        atomic_write(path, lambda temporary: temporary.write_bytes(data))
    else:
        raise ValueError(f"{path}: pictures are written as .exr or .png")


def require_checksum(path: Path, recorded: str) -> None:
    """Raise CaptureError unless the file's SHA-256 is `recorded`."""
    found = sha256(path)
    if found != recorded.lower():
        raise CaptureError(f"{path}: its SHA-256 is {found[:12]}..., but {recorded[:12]}... was recorded")


def _codes(path: Path, pixels: np.ndarray, bits: int) -> np.ndarray:
    """Unsigned integers of a PNG."""
    if pixels.dtype in (np.uint8, np.uint16):
        return pixels
    if not np.issubdtype(pixels.dtype, np.floating):
        raise ValueError(f"{path}: pixels of type {pixels.dtype}; floats, uint8 or uint16 were expected")
    if bits not in (8, 16):
        raise ValueError(f"{path}: {bits} bits; a PNG has 8 or 16")
    if np.isnan(pixels).any():
        raise ValueError(f"{path}: {int(np.isnan(pixels).sum())} values are not numbers, and a PNG cannot hold them")
    largest = 2**bits - 1
    return np.rint(np.clip(pixels.astype(np.float64), 0, 1) * largest).astype(np.uint8 if bits == 8 else np.uint16)


def _read_exr(path: Path) -> np.ndarray:
    channels = read_channels(path)
    colours = {name: array for name, array in channels.items() if name != "A"}
    if set(colours) == {"R", "G", "B"}:
        return np.stack([colours[name] for name in "RGB"]).astype(np.float32, copy=False).transpose(1, 2, 0)
    if len(colours) == 1:
        return next(iter(colours.values())).astype(np.float32, copy=False)
    raise CaptureError(f"{path}: channels {' '.join(channels)}; R G B or a single one was expected")


def _read_png(data: bytes) -> np.ndarray:
    # libpng hands the pixels out before it has seen the end of the file.
    pixels = imagecodecs.png_decode(data)
    if _PNG_END not in data[-4096:]:
        raise ValueError("it ends before its end mark (truncated)")
    return pixels


def _read_jpeg(data: bytes) -> np.ndarray:
    # libjpeg paints what is missing of a truncated file grey and says nothing.
    if not _jpeg_ends(data):
        raise ValueError("it ends before its end mark (truncated)")
    pixels = imagecodecs.jpeg8_decode(data)
    if pixels.ndim == 3 and pixels.shape[-1] not in (1, 3):
        raise ValueError(f"{pixels.shape[-1]} colour components (CMYK?), 1 or 3 were expected")
    return pixels


def _jpeg_ends(data: bytes) -> bool:
    """Whether an end-of-image mark follows the start of the scan (a thumbnail in the header has one of its own)."""
    at = 2
    while data[:2] == b"\xff\xd8" and at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if marker == 0xDA:
            return data.find(b"\xff\xd9", at) >= 0
    return False


def _read_tiff(data: bytes) -> np.ndarray:
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        page = file.pages.first
        if page.photometric not in (
            tifffile.PHOTOMETRIC.MINISBLACK,
            tifffile.PHOTOMETRIC.RGB,
            tifffile.PHOTOMETRIC.YCBCR,
        ):
            raise ValueError(f"photometric interpretation {page.photometric}; grey or RGB was expected")
        pixels = page.asarray()
        if pixels.ndim == 3 and page.planarconfig == tifffile.PLANARCONFIG.SEPARATE:
            pixels = pixels.transpose(1, 2, 0)
        bits = page.bitspersample
    if pixels.dtype.kind == "u" and bits not in (1, 8, 16):
        raise ValueError(f"{bits} bits a sample; 8 or 16 were expected")
    return pixels.astype(bool) if bits == 1 else pixels
