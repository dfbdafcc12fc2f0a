"""A tiny capture folder, made by hand: the format's own words, none of the code under test but the picture writer."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch

from reflectsep.io.pictures import write_picture

DIRECTIONS = {"L1": [0, 0.6, 0.8], "L2": [0.6, 0, 0.8], "L3": [-0.6, -0.6, 0.8], "L4": [0, 0, 2]}


@dataclass(frozen=True)
class Tiny:
    folder: Path
    channels: int = 1
    width: int = 5
    height: int = 4
    frames: int = 3

    def picture(self, value: float) -> torch.Tensor:
        """No two pixels alike."""
        shape = (self.channels, self.height, self.width)
        return value + torch.arange(self.channels * self.height * self.width).reshape(shape) / 1024

    def document(self) -> dict[str, Any]:
        return json.loads((self.folder / "capture.json").read_text(encoding="utf-8"))

    def rewrite(self, document: object) -> None:
        (self.folder / "capture.json").write_text(json.dumps(document), encoding="utf-8")

    def change(self, edit: Callable[[dict[str, Any]], object]) -> None:
        document = self.document()
        edit(document)
        self.rewrite(document)


def make(folder: Path, channels: int = 1) -> Tiny:
    tiny = Tiny(folder, channels)
    for number, name in enumerate(DIRECTIONS):
        write_picture(folder / "full" / f"{name}.exr", tiny.picture(number + 1.0))
    write_picture(folder / "dark.exr", tiny.picture(0.25))
    mask = torch.zeros(1, tiny.height, tiny.width)
    mask[:, 1:] = 1
    write_picture(folder / "mask.png", mask)
    for index in range(tiny.frames):
        write_picture(folder / "sweep" / "L1" / f"{index:04d}.exr", tiny.picture(index / 8))
    tiny.rewrite(
        {
            "format": "reflectsep-capture/1",
            "object": "wax",
            "size": [tiny.width, tiny.height],
            "mask": "mask.png",
            "lights": {name: {"direction": vector, "intensity": 1.0} for name, vector in DIRECTIONS.items()},
            "basis": ["L3", "L1", "L2"],
            "images": [
                *(
                    {"kind": "full", "light": name, "file": f"full/{name}.exr", "exposure_s": 0.01}
                    for name in reversed(DIRECTIONS)
                ),
                {"kind": "dark", "file": "dark.exr", "exposure_s": 0.01},
            ],
            "sweeps": [
                {"light": "L1", "exposure_s": 0.16, "frames": "sweep/L1/{:04d}.exr", "count": 3, "time_s": [0, 1, 2]}
            ],
        }
    )
    return tiny


@pytest.fixture
def tiny(tmp_path: Path) -> Tiny:
    return make(tmp_path / "wax")


@pytest.fixture
def colour(tmp_path: Path) -> Tiny:
    return make(tmp_path / "wax", 3)
