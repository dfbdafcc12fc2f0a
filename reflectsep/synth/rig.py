"""Simulated rigs: lights, slab sweeps and a camera, as plain values; and which patches a slab lights when.

A slab is a sheet of light, parallel to its light's direction L, that moves along x (or y). A point p is lit while

    u(p) = x - z L_x / L_z    (y - z L_y / L_z for a sweep along y)

lies in [start + i step, start + i step + width) in frame i: its shadow along L on the plane z = 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.data import Light, Vector
from reflectsep.errors import LightError, SettingsError
from reflectsep.synth.drift import Drift

MARGIN_FRAMES = 1
"""Frames before and after those that light anything."""

BASIS = [(30.0, 90.0), (32.0, 210.0), (35.0, 330.0)]
SIX = [*BASIS, (15.0, 20.0), (18.0, 275.0), (20.0, 150.0)]
TWELVE = [*SIX, (12.0, 95.0), (22.0, 60.0), (24.0, 240.0), (25.0, 0.0), (27.0, 120.0), (28.0, 300.0)]
GOLDEN_DEG = 180 * (3 - math.sqrt(5))
PAPER = [(25.0, 90.0), (28.0, 210.0), (30.0, 330.0), (15.0, 30.0), (17.0, 270.0), (20.0, 150.0)]
INSIDE = [(6.0, 60.0), (11.0, 185.0), (13.0, 310.0)]
OUTSIDE = [(50.0, 180.0)]


@dataclass(frozen=True, kw_only=True)
class SimulatedCamera:
    """From radiance to stored values. 1 is full scale; radiance is scaled so that the pictures' 99.9 % is `peak`.

    value = clip(peak-scaled radiance * exposure ratio + ambient + dark level + noise), then encoded, then quantised.
    """

    full_exposure_s: float = 0.01
    slab_exposure_s: float = 0.01
    peak: float = 1.0
    """Value of the 99.9 % quantile of the full pictures, before dark level; 1 is full scale."""
    dark_level: float = 0.0
    """Added to every picture whatever its exposure, e.g. the camera's black level."""
    ambient_per_s: float = 0.0
    """Stray light or dark current, in values a second; the same in every picture of one exposure."""
    full_well_e: float | None = None
    """Electrons at value 1: shot noise; None is no shot noise."""
    read_sigma: float = 0.0
    """Read noise: standard deviation as a share of full scale, the same in every picture, dark ones included."""
    full_sigma: float = 0.0
    """Gaussian noise added to full pictures, as a share of the peak."""
    frame_sigma: float = 0.0
    """Gaussian noise added to slab frames, as a share of the peak."""
    dark_frames: int = 16
    """Dark pictures averaged into the one that is stored."""
    bits: int | None = None
    """4 to 16: integer files; None: float files."""
    saturation: float | None = None
    """Largest value that the sensor gives; None is 1 for integer files and unlimited for float files."""
    gamma: float | None = None
    """Stored value = value^(1/gamma); None is linear."""
    oversample: int = 1
    """Patches along a pixel's side, whose light it adds up. A camera that moves sees an edge of light pass over its
    pixels bit by bit; with one patch a pixel such an edge is a step, which no interpolation between pixels can move."""

    def __post_init__(self) -> None:
        """Refuse a camera that cannot be."""
        _require(self.full_exposure_s > 0 and self.slab_exposure_s > 0, "exposures", "above 0 s")
        _require(self.peak > 0, f"peak {self.peak}", "above 0")
        noises = (self.dark_level, self.ambient_per_s, self.read_sigma, self.full_sigma, self.frame_sigma)
        _require(min(noises) >= 0, f"dark level, ambient and noise {noises}", "none below 0")
        _require(self.full_well_e is None or self.full_well_e > 0, f"full well {self.full_well_e}", "above 0 electrons")
        _require(self.dark_frames >= 1, f"{self.dark_frames} dark frames", "at least 1")
        _require(self.bits is None or 4 <= self.bits <= 16, f"{self.bits} bits", "None or 4 to 16")
        _require(self.saturation is None or self.saturation > 0, f"saturation {self.saturation}", "above 0")
        _require(
            self.bits is None or (self.saturation or 1) <= 1, f"saturation {self.saturation}", "at most 1 with bits"
        )
        _require(self.oversample >= 1, f"{self.oversample} patches along a pixel", "at least 1")
        _require(self.gamma is None or self.gamma > 0, f"gamma {self.gamma}", "above 0")

    @property
    def has_dark(self) -> bool:
        """Whether a picture without light is anything but 0, so that dark pictures are part of the capture."""
        return self.dark_level > 0 or self.ambient_per_s > 0


@dataclass(frozen=True, kw_only=True)
class SimulatedRig:
    """Lights, sweeps and a camera."""

    name: str
    lights: tuple[Light, ...]
    """Those of the capture, basis first."""
    heldout: tuple[Light, ...] = ()
    """Those to be relit: never part of the capture."""
    slab_width_px: float = 4.0
    slab_step_px: float = 2.0
    """Pixels a frame."""
    sweep_x: tuple[str, ...] = ()
    """Lights whose slab sweeps along x."""
    sweep_y: tuple[str, ...] = ()
    """Lights whose slab also sweeps along y."""
    camera: SimulatedCamera = field(default_factory=SimulatedCamera)
    drift: Drift = field(default_factory=Drift)

    def __post_init__(self) -> None:
        """Refuse lights that cannot carry the method and slabs that leave points unlit."""
        names = [light.name for light in (*self.lights, *self.heldout)]
        if len(set(names)) != len(names):
            raise LightError(f"rig {self.name}: light names {names}, expected all different")
        if len(self.lights) < 3:
            raise LightError(f"rig {self.name}: {len(self.lights)} lights, expected at least the 3 of the basis")
        for light in (*self.lights, *self.heldout):
            if light.direction is None or not light.direction[2] > 0 or not min(light.intensity) > 0:
                raise LightError(f"rig {self.name}: light {light.name} needs a direction with z > 0 and intensity > 0")
        missing = [name for name in (*self.sweep_x, *self.sweep_y) if name not in self.lights_by_name]
        if missing:
            raise LightError(f"rig {self.name}: sweeps for {', '.join(missing)}, which it has no light for")
        if not self.slab_width_px >= self.slab_step_px > 0:
            raise SettingsError(
                f"rig {self.name}: slab of {self.slab_width_px} px stepping {self.slab_step_px} px, "
                "expected a step above 0 and no wider than the slab"
            )

    @property
    def lights_by_name(self) -> Mapping[str, Light]:
        """The capture's lights."""
        return {light.name: light for light in self.lights}

    @property
    def sweeps(self) -> tuple[tuple[str, Literal["x", "y"]], ...]:
        """(light, direction) of every sweep, in the capture's order."""
        return (*((name, "x") for name in self.sweep_x), *((name, "y") for name in self.sweep_y))

    @property
    def lit_frames(self) -> float:
        """Frames in which a point is lit: exactly, where it is a whole number; else on average."""
        return self.slab_width_px / self.slab_step_px


def slab_frames(
    points: Float[Tensor, "patches 3"], light: Vector, axis: Literal["x", "y"], width_px: float, step_px: float
) -> Bool[Tensor, "patches frames"]:
    """Which patches a slab lights in which frame, from before the object to after it.

    Where width / step is a whole number, every patch is lit in exactly that many frames.

    Args:
        points: (x, y, z) in pixels.
        light: Unit vector towards the light, z > 0.
        axis: Direction in which the slab moves, from negative to positive.
        width_px: Width of the slab along `axis`.
        step_px: Its step a frame.
    """
    u = slab_coordinate(points, light, axis)
    ratio = width_px / step_px
    # A multiple of the step, divided by it again, may miss the whole number by its last bit.
    ratio = float(round(ratio)) if abs(ratio - round(ratio)) < 1e-12 * ratio else ratio
    first = float(u.min())
    # In steps since frame 0. Half-open intervals and whole shifts of one float: i <= t < i + ratio counts exactly.
    t = (u - first) / step_px + (math.ceil(ratio) - 1 + MARGIN_FRAMES)
    count = math.floor(float(t.max())) + 1 + MARGIN_FRAMES
    since = t[:, None] - torch.arange(count, dtype=t.dtype)
    return (since >= 0) & (since < ratio)


def slab_coordinate(
    points: Float[Tensor, "patches 3"], light: Vector, axis: Literal["x", "y"]
) -> Float[Tensor, "patches"]:
    """u(p): where a point's shadow along the light falls on the axis of the sweep, pixels."""
    index = 0 if axis == "x" else 1
    return points[:, index] - points[:, 2] * (light[index] / light[2])


def direction(tilt_deg: float, azimuth_deg: float) -> Vector:
    """Unit vector `tilt_deg` off the view, at `azimuth_deg` from x towards y."""
    tilt, azimuth = math.radians(tilt_deg), math.radians(azimuth_deg)
    return (math.sin(tilt) * math.cos(azimuth), math.sin(tilt) * math.sin(azimuth), math.cos(tilt))


def _lights(first: int, tilts_azimuths: list[tuple[float, float]]) -> tuple[Light, ...]:
    return tuple(
        Light(name=f"L{first + index}", direction=direction(tilt, azimuth))
        for index, (tilt, azimuth) in enumerate(tilts_azimuths)
    )


def _require(holds: bool, found: str, expected: str) -> None:
    if not holds:
        raise SettingsError(f"simulated camera: {found}, expected {expected}")


def make_rig(  # noqa: PLR0913  (a rig by numbers)
    name: str,
    *,
    lights: int = 6,
    basis_tilt_deg: float = 30.0,
    spread_deg: tuple[float, float] = (15.0, 35.0),
    heldout: tuple[int, int] = (3, 1),
    sweeps: tuple[int, int] = (3, 0),
    slab_px: tuple[float, float] = (4.0, 2.0),
    camera: SimulatedCamera | None = None,
    drift: Drift | None = None,
) -> SimulatedRig:
    """A rig by numbers: three basis lights 120 degrees apart, the others on a spiral around the view.

    Args:
        name: Its name.
        lights: Lights of the capture, at least 3.
        basis_tilt_deg: Angle of the basis lights off the view.
        spread_deg: Smallest and largest angle of the others.
        heldout: Lights to relight inside the cone of the basis, and outside it.
        sweeps: Lights swept along x, and along y; the basis first.
        slab_px: Width and step of the slab.
        camera: The camera; a perfect one by default.
        drift: How it moves between exposures; not at all by default.

    Raises:
        LightError: fewer than 3 lights, or more sweeps than lights.
        SettingsError: a slab that leaves points unlit, or an angle that is not between 0 and 90 degrees.
    """
    if not (0 < basis_tilt_deg < 90 and 0 <= spread_deg[0] <= spread_deg[1] < 90):
        raise SettingsError(f"rig {name}: angles {basis_tilt_deg}, {spread_deg} degrees, expected 0 to 90")
    if not max(sweeps) <= lights:
        raise LightError(f"rig {name}: {max(sweeps)} lights to sweep, but it has {lights}")
    basis = [(basis_tilt_deg, azimuth) for azimuth in (90.0, 210.0, 330.0)]
    inside, outside = heldout
    # The cone of the basis narrows to half its width between two of its lights.
    kept_in = _spiral(inside, 0.15 * basis_tilt_deg, 0.42 * basis_tilt_deg, 60.0)
    kept_out = _spiral(outside, min(basis_tilt_deg + 18, 80.0), min(basis_tilt_deg + 25, 85.0), 180.0)
    chosen = _lights(1, [*basis, *_spiral(lights - 3, *spread_deg, 30.0)][:lights])
    names = [light.name for light in chosen]
    return SimulatedRig(
        name=name,
        lights=chosen,
        heldout=_lights(lights + 1, [*kept_in, *kept_out]),
        slab_width_px=slab_px[0],
        slab_step_px=slab_px[1],
        sweep_x=tuple(names[: sweeps[0]]),
        sweep_y=tuple(names[: sweeps[1]]),
        camera=camera or SimulatedCamera(),
        drift=drift or Drift(),
    )


def _spiral(count: int, least_deg: float, most_deg: float, first_azimuth_deg: float) -> list[tuple[float, float]]:
    """(tilt, azimuth) of `count` lights, evenly over a ring of the sky."""
    shares = [math.sqrt((index + 0.5) / count) for index in range(count)]
    return [
        (least_deg + (most_deg - least_deg) * share, (first_azimuth_deg + GOLDEN_DEG * index) % 360)
        for index, share in enumerate(shares)
    ]


def _preset(name: str, tilts_azimuths: list[tuple[float, float]]) -> SimulatedRig:
    basis = tuple(f"L{index}" for index in (1, 2, 3))
    lights = _lights(1, tilts_azimuths)
    return SimulatedRig(
        name=name,
        lights=lights,
        heldout=_lights(len(lights) + 1, [*INSIDE, *OUTSIDE]),
        sweep_x=basis,
    )


RIGS: dict[str, SimulatedRig] = {
    "six": _preset("six", SIX),
    "paper": _preset("paper", PAPER),
    "twelve": _preset("twelve", TWELVE),
    "dome50": _preset("dome50", [*BASIS, *_spiral(47, 8.0, 45.0, 0.0)]),
}
"""Every preset by name. The last held-out light is outside the cone of the basis, the others inside.

Change one with `dataclasses.replace(RIGS["six"], slab_width_px=6)`.
"""
