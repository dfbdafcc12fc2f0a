"""Folders of pictures with a list of lights beside them, read as captures without conversion."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np

from reflectsep.data import Capture, Light, Picture
from reflectsep.errors import CaptureError, LightError
from reflectsep.io.files import inside
from reflectsep.io.lights import read_diligent, read_lights, read_lp, read_uw
from reflectsep.io.pictures import SUFFIXES, read_picture

_COPLANAR = 1e4
"""Condition number from which three light directions count as coplanar: 0.01 degrees off a plane."""


def load_plain(folder: Path, *, basis: Sequence[str] | None = None, lights_file: Path | str | None = None) -> Capture:
    """A capture from a folder of linear pictures with a list of lights, without sweeps.

    Args:
        folder: holds the pictures and, unless `lights_file` says otherwise, one `.lp`, a UW `lights.txt` (here or in
            the folder above), or DiLiGenT's files.
        basis: three lights by name; by default the three whose directions have the smallest condition number.
        lights_file: list of lights to use, any that `read_lights` knows.

    Raises:
        CaptureError: no list, several, or one that does not fit the pictures.
        LightError: a basis of unknown or repeated lights; by default, that all lights lie in one plane.
    """
    source = Path(lights_file) if lights_file is not None else _find_list(folder)
    mask = None
    if source.is_dir():
        lights, files = _of_entries(folder, read_diligent(source))
    elif source.suffix.lower() == ".lp":
        lights, files = _of_entries(folder, read_lp(source))
    elif source.suffix.lower() == ".txt":
        lights = read_uw(source)
        files, mask = _numbered_pictures(folder, len(lights), source)
    else:
        lights = read_lights(source)
        files = {name: _file_of_stem(folder, name) for name in lights}
    chosen = best_basis(lights) if basis is None else _named_basis(lights, basis)
    values, _ = read_picture(inside(folder, files[chosen[0]]))
    return Capture(
        folder=folder,
        object=folder.resolve().name or "object",
        size=(values.shape[2], values.shape[1]),
        mask=mask or _mask(folder),
        lights=lights,
        basis=chosen,
        images=tuple(Picture(kind="full", light=name, file=files[name]) for name in lights),
    )


def pictures_by_light(folder: Path, names: Sequence[str]) -> tuple[dict[str, str], str | None]:
    """Picture of every light in a folder, `NAME.png` or `anything.NAME.png`, and the mask (`mask`, `anything.mask`).

    Raises:
        CaptureError: no such folder, or a light without a picture or with several.
    """
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder")
    present = sorted(path.name for path in _pictures(folder))
    files = {}
    for name in names:
        found = [file for file in present if Path(file).stem == name or Path(file).stem.endswith(f".{name}")]
        if len(found) != 1:
            what = f"several pictures: {', '.join(found)}" if found else "no picture"
            raise CaptureError(f"{folder}: light {name}: {what}; one called {name} or ANYTHING.{name} was expected")
        files[name] = found[0]
    masks = [file for file in present if Path(file).stem.lower().split(".")[-1] == "mask"]
    return files, masks[0] if len(masks) == 1 else None


def best_basis(lights: Mapping[str, Light]) -> tuple[str, str, str]:
    """The three lights whose unit directions have the smallest condition number; of equals, the first.

    The squared singular values of three unit vectors with mutual cosines a, b, c are the eigenvalues of their Gram
    matrix, 1 + 2 sqrt(q) cos(t + 2 pi k / 3) with q = (a^2 + b^2 + c^2) / 3 and cos 3t = a b c / q^(3/2).

    Raises:
        LightError: fewer than three lights with a direction, or all in one plane.
    """
    known = [(name, light.direction) for name, light in lights.items() if light.direction is not None]
    if len(known) < 3:
        raise LightError(f"{len(known)} lights with a direction; a basis needs 3")
    directions = np.array([direction for _, direction in known], dtype=np.float64)
    cosines = directions @ directions.T
    best, chosen = np.inf, (0, 1, 2)
    for i in range(len(known) - 2):
        j, k = np.triu_indices(len(known) - i - 1, 1)
        j, k = j + i + 1, k + i + 1
        ratio = _squared_condition(cosines[i, j], cosines[i, k], cosines[j, k])
        at = int(np.argmin(ratio))
        if ratio[at] < best * (1 - 1e-9):
            best, chosen = float(ratio[at]), (i, int(j[at]), int(k[at]))
    condition = float(np.linalg.cond(directions[list(chosen)]))
    if not condition < _COPLANAR:
        raise LightError(
            f"all {len(known)} lights lie in one plane: the best basis has condition number {condition:.3g}"
        )
    return (known[chosen[0]][0], known[chosen[1]][0], known[chosen[2]][0])


def _squared_condition(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Largest over smallest eigenvalue of the Gram matrices of unit vectors with cosines a, b, c."""
    q = np.maximum((a * a + b * b + c * c) / 3, 1e-200)
    third = np.arccos(np.clip(a * b * c / q**1.5, -1, 1)) / 3
    largest = 1 + 2 * np.sqrt(q) * np.cos(third)
    smallest = 1 + 2 * np.sqrt(q) * np.cos(third + 2 * np.pi / 3)
    return largest / np.maximum(smallest, 1e-15)


def _named_basis(lights: Mapping[str, Light], basis: Sequence[str]) -> tuple[str, str, str]:
    names = [str(name) for name in basis]
    for name in names:
        if name not in lights:
            raise LightError(f"basis light {name!r} is not one of {', '.join(lights)}")
    if len(names) != 3 or len(set(names)) != 3:
        raise LightError(f"basis {', '.join(names)}: three different lights were expected")
    return (names[0], names[1], names[2])


def _find_list(folder: Path) -> Path:
    if (folder / "light_directions.txt").is_file():
        return folder
    lists = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".lp" and path.is_file())
    if len(lists) > 1:
        raise CaptureError(f"{folder}: several lists of lights ({', '.join(p.name for p in lists)}): name one of them")
    if lists:
        return lists[0]
    for place in (folder, folder.resolve().parent):
        if (place / "lights.txt").is_file():
            return place / "lights.txt"
    raise CaptureError(f"{folder}: no capture: neither capture.json nor a list of lights (.lp, lights.txt, DiLiGenT's)")


def _of_entries(folder: Path, entries: Sequence[tuple[str, Light]]) -> tuple[dict[str, Light], dict[str, str]]:
    """Lights and picture files by name, from a list that names the files."""
    lights = {light.name: light for _, light in entries}
    return lights, {light.name: _listed_file(folder, file) for file, light in entries}


def _listed_file(folder: Path, listed: str) -> str:
    """The picture that a list means: as it says; or by its name alone; or its stem with another known suffix.

    Lists are made on other machines, with their folders in front, and stay as they are when pictures are converted.
    """
    name = PureWindowsPath(listed).name
    for candidate in (listed, name):
        relative = PurePosixPath(candidate)
        if not relative.is_absolute() and (folder / relative).is_file():
            inside(folder, candidate)
            return candidate
    return _file_of_stem(folder, PureWindowsPath(name).stem, listed)


def _file_of_stem(folder: Path, stem: str, listed: str | None = None) -> str:
    found = sorted(path.name for path in _pictures(folder) if path.stem == stem)
    if len(found) != 1:
        what = f"several pictures for it: {', '.join(found)}" if found else "no such picture"
        raise CaptureError(f"{folder}: the list of lights names {listed or stem!r}; {what}")
    return found[0]


def _pictures(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file()]


def _numbered_pictures(folder: Path, count: int, source: Path) -> tuple[dict[str, str], str | None]:
    """Pictures `name.0.png` to `name.N.png` by light, and `name.mask.png`."""
    sets: dict[str, dict[int, str]] = {}
    for path in sorted(_pictures(folder)):
        if match := re.fullmatch(r"(.+)\.(\d+)", path.stem):
            numbered = sets.setdefault(match[1], {})
            if int(match[2]) in numbered:
                raise CaptureError(f"{folder}: {numbered[int(match[2])]} and {path.name} have the same number")
            numbered[int(match[2])] = path.name
    if len(sets) != 1:
        found = f"pictures of {', '.join(sorted(sets))}" if sets else "no pictures named like that"
        raise CaptureError(f"{folder}: {found}; one set NAME.0.png, NAME.1.png, ... was expected beside {source.name}")
    ((name, numbered),) = sets.items()
    if set(numbered) != set(range(count)):
        missing = sorted(set(range(count)) - set(numbered))
        extra = sorted(set(numbered) - set(range(count)))
        what = f"{name}.{missing[0]} is missing" if missing else f"{numbered[extra[0]]} has no light"
        raise CaptureError(f"{folder}: {len(numbered)} pictures, but {source} has {count} lights: {what}")
    masks = sorted(path.name for path in _pictures(folder) if path.stem == f"{name}.mask")
    return {str(index): numbered[index] for index in range(count)}, masks[0] if masks else None


def _mask(folder: Path) -> str | None:
    found = sorted(path.name for path in _pictures(folder) if path.stem.lower() == "mask")
    if len(found) > 1:
        raise CaptureError(f"{folder}: several masks: {', '.join(found)}; one was expected")
    return found[0] if found else None
