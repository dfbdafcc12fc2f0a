"""Capture folders: loading (ours, and plain folders of pictures), writing the manifest, checking the files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from reflectsep.data import Capture, Light, Region, Sweep
from reflectsep.errors import CaptureError
from reflectsep.io import manifest
from reflectsep.io.files import inside, read_json, sha256, write_json
from reflectsep.io.lights import read_lights
from reflectsep.io.plain import load_plain

MANIFEST = "capture.json"


def load_capture(
    path: Path | str,
    *,
    basis: Sequence[str] | None = None,
    lights_file: Path | str | None = None,
    region: Sequence[int] | None = None,
) -> Capture:
    """Load a capture: its manifest is checked and every file it names is there; no picture is read.

    Args:
        path: a folder with `capture.json` (or that file), or a plain folder of pictures with a `.lp`, a UW
            `lights.txt`, or DiLiGenT's files.
        basis: names of the three basis lights, in place of the manifest's or of those found best conditioned.
        lights_file: list of lights: in a plain folder instead of the one found there; with a manifest its directions
            and intensities replace the manifest's, for the lights that it names.
        region: x, y, width and height in pixels, from the top left: the only part of every picture and frame that is
            kept when they are read; None: all of it.

    Raises:
        CaptureError: no capture there, a manifest that is not as the format says, or a missing file.
        LightError: a basis that cannot be one.
    """
    path = Path(path)
    if path.name == MANIFEST and path.is_file():
        path = path.parent
    if not path.is_dir():
        raise CaptureError(f"{path}: {'a file, a folder was expected' if path.exists() else 'no such folder'}")
    if not (path / MANIFEST).is_file():
        return with_region(load_plain(path, basis=basis, lights_file=lights_file), region)
    document = read_json(path / MANIFEST)
    if basis is not None and isinstance(document, dict):
        document = {**document, "basis": [str(name) for name in basis]}
    capture = manifest.parse(document, path / MANIFEST)
    if lights_file is not None:
        capture = _with_lights(capture, lights_file)
    for file, place, _ in files(capture):
        if not inside(path, file).is_file():
            raise CaptureError(f"{path / file}: no such file, but {MANIFEST} names it ({place})")
    return with_region(capture, region)


def with_region(capture: Capture, region: Sequence[int] | None) -> Capture:
    """The capture of which only a part is kept.

    Raises:
        CaptureError: a region that has no pixels, or is not inside the pictures, where their size is known.
    """
    if region is None:
        return replace(capture, region=None)
    x, y, width, height = (int(value) for value in region)
    part = Region(x=x, y=y, width=width, height=height)
    size = capture.size or (x + width, y + height)  # else it is seen when the first picture is read
    if not part.inside(size):
        raise CaptureError(
            f"{capture.folder}: region={part} (x, y, width, height) is not inside its pictures of {size[0]}x{size[1]}"
        )
    return replace(capture, region=part)


def files(capture: Capture) -> Iterator[tuple[str, str, str | None]]:
    """Every file of a capture: its name, where the manifest names it, and its recorded checksum, if any.

    A file that is named twice comes twice; lost frames do not come.
    """
    for index, picture in enumerate(capture.images):
        yield picture.file, f"images[{index}]", picture.sha256
    for index, sweep in enumerate(one for listed in capture.sweeps for one in listed.exposures):
        place = f"sweeps[{index}]"
        if sweep.video is not None:
            yield sweep.video, place, sweep.sha256[0] if sweep.sha256 else None
        else:
            for frame in range(sweep.count):
                if frame not in sweep.lost:
                    recorded = sweep.sha256[frame] if sweep.sha256 else None
                    yield manifest.frame_file(sweep, frame), f"{place}, frame {frame}", recorded
        if sweep.dark is not None:
            yield sweep.dark, f"{place}, dark", checksum(capture, sweep.dark)
    if capture.mask is not None:
        yield capture.mask, "mask", checksum(capture, capture.mask)
    if capture.encoding.response is not None:
        yield capture.encoding.response, "encoding", checksum(capture, capture.encoding.response)


def checksum(capture: Capture, file: str) -> str | None:
    """Recorded checksum of a picture, mask or response, by its name; None where there is none."""
    of_pictures = {picture.file: picture.sha256 for picture in capture.images}
    return of_pictures.get(file) or capture.checksums.get(file)


def verify(capture: Capture) -> list[str]:
    """Read every file that has a recorded checksum; one line for each that is missing or not what was recorded."""
    problems: list[str] = []
    seen: set[tuple[str, str | None]] = set()
    for file, _, recorded in files(capture):
        if (file, recorded) in seen:
            continue
        seen.add((file, recorded))
        path = inside(capture.folder, file)
        if not path.is_file():
            problems.append(f"{path}: no such file")
        elif recorded is not None and (found := sha256(path)) != recorded:
            problems.append(f"{path}: its SHA-256 is {found[:12]}..., but {recorded[:12]}... was recorded")
    return problems


def write_manifest(folder: Path | str, capture: Capture) -> Capture:
    """Write `capture.json`, with the checksum of every file; call it last, when all of them are there.

    Args:
        folder: the capture's folder; `capture.folder` and recorded checksums are not looked at.
        capture: what to write.

    Returns:
        The capture as it can be loaded now: with its folder and checksums.

    Raises:
        CaptureError: a file is missing, or the capture is one that could not be loaded again.
    """
    folder = Path(folder)
    capture = replace(capture, folder=folder, checksums={})
    images = tuple(replace(picture, sha256=_sum(folder, picture.file)) for picture in capture.images)
    sweeps = tuple(_with_sums(folder, sweep) for sweep in capture.sweeps)
    own = {picture.file for picture in images}
    rest = [capture.mask, capture.encoding.response, *(one.dark for sweep in sweeps for one in sweep.exposures)]
    capture = replace(
        capture,
        images=images,
        sweeps=sweeps,
        checksums={file: _sum(folder, file) for file in rest if file is not None and file not in own},
    )
    document = manifest.serialise(capture)
    written = manifest.parse(document, folder / MANIFEST)
    write_json(folder / MANIFEST, document)
    return written


def _sum(folder: Path, file: str) -> str:
    path = inside(folder, file)
    if not path.is_file():
        raise CaptureError(f"{path}: no such file, so no manifest can name it")
    return sha256(path)


def _with_sums(folder: Path, sweep: Sweep) -> Sweep:
    first, *others = (replace(one, sha256=_sweep_sums(folder, one)) for one in sweep.exposures)
    return replace(first, bracket=tuple(others))


def _sweep_sums(folder: Path, sweep: Sweep) -> tuple[str | None, ...]:
    if sweep.video is not None:
        return (_sum(folder, sweep.video),)
    return tuple(
        None if index in sweep.lost else _sum(folder, manifest.frame_file(sweep, index)) for index in range(sweep.count)
    )


def _with_lights(capture: Capture, lights_file: Path | str) -> Capture:
    """The capture with the directions and intensities of a list."""
    given = read_lights(lights_file)
    if not set(given) & set(capture.lights):
        raise CaptureError(f"{lights_file}: none of its lights is one of {', '.join(capture.lights)}")
    lights: dict[str, Light] = {name: given.get(name, light) for name, light in capture.lights.items()}
    return replace(capture, lights=lights)
