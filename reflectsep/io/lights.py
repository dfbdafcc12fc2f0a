"""Lists of light directions: `.lp`, the UW sets' `lights.txt`, DiLiGenT, AliceVision's JSON and our own.

All become unit vectors from the object to the light, x right, y up, z towards the camera. AliceVision's vectors also
point to the light, in its camera frame, whose y goes down and whose z goes into the scene: both change sign.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path, PureWindowsPath
from typing import Any

from reflectsep.data import Light, Vector
from reflectsep.errors import CaptureError, LightError
from reflectsep.io.files import atomic_write, read_json

NEAR_ZERO = 1e-6
"""Vectors shorter than this have no direction."""


def read_lights(path: Path | str) -> dict[str, Light]:
    """Lights by name, from any list that is known, in its order.

    Args:
        path: `.lp` (named by the picture's stem), `.txt` (UW: "0", "1", ...), `.json` (ours or AliceVision's, named by
            view), or a DiLiGenT folder (named by the picture's stem).

    Raises:
        CaptureError: missing, not such a list, another number of lights than it says, or a vector near zero.
    """
    path = Path(path)
    if path.is_dir():
        return {light.name: light for _, light in read_diligent(path)}
    if path.suffix.lower() == ".json":
        return _read_json_lights(path)
    if path.suffix.lower() == ".lp":
        return {light.name: light for _, light in read_lp(path)}
    if path.suffix.lower() == ".txt":
        return read_uw(path)
    raise CaptureError(f"{path}: no list of lights; .lp, .json, .txt or a DiLiGenT folder was expected")


def read_lp(path: Path | str) -> list[tuple[str, Light]]:
    """File name and light of every line of an `.lp` file.

    A light's name is the file's stem where those are unique, else the file's name. Decimal commas are accepted.

    Raises:
        CaptureError: as `read_lights`.
    """
    path = Path(path)
    lines = _counted_lines(path)
    files: list[str] = []
    vectors: list[Vector] = []
    for number, line in lines:
        tokens = line.rsplit(maxsplit=3)
        if len(tokens) != 4:
            raise CaptureError(f"{path}: line {number}: found {line!r}, expected: filename x y z")
        files.append(tokens[0])
        vectors.append(unit(_floats(path, number, tokens[1:]), f"{path}: line {number}"))
    names = _unique_names(path, files)
    return [(f, Light(name=n, direction=v)) for f, n, v in zip(files, names, vectors, strict=True)]


def read_uw(path: Path | str) -> dict[str, Light]:
    """A UW photometric set's `lights.txt`: a count (it may be absent), then one vector a line; named "0", "1", ...

    Raises:
        CaptureError: as `read_lights`.
    """
    path = Path(path)
    lights: dict[str, Light] = {}
    lines = _lines(path)
    # Lists made with other tools than the set's own leave the count out: their first line is a vector already.
    lines = lines if lines and len(lines[0][1].split()) == 3 else _counted_lines(path)
    for index, (number, line) in enumerate(lines):
        direction = unit(_floats(path, number, line.split()), f"{path}: line {number}")
        lights[str(index)] = Light(name=str(index), direction=direction)
    return lights


def read_diligent(folder: Path | str) -> list[tuple[str, Light]]:
    """File name and light of every picture of a DiLiGenT folder; intensities are per channel (R, G, B).

    Raises:
        CaptureError: a file is missing, or they differ in length, or hold something else than numbers.
    """
    folder = Path(folder)
    files = [line for _, line in _lines(folder / "filenames.txt")]
    tables: dict[str, list[Vector]] = {}
    for name in ("light_directions.txt", "light_intensities.txt"):
        tables[name] = [_floats(folder / name, number, line.split()) for number, line in _lines(folder / name)]
        if len(tables[name]) != len(files):
            raise CaptureError(f"{folder / name}: {len(tables[name])} lines, but filenames.txt has {len(files)}")
    names = _unique_names(folder / "filenames.txt", files)
    result: list[tuple[str, Light]] = []
    for row, (file, name) in enumerate(zip(files, names, strict=True)):
        direction = unit(tables["light_directions.txt"][row], f"{folder / 'light_directions.txt'}: light {name}")
        strength = _intensity(tables["light_intensities.txt"][row], f"{folder / 'light_intensities.txt'}: light {name}")
        result.append((file, Light(name=name, direction=direction, intensity=strength)))
    return result


def write_lp(path: Path | str, lights: Mapping[str, Light], files: Mapping[str, str] | None = None) -> None:
    """Write an `.lp` file, atomically. It has directions alone: intensities are not in it.

    Args:
        path: file to write.
        lights: lights by name.
        files: file name of each light's picture; `NAME.exr` by default.

    Raises:
        LightError: a light has no direction.
        ValueError: a file name that an `.lp` line cannot hold.
    """
    lines = [str(len(lights))]
    for name, light in lights.items():
        if light.direction is None:
            raise LightError(f"{path}: light {name} has no direction; an .lp file needs one of every light")
        file = (files or {}).get(name, f"{name}.exr")
        if file != file.strip() or len(file.splitlines()) != 1:
            raise ValueError(f"{path}: {file!r} cannot be a file name in an .lp file")
        lines.append(" ".join([file, *(repr(float(value)) for value in light.direction)]))
    text = "\n".join(lines) + "\n"
    atomic_write(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def unit(vector: Sequence[float], where: str) -> Vector:
    """`vector` (three numbers) at length 1.

    Raises:
        CaptureError: it is near zero or not finite; `where` begins the message.
    """
    x, y, z = vector
    length = math.sqrt(x * x + y * y + z * z)
    if not math.isfinite(length) or length < NEAR_ZERO:
        raise CaptureError(
            f"{where}: ({x:g}, {y:g}, {z:g}) has no direction; a vector longer than {NEAR_ZERO:g} was expected"
        )
    if abs(length - 1) < 1e-12:
        return (x, y, z)  # so that what was written at length 1 comes back digit for digit
    return (x / length, y / length, z / length)


def _read_json_lights(path: Path) -> dict[str, Light]:
    document = read_json(path)
    entries = document.get("lights") if isinstance(document, dict) else None
    if isinstance(entries, dict):
        return {name: _own_light(path, name, entry) for name, entry in entries.items()}
    if isinstance(entries, list):
        return _alicevision(path, entries)
    raise CaptureError(f'{path}: no lights in it; {{"lights": {{"NAME": {{"direction": [x, y, z]}}}}}} was expected')


def _own_light(path: Path, name: str, entry: Any) -> Light:
    where = f"{path}: light {name}"
    if not isinstance(entry, dict) or "direction" not in entry or not set(entry) <= {"direction", "intensity"}:
        raise CaptureError(f"{where}: found {entry!r:.80}, expected direction and, if wanted, intensity")
    direction = unit(_json_numbers(entry["direction"], f"{where}: direction", (3,), text=False), f"{where}: direction")
    given = entry.get("intensity", 1.0)
    given = given if isinstance(given, list) else [given]
    strength = _json_numbers(given, f"{where}: intensity", (1, 3), text=False)
    return Light(name=name, direction=direction, intensity=_intensity(strength, where))


def _alicevision(path: Path, entries: list[Any]) -> dict[str, Light]:
    lights: dict[str, Light] = {}
    for index, entry in enumerate(entries):
        where = f"{path}: lights[{index}]"
        if not isinstance(entry, dict) or not {"direction", "intensity"} <= set(entry):
            raise CaptureError(f"{where}: found {entry!r:.80}, expected viewId, type, direction and intensity")
        if entry.get("type", "directional") != "directional":
            raise CaptureError(f"{where}: its type is {entry['type']!r}, only directional lights can be used")
        name = str(entry.get("viewId", entry.get("lightId", index)))
        if name in lights:
            raise CaptureError(f"{where}: view {name} appears twice")
        x, y, z = _json_numbers(entry["direction"], f"{where}: direction", (3,), text=True)
        direction = unit((x, -y, -z), f"{where}: direction")
        strength = _intensity(_json_numbers(entry["intensity"], f"{where}: intensity", (1, 3), text=True), where)
        lights[name] = Light(name=name, direction=direction, intensity=strength)
    return lights


def _json_numbers(value: Any, where: str, lengths: tuple[int, ...], *, text: bool) -> tuple[float, ...]:
    """A JSON list of numbers; with `text` also of numbers in quotes, as AliceVision's writer makes them."""
    kinds = (int, float, str) if text else (int, float)
    expected = f"{' or '.join(map(str, lengths))} numbers"
    if not isinstance(value, list) or len(value) not in lengths:
        raise CaptureError(f"{where}: found {value!r:.80}, expected {expected}")
    try:
        if any(isinstance(item, bool) or not isinstance(item, kinds) for item in value):
            raise ValueError
        return tuple(float(item) for item in value)
    except (ValueError, OverflowError):
        raise CaptureError(f"{where}: found {value!r:.80}, expected {expected}") from None


def _intensity(values: Sequence[float], where: str) -> tuple[float, ...]:
    if not all(math.isfinite(value) and value > 0 for value in values):
        found, expected = list(values), "three positive numbers"
        if len(values) == 1:
            found, expected = values[0], "a positive number"
        raise CaptureError(f"{where}: intensity: found {found}, expected {expected}")
    return tuple(values)


def _lines(path: Path) -> list[tuple[int, str]]:
    """Lines that are not blank, with their numbers."""
    try:
        text = path.read_text(encoding="utf-8-sig", errors="surrogateescape")
    except FileNotFoundError:
        raise CaptureError(f"{path}: no such file") from None
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read: {error.strerror or error}") from error
    return [(number, line.strip()) for number, line in enumerate(text.split("\n"), start=1) if line.strip()]


def _counted_lines(path: Path) -> list[tuple[int, str]]:
    """The lines after a first one that says how many they are."""
    lines = _lines(path)
    if not lines or not lines[0][1].isdecimal():
        found = lines[0][1] if lines else "nothing"
        raise CaptureError(f"{path}: begins with {found!r:.60}, expected the number of lights")
    count = int(lines[0][1])
    if count != len(lines) - 1 or count == 0:
        raise CaptureError(f"{path}: {len(lines) - 1} lights, but its first line says {count}")
    return lines[1:]


def _floats(path: Path, number: int, tokens: Sequence[str]) -> Vector:
    try:
        x, y, z = (float(token.replace(",", ".")) for token in tokens)
    except ValueError:
        raise CaptureError(f"{path}: line {number}: found {' '.join(tokens)!r:.80}, expected three numbers") from None
    return (x, y, z)


def _unique_names(path: Path, files: Sequence[str]) -> list[str]:
    """Stems of `files`, or their whole names where stems repeat; both slashes part folders, as lists travel."""
    for names in (
        [PureWindowsPath(file).stem for file in files],
        [PureWindowsPath(f).name for f in files],
        list(files),
    ):
        if len(set(names)) == len(names):
            return names
    repeated = next(file for file, times in Counter(files).items() if times > 1)
    raise CaptureError(f"{path}: {repeated!r} appears twice; every light needs a picture of its own")
