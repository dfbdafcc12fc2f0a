"""A large capture fitted in parts: overlapping tiles under the globals of one first fit, put together to one result.

Feathered, a tile's say falls linearly to nothing over the middle of its overlap with the next one, so that what two of
them find is mixed there; with hard cuts each pixel is that of the tile in whose middle it lies deepest. Components are
mixed as pictures and stay the parts of the measured picture; parameters are mixed as they are, of one set of globals.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.config import FitJob, FitSettings
from reflectsep.data import Region
from reflectsep.errors import ResultError, SettingsError
from reflectsep.handed import read_handed
from reflectsep.io.capture import load_capture
from reflectsep.io.files import refuse_folder
from reflectsep.io.stack import picture_size, read_mask
from reflectsep.jobs import previews, run_fit
from reflectsep.progress import Progress, silent
from reflectsep.room import empty, room_beside
from reflectsep.separation import MAPS, Separation, load
from reflectsep.solve.sharing import workers
from reflectsep.summary import summary

Cut = Literal["feathered", "hard"]
LEAST_SHARE = 0.02
"""Of the object that gives the globals."""
LEAST_OVERLAP_PX = 8
"""Windows of neighbours and filled holes reach about as far."""
LEAST_SAY = 1e-6
GLOBALS = ("a", "n_s", "n_d", "f", "softness", "fresnel", "materials")


@dataclass(frozen=True, kw_only=True)
class Tiling:
    """How a capture is cut."""

    columns: int
    rows: int
    overlap_px: int = 24
    """Pixels that two neighbours have in common."""
    cut: Cut = "feathered"

    def __post_init__(self) -> None:
        for name, least in (("columns", 1), ("rows", 1), ("overlap_px", LEAST_OVERLAP_PX)):
            if getattr(self, name) < least:
                raise SettingsError(f"{name}={getattr(self, name)}: must be at least {least}")

    def regions(self, size: tuple[int, int]) -> list[Region]:
        """Windows that cover pictures of `size` (width, height), row by row.

        Raises:
            SettingsError: tiles that would be smaller than twice their overlap.
        """
        across, down = (
            spans(length, count, self.overlap_px) for length, count in zip(size, (self.columns, self.rows), strict=True)
        )
        return [Region(x=x, y=y, width=width, height=height) for y, height in down for x, width in across]


def spans(length: int, count: int, overlap: int) -> list[tuple[int, int]]:
    """Start and length of `count` pieces of 0 .. length - 1, each with `overlap` in common with the next.

    Raises:
        SettingsError: pieces that would be smaller than twice the overlap.
    """
    cuts = [round(i * length / count) for i in range(count + 1)]
    before, after = overlap // 2, overlap - overlap // 2
    found = []
    for i in range(count):
        start = cuts[i] - (before if i > 0 else 0)
        end = cuts[i + 1] + (after if i < count - 1 else 0)
        if count > 1 and end - start < 2 * overlap:
            raise SettingsError(
                f"{count} tiles of {length} pixels with overlap_px={overlap}: a tile of {end - start} pixels; expected "
                f"{2 * overlap} at least"
            )
        found.append((start, end - start))
    return found


def say(region: Region, size: tuple[int, int], overlap: int) -> Float[Tensor, "height width"]:
    """Weight of a tile at its pixels: 1 inside, falling over the overlap, but not where the picture itself ends.

    It falls over the middle half of the overlap: a tile's last pixels miss their neighbours, and have a say only where
    no other tile has the object.
    """
    margin = overlap // 4

    def ramp(place: Tensor) -> Tensor:
        return ((place - margin) / (overlap - 2 * margin)).clamp(LEAST_SAY, 1.0)

    ramps = []
    for start, length, whole in ((region.y, region.height, size[1]), (region.x, region.width, size[0])):
        place = torch.arange(length, dtype=torch.float32) + 0.5
        low = ramp(place) if start > 0 else torch.ones(length)
        high = ramp(length - place) if start + length < whole else torch.ones(length)
        ramps.append(torch.minimum(low, high))
    return ramps[0][:, None] * ramps[1]


def shares(
    regions: Sequence[Region], masks: Sequence[Bool[Tensor, "h w"]], size: tuple[int, int], tiling: Tiling
) -> list[Float[Tensor, "h w"]]:
    """Share of every tile at its pixels; they add up to 1 wherever one of the tiles has the object."""
    width, height = size
    weights = [say(region, size, tiling.overlap_px) * mask for region, mask in zip(regions, masks, strict=True)]
    total, most = torch.zeros(height, width), torch.zeros(height, width)
    owner = torch.full((height, width), -1)
    for i, (region, weight) in enumerate(zip(regions, weights, strict=True)):
        place = (region.rows, region.columns)
        total[place] += weight
        wins = weight > most[place]
        owner[place] = torch.where(wins, i, owner[place])
        most[place] = torch.where(wins, weight, most[place])
    if tiling.cut == "hard":
        return [(owner[region.rows, region.columns] == i).float() for i, region in enumerate(regions)]
    return [
        weight / total[region.rows, region.columns].clamp_min(1e-12)
        for region, weight in zip(regions, weights, strict=True)
    ]


def mixed(parts: Sequence[Tensor], regions: Sequence[Region], share: Sequence[Tensor], size: tuple[int, int]) -> Tensor:
    """Maps (..., h, w) of the tiles as one map (..., height, width)."""
    whole = empty(*parts[0].shape[:-2], size[1], size[0], dtype=parts[0].dtype).zero_()
    for part, region, weight in zip(parts, regions, share, strict=True):
        # Where a tile has no say its values need not even be finite.
        whole[..., region.rows, region.columns] += torch.where(weight > 0, part * weight, 0.0)
    return whole


def chosen(parts: Sequence[Tensor], regions: Sequence[Region], share: Sequence[Tensor], fill: Tensor) -> Tensor:
    """Maps of whole numbers as one: of every pixel those of the tile with the largest share; `fill` elsewhere."""
    whole, most = fill.clone(), torch.zeros(fill.shape)
    for part, region, weight in zip(parts, regions, share, strict=True):
        place = (region.rows, region.columns)
        wins = weight > most[place]
        whole[place] = torch.where(wins, part, whole[place])
        most[place] = torch.where(wins, weight, most[place])
    return whole


def join(names: Sequence[str], parts: Sequence[Separation], size: tuple[int, int], tiling: Tiling) -> Separation:
    """Tiles as one result.

    Args:
        names: of the tiles, for errors.
        parts: in the order of `tiling.regions(size)`, fitted under the same globals.
        size: (width, height) of the whole.
        tiling: how it was cut.

    Raises:
        ResultError: a tile of another region, of other lights or under other globals than the first.
    """
    regions = tiling.regions(size)
    for name, part, region in zip(names, parts, regions, strict=True):
        _require(name, part, region, names[0], parts[0])
    share = shares(regions, [part.mask for part in parts], size, tiling)
    maps: dict[str, Tensor] = {}
    for name in MAPS:
        own = [getattr(part, name) for part in parts]
        if name not in ("mask", "flags", "material"):
            maps[name] = mixed(own, regions, share, size)
    maps["mask"] = torch.zeros(size[1], size[0], dtype=torch.bool)
    outside = torch.zeros(size[1], size[0], dtype=parts[0].flags.dtype)
    for part, region in zip(parts, regions, strict=True):
        place = (region.rows, region.columns)
        maps["mask"][place] |= part.mask
        outside[place] = torch.where(part.mask, outside[place], part.flags)
    nothing = torch.zeros(size[1], size[0], dtype=parts[0].material.dtype)
    maps["material"] = chosen([part.material for part in parts], regions, share, nothing)
    maps["flags"] = chosen([part.flags for part in parts], regions, share, outside)
    ceilings = torch.stack([part.ceilings for part in parts]).nan_to_num(posinf=0.0).amax(0)
    joined = replace(parts[0], **maps, ceilings=torch.where(ceilings > 0, ceilings, torch.inf))
    return replace(joined, document=_document(joined, parts, regions, tiling))


def _require(name: str, part: Separation, region: Region, first: str, like: Separation) -> None:
    found = part.document.get("region")
    if found != region.plain():
        raise ResultError(f"{name}: of region {found}, expected {region.plain()}")
    if part.names != like.names or not torch.equal(part.alpha, like.alpha):
        raise ResultError(f"{name}: of other lights than {first}; expected the same")
    for key in GLOBALS:
        theirs, own = getattr(like, key), getattr(part, key)
        if not torch.equal(theirs, own):
            raise ResultError(
                f"{name}: {key} is {own.tolist()}, but {theirs.tolist()} in {first}; tiles are put together that were "
                "fitted with the globals of one result held (fit.globals_from)"
            )


def _document(
    joined: Separation, parts: Sequence[Separation], regions: Sequence[Region], tiling: Tiling
) -> dict[str, Any]:
    """What the joined result says: what all tiles say, and the figures of the whole."""
    document = {key: value for key, value in parts[0].document.items() if key != "region"}
    documents = [part.document for part in parts]
    inside = [float(r[:, joined.mask].double().square().mean()) for r in joined.residual]
    document |= {
        "tiles": [
            {"region": region.plain(), "created": own.get("created"), "residual_rms": own["residual"]["rms"]}
            for region, own in zip(regions, documents, strict=True)
        ],
        "tiling": {"overlap_px": tiling.overlap_px, "cut": tiling.cut},
        "cost": sum(own["cost"] for own in documents),
        "iterations": max(own["iterations"] for own in documents),
        "residual": {
            "rms": math.sqrt(sum(inside) / len(inside)),
            "rms_by_light": {n: math.sqrt(square) for n, square in zip(joined.names, inside, strict=True)},
            "largest": float(joined.residual.abs().amax()),
        },
        "timings_s": added([own.get("timings_s", {}) for own in documents]),
        "warnings": list(dict.fromkeys(text for own in documents for text in own.get("warnings", []))),
    }
    return document


def added(timings: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Seconds of all tiles by stage."""
    stages = dict.fromkeys(stage for each in timings for stage in each)
    return {stage: round(sum(each.get(stage, 0.0) for each in timings), 3) for stage in stages}


@dataclass(frozen=True, kw_only=True)
class TilesJob:
    """A capture that is fitted in tiles."""

    fit: FitJob
    """As for the whole; `out` is the joined result, beside which the tiles' stand in OUT.tiles."""
    tiling: Tiling
    only: int | None = None
    """Fit this tile alone, counted from 1, and put nothing together."""


def run_tiles(job: TilesJob, progress: Progress = silent) -> str:
    """Fit a capture in tiles, and put them together; tiles that are there already are taken as they are.

    Globals come from `fit.globals_from`, or from a first fit of as much as a tile's share of the object, strewn over
    all of it.

    Raises:
        SettingsError: no tile of that number, or tiles that cannot be.
        ResultError: tiles that do not belong together.
    """
    whole, basis = job.fit, job.fit.basis
    refuse_folder(whole.out, whole.overwrite)
    capture = load_capture(whole.capture, basis=basis, lights_file=whole.lights_file)
    size = picture_size(capture)
    regions = job.tiling.regions(size)
    if job.only is not None and not 1 <= job.only <= len(regions):
        raise SettingsError(f"only={job.only}: expected a tile from 1 to {len(regions)}")
    beside = Path(f"{whole.out}.tiles")
    said, settings = [], whole.fit
    if settings.globals_from is None:
        share = replace(settings, share=max(1.0 / len(regions), LEAST_SHARE))
        first = replace(whole, fit=share, out=str(beside / "first"))
        said += _fitted(replace(first, overwrite=whole.overwrite and job.only is None), progress)
        settings = replace(settings, globals_from=str(beside / "first"), globals="held")
    names = []
    on_object = read_mask(capture)
    for i, region in enumerate(regions, start=1):
        if not bool(region.of(on_object).any()):
            raise SettingsError(f"tile {i}, {region}: nothing of the object is in it; cut the capture otherwise")
        names.append(str(beside / f"tile_{i}"))
        if job.only in (None, i):
            said += _fitted(
                replace(whole, region=region.plain(), out=names[-1], fit=settings, baseline=False), progress
            )
    if job.only is None and workers().first:
        with room_beside(whole.out):
            joined = join(names, [load(name) for name in names], size, job.tiling)
            joined.save(whole.out, overwrite=whole.overwrite, previews=previews(joined))
        said.append(f"{whole.out}: {len(names)} tiles put together; {summary(joined)}")
    return "\n".join(said)


def _fitted(job: FitJob, progress: Progress) -> list[str]:
    """Fit a part, unless that has been done with the same globals."""
    if Path(job.out).is_dir() and not job.overwrite:
        _require_same(job)
        return [f"{job.out}: there already"]
    return [run_fit(replace(job, report=False), progress)]


def _require_same(job: FitJob) -> None:
    """Refuse a part that stands there but is of another window, or of another fit's globals."""
    there = load(job.out).document
    if there.get("region") != job.region:
        raise ResultError(
            f"{job.out}: of region {there.get('region')}, expected {job.region}; overwrite=true fits it anew"
        )
    handed = read_handed(FitSettings(globals_from=job.fit.globals_from))
    expected = None if handed is None else handed.created
    found = there.get("globals_from", {}).get("created")
    if found != expected:
        raise ResultError(
            f"{job.out}: its globals are those of a fit of {found}, expected {expected}; overwrite=true fits it anew"
        )
