"""A result folder: EXR files of named layers, previews, and `separation.json` with their checksums, all or nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from reflectsep.errors import CaptureError, ResultError
from reflectsep.io.exr import read_channels, write_channels
from reflectsep.io.files import atomic_folder, inside, read_json, sha256, write_json
from reflectsep.io.pictures import write_picture

FORMAT = "reflectsep-result/2"
DOCUMENT = "separation.json"


def write_result(
    out: Path | str,
    layers: Mapping[str, Mapping[str, np.ndarray]],
    document: Mapping[str, Any],
    overwrite: bool,
    previews: Mapping[str, Tensor] | None = None,
) -> None:
    """Write a result folder, whole or not at all.

    Args:
        out: folder to make.
        layers: arrays (height, width) of float16, float32 or uint32 by channel name, by file name (`specular.exr`).
        document: goes into `separation.json`, with `format` and `checksums` (SHA-256 by file name) added.
        overwrite: replace a result that is there, once the new one is whole.
        previews: pictures (channels, height, width), 0 to 1 and encoded for a screen, by name; 8-bit PNGs.

    Raises:
        ResultError: `out` exists and may not be replaced, or a name leaves the folder.
        ValueError: a layer, preview or document that its file format cannot hold.
    """
    out = Path(out)
    if taken := {"format", "checksums"} & set(document):
        raise ValueError(f"{out}: the document has {' and '.join(sorted(taken))}, which the writer adds")
    with atomic_folder(out, overwrite) as folder:
        for name, channels in layers.items():
            write_channels(_inside(folder, name), channels)
        for name, picture in (previews or {}).items():
            write_picture(_inside(folder, f"previews/{name.removesuffix('.png')}.png"), picture, bits=8)
        checksums = {name: sha256(folder / name) for name in layers}
        write_json(folder / DOCUMENT, {"format": FORMAT, **document, "checksums": checksums})


def read_document(folder: Path | str) -> dict[str, Any]:
    """`separation.json` of a result folder.

    Raises:
        ResultError: no result there, or of another format.
    """
    folder = Path(folder)
    if not (folder / DOCUMENT).is_file():
        raise ResultError(f"{folder}: not a result: no {DOCUMENT} in it")
    document = read_json(folder / DOCUMENT, ResultError)
    found = document.get("format") if isinstance(document, dict) else None
    if found != FORMAT:
        raise ResultError(f"{folder / DOCUMENT}: format is {found!r}, expected {FORMAT!r}")
    if not isinstance(document.get("checksums"), dict):
        raise ResultError(f"{folder / DOCUMENT}: no checksums in it")
    return document


def read_result(folder: Path | str, layers: Sequence[str]) -> tuple[dict[str, dict[str, np.ndarray]], dict[str, Any]]:
    """Read some layers of a result, and its document.

    Args:
        folder: a result folder.
        layers: file names, e.g. `specular.exr`.

    Returns:
        Arrays (height, width), float32 or uint32, bit for bit as written, by channel name, by file name; and the
        document with `format` and `checksums`.

    Raises:
        ResultError: no result, another format, a layer that is missing, damaged or not the one that was written.
    """
    folder = Path(folder)
    document = read_document(folder)
    checksums = document["checksums"]
    read: dict[str, dict[str, np.ndarray]] = {}
    for name in layers:
        path = _inside(folder, name)
        if name not in checksums or not path.is_file():
            raise ResultError(f"{path}: missing; the result has {', '.join(sorted(checksums)) or 'no layers'}")
        found = sha256(path)
        if found != checksums[name]:
            raise ResultError(
                f"{path}: damaged: its SHA-256 is {found[:12]}..., {DOCUMENT} says {checksums[name]!s:.12}..."
            )
        try:
            read[name] = read_channels(path)
        except CaptureError as error:
            raise ResultError(str(error)) from error
    return read, document


def _inside(folder: Path, name: str) -> Path:
    try:
        return inside(folder, name)
    except CaptureError as error:
        raise ResultError(str(error)) from error
