"""Files of RTI viewers: `info.json` with planes (Relight, OpenLIME), and `.ptm`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import imagecodecs
import numpy as np

from reflectsep.io.files import atomic_write, write_json

QUALITY = 95
PTM_ORDER = (3, 5, 4, 1, 2, 0)
"""A `.ptm` holds u^2, v^2, uv, u, v, 1; planes and `codes` here are 1, u, v, u^2, uv, v^2."""


def write_relight(
    folder: Path, codes: np.ndarray, *, family: str, scales: Sequence[float], biases: Sequence[float]
) -> None:
    """Write `info.json` and `plane_0.jpg` and on, one plane a term, its red, green and blue coefficient as a colour.

    Args:
        folder: there already.
        codes: uint8 (terms, channels, height, width), 1 or 3 channels.
        family: `ptm` or `hsh`.
        scales: of each term: value = (code / 255 - bias) * scale.
        biases: of each term.
    """
    terms, _, height, width = codes.shape
    for k, plane in enumerate(codes):
        pixels = np.ascontiguousarray(np.broadcast_to(plane, (3, height, width)).transpose(1, 2, 0))
        # No subsampling: what is stored as colour are numbers.
        data = imagecodecs.jpeg8_encode(pixels, level=QUALITY, colorspace="RGB", subsampling="444")
        atomic_write(folder / f"plane_{k}.jpg", lambda path, data=data: path.write_bytes(data))
    document = {
        "width": width,
        "height": height,
        "format": "jpg",
        "type": family,
        "colorspace": "rgb",
        "nplanes": 3 * terms,
        "quality": QUALITY,
        "materials": [
            {"scale": [s for s in scales for _ in range(3)], "bias": [b for b in biases for _ in range(3)]},
        ],
    }
    write_json(folder / "info.json", document)


def write_ptm(path: Path, codes: np.ndarray, *, scales: Sequence[float], biases: Sequence[float]) -> None:
    """Write a `.ptm` of version 1.2: RGB, or for one channel LRGB with a white colour.

    Args:
        path: file to make.
        codes: uint8 (6, channels, height, width), terms 1, u, v, u^2, uv, v^2.
        scales: of each term, for values of 0 to 1 and codes over 255.
        biases: of each term, of 0 to 1; multiples of 1/255.

    Raises:
        ValueError: not six terms.
    """
    if len(codes) != 6:
        raise ValueError(f"{path}: {len(codes)} terms; a .ptm has 6")
    _, channels, height, width = codes.shape
    kind = "PTM_FORMAT_RGB" if channels == 3 else "PTM_FORMAT_LRGB"
    scale = " ".join(f"{scales[k]:.9g}" for k in PTM_ORDER)
    bias = " ".join(str(round(255 * biases[k])) for k in PTM_ORDER)
    header = f"PTM_1.2\n{kind}\n{width}\n{height}\n{scale}\n{bias}\n".encode("ascii")
    # Rows bottom up; the six codes of a pixel side by side, one block a channel.
    blocks = codes[list(PTM_ORDER)][:, :, ::-1].transpose(1, 2, 3, 0)
    body = np.ascontiguousarray(blocks).tobytes()
    if channels == 1:
        body += b"\xff" * (3 * width * height)
    atomic_write(path, lambda temporary: temporary.write_bytes(header + body))
