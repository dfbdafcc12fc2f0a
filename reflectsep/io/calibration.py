"""`calibration.json`: what a bench's calibration found, beside a capture and of use to others from the same bench."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from reflectsep.data import Capture, Encoding, Light
from reflectsep.errors import CaptureError
from reflectsep.io import node as read
from reflectsep.io.files import read_json, write_json
from reflectsep.io.node import Node

FORMAT = "reflectsep-calibration/1"
FILE = "calibration.json"


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Lights and response of a bench."""

    lights: Mapping[str, Light] = field(default_factory=dict)
    response: tuple[tuple[float, float], ...] | None = None
    """(value, radiance) rows, both rising."""
    notes: Mapping[str, Any] = field(default_factory=dict)
    """How it came about: sources, disagreements."""


def write_calibration(path: Path | str, calibration: Calibration) -> None:
    """Write the file, atomically."""
    lights = {}
    for name, light in calibration.lights.items():
        lights[name] = {
            "direction": None if light.direction is None else list(light.direction),
            "intensity": list(light.intensity),
        }
    document: dict[str, Any] = {"format": FORMAT, "lights": lights, "notes": dict(calibration.notes)}
    if calibration.response is not None:
        document["response"] = [list(row) for row in calibration.response]
    write_json(path, document)


def read_calibration(path: Path | str) -> Calibration:
    """Read it back.

    Raises:
        CaptureError: missing, of another format, or with anything in it that it may not have.
    """
    path = Path(path)
    if not path.is_file():
        raise CaptureError(f"{path}: no such file; reflectsep calibrate writes one")
    document = read_json(path)
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        found = document.get("format") if isinstance(document, dict) else type(document).__name__
        raise CaptureError(f"{path}: format is {found!r}, expected {FORMAT!r}")
    root = Node(path, "calibration", document).object(("format", "lights", "response", "notes"), ("format", "lights"))
    lights: dict[str, Light] = {}
    if not isinstance(root.child("lights").value, dict):
        raise root.child("lights").fail("an object with an entry for every light")
    for name in root.child("lights").value:
        entry = root.child("lights").child(name).object(("direction", "intensity"), ())
        direction = entry.optional("direction", read.nullable(read.direction), None)
        strengths = entry.optional("intensity", lambda n: tuple(read.positive(item) for item in n.items()), (1.0,))
        lights[name] = Light(name=name, direction=direction, intensity=strengths)
    notes = document.get("notes", {})
    return Calibration(
        lights=lights,
        response=root.optional("response", _response, None),
        notes=notes if isinstance(notes, dict) else {},
    )


def _response(node: Node) -> tuple[tuple[float, float], ...]:
    rows = []
    for item in node.items():
        cells = [read.number(cell) for cell in item.items()]
        if len(cells) != 2:
            raise item.fail("[value, radiance]")
        if rows and not (cells[0] > rows[-1][0] and cells[1] > rows[-1][1]):
            raise item.fail("a row above the one before it, in both columns")
        rows.append((cells[0], cells[1]))
    if len(rows) < 2:
        raise node.fail("two rows or more")
    return tuple(rows)


def calibrated(capture: Capture, calibration: Calibration) -> Capture:
    """The capture with the calibration's lights, for those that it names, and its response."""
    lights = {name: _merged(light, calibration.lights.get(name)) for name, light in capture.lights.items()}
    encoding = capture.encoding
    if calibration.response is not None:
        encoding = Encoding(kind="response", table=calibration.response)
    return replace(capture, lights=lights, encoding=encoding)


def _merged(light: Light, found: Light | None) -> Light:
    if found is None:
        return light
    return replace(found, direction=found.direction or light.direction)
