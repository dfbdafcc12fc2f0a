"""A capture folder of a small bumpy object under seven lights, stored as a test wants it."""

import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
import torch

from reflectsep.calibrate.motion import Motion
from reflectsep.data import Capture, Encoding, Light, Picture, Sweep
from reflectsep.io.capture import load_capture, write_manifest
from reflectsep.io.pictures import write_picture
from reflectsep.synth.presets import make_object
from reflectsep.synth.rig import SimulatedCamera, make_rig
from reflectsep.synth.simulate import simulate

SIZE = 40
ANGLES = {
    "L1": (28, 90),
    "L2": (27, 210),
    "L3": (30, 330),
    "L4": (8, 20),
    "L5": (20, 270),
    "L6": (15, 150),
    "L7": (12, 0),
}


def direction(off_view_deg, azimuth_deg):
    off, azimuth = math.radians(off_view_deg), math.radians(azimuth_deg)
    return (math.sin(off) * math.cos(azimuth), math.sin(off) * math.sin(azimuth), math.cos(off))


def radiance(vector, channels=1):
    """A dome with a pedestal: lit everywhere by every light."""
    y, x = torch.meshgrid(torch.linspace(0.7, -0.7, SIZE), torch.linspace(-0.7, 0.7, SIZE), indexing="ij")
    normal = torch.stack([x + 0.1 * torch.sin(9 * x), y, torch.full_like(x, 1.2)])
    shading = torch.einsum("chw,c->hw", normal / normal.norm(dim=0), torch.tensor(vector))
    return (0.5 * shading.clamp_min(0))[None].repeat(channels, 1, 1)


def simulated(folder, name="pudding", drift=None, size=64, **camera):
    """A capture with its truth."""
    rig = make_rig(
        "r",
        heldout=(0, 0),
        sweeps=(3, 0),
        slab_px=(8.0, 4.0),
        camera=SimulatedCamera(full_sigma=0.005, frame_sigma=0.002, **camera),
        drift=drift,
    )
    simulate(make_object(name, size=size), rig, folder, seed=3)
    return load_capture(folder)


def truth(capture, name):
    document = json.loads((capture.folder / "truth" / "drift.json").read_text())[name]
    matrix = torch.tensor(document["matrix"], dtype=torch.float64)
    return Motion(matrix=matrix, velocity=tuple(document["velocity_px"]))


@dataclass
class Folder:
    """Writes pictures as stored values, and the manifest last."""

    path: Path
    channels: int = 1
    lights: dict[str, Light] = field(default_factory=dict)
    images: list[Picture] = field(default_factory=list)
    sweeps: list[Sweep] = field(default_factory=list)
    encoding: Encoding = field(default_factory=Encoding)
    mask: str | None = None

    def picture(self, light, stored, exposure_s=None):
        file = f"full/{light}.exr"
        write_picture(self.path / file, stored)
        self.images.append(Picture(kind="full", file=file, light=light, exposure_s=exposure_s))

    def dark(self, stored, exposure_s=None, file="dark.exr"):
        write_picture(self.path / file, stored)
        self.images.append(Picture(kind="dark", file=file, exposure_s=exposure_s))

    def standard(self, **light):
        """Seven linear pictures, each light known."""
        for name, angles in ANGLES.items():
            self.lights[name] = Light(name=name, direction=direction(*angles), **light)
            self.picture(name, radiance(direction(*angles), self.channels))
        return self

    def edit(self, light, change):
        """Rewrite a light's picture."""
        stored = radiance(direction(*ANGLES[light]), self.channels)
        write_picture(self.path / f"full/{light}.exr", change(stored))

    def load(self) -> Capture:
        capture = Capture(
            folder=self.path,
            lights=self.lights,
            basis=("L1", "L2", "L3"),
            images=tuple(self.images),
            sweeps=tuple(self.sweeps),
            encoding=self.encoding,
            size=(SIZE, SIZE),
            mask=self.mask,
        )
        write_manifest(self.path, capture)
        return load_capture(self.path)

    def forget(self, *names):
        """Lights whose direction is not known."""
        for name in names:
            self.lights[name] = replace(self.lights[name], direction=None)
        return self


@pytest.fixture
def folder(tmp_path):
    return Folder(tmp_path)
