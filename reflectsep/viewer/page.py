"""The page itself: results as JSON and packed tiles inside one HTML file that loads nothing from anywhere."""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from reflectsep.errors import ResultError
from reflectsep.flags import WORDS, Flag, count
from reflectsep.io.files import atomic_write
from reflectsep.progress import Progress, silent
from reflectsep.separation import Separation
from reflectsep.viewer.measured import coded, measured_pictures, reduced
from reflectsep.viewer.planes import (
    APRON,
    FLAG_BITS,
    TILE,
    Level,
    as_drawn,
    full_level,
    packed,
    pyramid,
    relit,
    root_scale,
    stored,
    tile,
    tiles_of,
)

SCRIPTS = ("state.js", "data.js", "lights.js", "draw.js", "panel.js", "pointer.js", "main.js")
"""Parts of the page's program, in their order."""


@dataclass(frozen=True, kw_only=True)
class Shown:
    """A result as it goes into a page."""

    name: str
    separation: Separation
    white: float
    """Linear value that is shown as white at exposure 0."""


@dataclass(frozen=True, kw_only=True)
class Accuracy:
    """How far the page's pictures of the basis lights are from `Separation.relight`, by the page's own formula."""

    psnr_db: float
    within_one: float
    """Share of the 8-bit sRGB values on the object that are at most one code apart."""
    largest: int
    """Largest difference of two codes."""


def write_page(
    path: Path | str,
    results: Sequence[Shown],
    *,
    max_pixels: int = 4_000_000,
    measured: bool = True,
    progress: Progress = silent,
) -> tuple[Accuracy, ...]:
    """Write one or two results as a relighting page.

    Args:
        path: HTML file to make.
        results: what to show; two can be compared side by side.
        max_pixels: finest level of the pyramid; a larger result is reduced by whole powers of two.
        measured: put the measured pictures in as well.
        progress: told of every tile.

    Returns:
        Of every result, how far the page's numbers are from it.

    Raises:
        ResultError: no result or more than two, no pixel on the object, or parameters that are not finite.
    """
    if not 1 <= len(results) <= 2:
        raise ResultError(f"{path}: {len(results)} results; a page shows one or two")
    blocks: list[str] = []
    described, accuracies = [], []
    for index, shown in enumerate(results):
        _check(shown)
        levels = pyramid(full_level(shown.separation), max_pixels)
        scale = root_scale(shown.separation)
        accuracy = accuracy_of(shown.separation, as_drawn(levels[0], scale))
        document = description(shown, accuracy)
        document["scale"] = list(scale)
        document["levels"] = _pack_levels(f"r{index}", levels, scale, blocks, progress)
        if measured:
            document["measured"] = _pack_measured(f"m{index}", shown, levels[0], blocks)
        described.append(document)
        accuracies.append(accuracy)
    layout = {"tile": TILE, "apron": APRON, "flag_bits": FLAG_BITS, "flags": WORDS}
    text = page_text({"results": described, **layout}, blocks)
    atomic_write(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
    return tuple(accuracies)


def page_text(document: Mapping[str, Any], blocks: Sequence[str]) -> str:
    """The HTML: template, style, program, data. Nothing of a result is ever taken for markup."""
    title = " and ".join(str(result["name"]) for result in document["results"])
    parts = {
        "TITLE": html.escape(title),
        "STYLE": asset("style.css"),
        "SHADER": asset("shader.frag"),
        "DATA": safe_json(document),
        "BLOCKS": "\n".join(blocks),
        "PROGRAM": "\n".join(asset(name) for name in SCRIPTS),
    }
    # Split once by the template's own marks, so that no part can be taken for a mark.
    pieces = asset("page.html").split("%%")
    return "".join(parts[piece] if i % 2 else piece for i, piece in enumerate(pieces))


def asset(name: str) -> str:
    """A text file that belongs to the page."""
    return (files("reflectsep.viewer") / "assets" / name).read_text(encoding="utf-8")


def safe_json(document: Any) -> str:
    """JSON that may stand inside a script element: no `<`, so no end tag and no comment begins in it."""
    text = json.dumps(document, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def description(shown: Shown, accuracy: Accuracy) -> dict[str, Any]:
    """What the page knows of a result beside its planes."""
    separation, document = shown.separation, shown.separation.document
    vectors = separation.light_vectors
    lights = []
    for i, name in enumerate(separation.names):
        lights.append({"name": name, "alpha": separation.alpha[i].tolist()})
        if vectors is not None:
            lights[-1]["vector"] = vectors[i].tolist()
    height, width = separation.mask.shape
    return {
        "name": shown.name,
        "object": str(document.get("object", "")),
        "model": str(document.get("model", "")),
        "warnings": [str(warning) for warning in document.get("warnings", [])],
        "n_d_source": str(document.get("n_d_source", "")),
        "created": str(document.get("created", "")),
        "width": width,
        "height": height,
        "box": object_box(separation.mask),
        "channels": separation.d.shape[1],
        "scattered": bool(separation.s.any()),
        "white": shown.white,
        "lights": lights,
        "basis": None if vectors is None else vectors[:3].tolist(),
        "globals": {key: getattr(separation, key).tolist() for key in ("a", "n_s", "n_d", "f", "softness", "fresnel")},
        "ggx": separation.ggx,
        "M": separation.M.tolist(),
        "materials": separation.materials.tolist(),
        "ceilings": [value if math.isfinite(value) else None for value in separation.ceilings.tolist()],
        "flag_counts": count(separation.flags),
        "flag_values": {str(flag.name): int(flag) for flag in Flag},
        "accuracy": {
            "psnr_db": accuracy.psnr_db if math.isfinite(accuracy.psnr_db) else None,
            "within_one": accuracy.within_one,
            "largest": accuracy.largest,
        },
    }


def object_box(mask: Bool[Tensor, "height width"]) -> list[int]:
    """[left, top, right, bottom] of the object with a margin of 3 %, in pixels."""
    sides = []
    for seen, size in ((mask.any(0), mask.shape[1]), (mask.any(1), mask.shape[0])):
        place = torch.nonzero(seen)[:, 0]
        first, last = int(place[0]), int(place[-1]) + 1
        margin = round(0.03 * (last - first))
        sides.append((max(0, first - margin), min(size, last + margin)))
    (left, right), (top, bottom) = sides
    return [left, top, right, bottom]


def accuracy_of(separation: Separation, level: Level) -> Accuracy:
    """Compare the basis lights' pictures from a stored level with `Separation.relight`, reduced alike."""
    mask = level.mask
    pairs, error, peak = [], 0.0, 0.0
    for alpha in torch.eye(3):
        true = reduced(separation.relight(alpha), separation.mask, level.factor)[:, mask]
        ours = relit(separation, level, alpha)[:, mask]
        error += float((ours - true).double().square().mean()) / 3.0
        peak = max(peak, float(true.max()))
        pairs.append((ours, true))
    white, near, largest = max(peak, 1e-12), 0.0, 0
    for pair in pairs:  # one light at a time: at 24 megapixels a copy is much
        ours, true = (torch.from_numpy(coded(picture[:, None], white).astype("int16")) for picture in pair)
        apart = (ours - true).abs()
        near += float((apart <= 1).double().mean()) / 3.0
        largest = max(largest, int(apart.max()))
    return Accuracy(
        psnr_db=math.inf if error == 0 else 10.0 * math.log10(white * white / error), within_one=near, largest=largest
    )


def _check(shown: Shown) -> None:
    """Refuse what cannot be drawn."""
    separation = shown.separation
    if not bool(separation.mask.any()):
        raise ResultError(f"{shown.name}: no pixel on the object; there is nothing to show")
    for name in ("d", "s", "B"):
        bad = int((~getattr(separation, name)[..., separation.mask].isfinite()).sum())
        if bad:
            raise ResultError(f"{shown.name}: {bad} values of {name} on the object are not finite numbers")


def _pack_levels(
    prefix: str, levels: Sequence[Level], scale: tuple[float, float], blocks: list[str], progress: Progress
) -> list[dict[str, Any]]:
    """Add every tile of every level to `blocks`; returns what the page must know to find them."""
    listed = []
    work = [tiles_of(*level.size) for level in levels]
    total, done = sum(map(len, work)), 0
    for depth, (level, places) in enumerate(zip(levels, work, strict=True)):
        planes = stored(level, scale)
        for at in places:
            blocks.append(_block(f"{prefix}-{depth}-{at[0]}-{at[1]}", packed(tile(planes, at))))
            done += 1
            progress("page", done, total)
        listed.append({"width": level.size[0], "height": level.size[1], "factor": level.factor})
    return listed


def _pack_measured(prefix: str, shown: Shown, level: Level, blocks: list[str]) -> dict[str, Any]:
    """Add the measured pictures, tile by tile, at the finest level's resolution."""
    pictures = measured_pictures(shown.separation)
    small = {name: reduced(picture, shown.separation.mask, level.factor) for name, picture in pictures.items()}
    white = max(1e-12, *(float(picture.max()) for picture in small.values()))
    for light, picture in enumerate(small.values()):
        planes = coded(picture, white)
        for at in tiles_of(*level.size):
            blocks.append(_block(f"{prefix}-{light}-{at[0]}-{at[1]}", packed(tile(planes, at))))
    return {"lights": list(small), "white": white}


def _block(name: str, data: bytes) -> str:
    text = base64.b64encode(data).decode("ascii")
    return f'<script type="text/plain" id="{name}">{text}</script>'
