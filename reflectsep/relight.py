"""Pictures under lights never taken: from light vectors to alpha (Eq. 15), and from alpha to a folder of EXRs.

There is no model in here; whatever can be relit is asked for the pictures.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.data import Light, Vector
from reflectsep.errors import LightError
from reflectsep.io.exr import write_channels
from reflectsep.io.files import atomic_folder, write_json
from reflectsep.progress import Progress, silent

MARKER = "relit.json"
"""In every folder of relit pictures: the alpha of each, and the sign that the folder may be replaced."""


class Relightable(Protocol):
    """What can be relit; a separation, in short."""

    def relight(self, alpha: Tensor, /) -> Tensor:
        """Pictures (..., channels, height, width) for alpha (..., 3), intensity included."""
        ...


@dataclass(frozen=True, kw_only=True)
class LightMix:
    """A light to relight with."""

    alpha: Vector
    """Mix of the basis lights (Eq. 15), intensity included."""
    colour: tuple[float, ...] | None = None
    """Factor on each channel of the picture, for a coloured light; None for a white one."""


def alphas_for(lights: Sequence[Light], basis: Float[Tensor, "lights 3"] | None) -> dict[str, LightMix]:
    """What every light is as a mix of the basis lights, by name.

    Args:
        lights: with directions; their intensity, of one value or one a channel, is in the unit of the basis lights'.
        basis: direction times intensity of the basis lights in its first three rows; None where they are unknown.

    Raises:
        LightError: a light without direction, with an intensity that is negative or not a number, a name given twice or
            unfit for a file; no light at all; basis lights that are unknown or coplanar.
    """
    if basis is None:
        raise LightError(
            "the result's basis lights have no directions, so a direction means nothing: give alpha instead"
        )
    vectors = basis[:3].detach().double().cpu()
    sizes = torch.linalg.svdvals(vectors) if bool(torch.isfinite(vectors).all()) else torch.zeros(3)
    if float(sizes[2]) <= 1e-6 * float(sizes[0]):
        raise LightError("the result's basis lights are coplanar; expected three directions that span space")
    if not lights:
        raise LightError("no lights to relight with; expected at least one")
    mixes: dict[str, LightMix] = {}
    for light in lights:
        name = safe_name(light.name)
        if name.lower() in {taken.lower() for taken in mixes}:
            raise LightError(f"light {name}: the name appears twice (case aside); every light needs a file of its own")
        intensity = _intensity(light)
        white = len(intensity) == 1
        alpha = torch.linalg.solve(vectors.mT, _unit(light) * (intensity[0] if white else 1.0))
        mixes[name] = LightMix(
            alpha=(float(alpha[0]), float(alpha[1]), float(alpha[2])), colour=None if white else intensity
        )
    return mixes


def outside_basis(alpha: Sequence[float]) -> bool:
    """Whether a light lies outside the triangle of the basis lights: its picture is extrapolated, not interpolated."""
    return min(alpha) < -1e-4 * max(map(abs, alpha))


def place_of(alpha: Sequence[float], basis: Float[Tensor, "lights 3"], view: Float[Tensor, "3"]) -> str:
    """Where a light stands, in words: its angle off the view, and whether it lies between the basis lights."""
    vector = torch.tensor(tuple(alpha), dtype=torch.float64) @ basis[:3].double()
    size = float(vector.norm() * view.double().norm())
    angle_deg = math.degrees(math.acos(min(1.0, max(-1.0, float(vector @ view.double()) / max(size, 1e-30)))))
    return f"{angle_deg:.0f}° off the view, {'outside' if outside_basis(alpha) else 'between'} the basis lights"


def orbit(count: int, elevation_deg: float, *, start_deg: float = 0.0, intensity: float = 1.0) -> tuple[Light, ...]:
    """Lights on a circle round the view axis, counter-clockwise from x, named `orbit_0000` and so on.

    Args:
        count: of lights, evenly spaced; the circle is closed, so that the pictures loop.
        elevation_deg: above the picture plane; 90 is along the view axis.
        start_deg: azimuth of the first.
        intensity: of each, in the unit of the basis lights'.

    Raises:
        LightError: no lights, or an elevation outside 0 to 90.
    """
    if count < 1 or not 0 <= elevation_deg <= 90:
        raise LightError(
            f"orbit of {count} lights at {elevation_deg:g} degrees: expected at least 1, in 0 to 90 degrees"
        )
    up, out = math.sin(math.radians(elevation_deg)), math.cos(math.radians(elevation_deg))
    lights = []
    for i in range(count):
        azimuth = math.radians(start_deg + 360.0 * i / count)
        direction = (out * math.cos(azimuth), out * math.sin(azimuth), up)
        lights.append(Light(name=f"orbit_{i:04d}", direction=direction, intensity=(intensity,)))
    return tuple(lights)


def relight_to_folder(
    separation: Relightable,
    lights: Mapping[str, LightMix | Sequence[float] | Tensor],
    out: Path | str,
    *,
    overwrite: bool = False,
    progress: Progress = silent,
    chunk: int = 4,
) -> tuple[Path, ...]:
    """Write `NAME.exr` (float32, linear, channels R G B or Y) for every light; all of them, or nothing at all.

    Args:
        separation: to be relit.
        lights: by name: a mix, or a bare alpha of three numbers.
        out: folder to make.
        overwrite: replace a folder of relit pictures that is there.
        progress: told of every picture.
        chunk: pictures relit at a time, which bounds memory.

    Returns:
        The files written, in the order of `lights`.

    Raises:
        LightError: no lights, a name unfit for a file, an alpha that is not three finite numbers.
        ResultError: `out` exists and may not be replaced.
    """
    mixes = {safe_name(name): _as_mix(name, value) for name, value in lights.items()}
    if not mixes:
        raise LightError("no lights to relight with; expected at least one")
    if len({name.lower() for name in mixes}) < len(mixes):
        raise LightError("two lights share a name (case aside); every light needs a file of its own")
    with atomic_folder(out, overwrite) as folder:
        for done, (name, picture) in enumerate(relit_pictures(separation, mixes, chunk=chunk), start=1):
            write_channels(folder / f"{name}.exr", _channels(picture))
            progress("relight", done, len(mixes))
        write_marker(folder, mixes)
    return tuple(Path(out) / f"{name}.exr" for name in mixes)


def write_marker(folder: Path, mixes: Mapping[str, LightMix]) -> None:
    """Write what every light was: `relit.json`, which makes the folder one of ours."""
    document = {name: _described(mix) for name, mix in mixes.items()}
    write_json(folder / MARKER, {"format": "reflectsep-relit/1", "lights": document})


def relit_pictures(
    separation: Relightable, mixes: Mapping[str, LightMix], *, chunk: int = 4
) -> Iterator[tuple[str, Float[Tensor, "channels height width"]]]:
    """The pictures of `mixes` one after the other, relit `chunk` at a time.

    Raises:
        LightError: a coloured light on a grey result; a relit picture that is not finite.
    """
    names = list(mixes)
    for start in range(0, len(names), chunk):
        part = names[start : start + chunk]
        with torch.no_grad():
            pictures = separation.relight(torch.tensor([mixes[name].alpha for name in part], dtype=torch.float32))
        for name, picture in zip(part, pictures, strict=True):
            lit = _coloured(name, picture, mixes[name].colour)
            if not bool(torch.isfinite(lit).all()):
                raise LightError(f"light {name}: the relit picture is not finite; its alpha or intensity is too large")
            yield name, lit


def safe_name(name: str) -> str:
    """`name`, sure to be that of a plain file on any system.

    Raises:
        LightError: it is empty or too long, starts with a dot, or has a separator or other unusual character in it.
    """
    if not re.fullmatch(r"[\w\-+=@#~(),][\w\-+=@#~(), .]{0,119}", name) or name.endswith((" ", ".")):
        raise LightError(
            f"light name {name!r} cannot name a file: letters, digits, '-', '_', '.' and spaces are expected"
        )
    return name


def _unit(light: Light) -> Tensor:
    """Direction of `light`, of length 1."""
    if light.direction is None:
        raise LightError(f"light {light.name}: has no direction; expected three numbers [x, y, z]")
    vector = torch.tensor(light.direction, dtype=torch.float64)
    length = float(vector.norm())
    if not math.isfinite(length) or length < 1e-9:
        raise LightError(f"light {light.name}: direction {list(light.direction)} is zero or not finite")
    return vector / length


def _intensity(light: Light) -> tuple[float, ...]:
    """Intensity of `light`, checked."""
    if not light.intensity or not all(math.isfinite(value) and value >= 0 for value in light.intensity):
        raise LightError(
            f"light {light.name}: intensity {list(light.intensity)}; expected finite numbers, none negative"
        )
    return light.intensity


def _as_mix(name: str, value: LightMix | Sequence[float] | Tensor) -> LightMix:
    """A `LightMix` from any of its spellings."""
    if isinstance(value, LightMix):
        mix = value
    else:
        numbers = [float(number) for number in torch.as_tensor(value).reshape(-1)]
        if len(numbers) != 3:
            raise LightError(f"light {name}: alpha of {len(numbers)} numbers; expected three")
        mix = LightMix(alpha=(numbers[0], numbers[1], numbers[2]))
    if not all(math.isfinite(number) for number in (*mix.alpha, *(mix.colour or ()))):
        raise LightError(f"light {name}: alpha {list(mix.alpha)}, colour {mix.colour}; expected finite numbers")
    return mix


def _coloured(name: str, picture: Tensor, colour: tuple[float, ...] | None) -> Tensor:
    """`picture` under a light of another colour."""
    if colour is None:
        return picture
    if len(colour) != picture.shape[0]:
        raise LightError(
            f"light {name}: intensity of {len(colour)} values for a picture of {picture.shape[0]} channels"
        )
    return picture * torch.tensor(colour, dtype=picture.dtype, device=picture.device)[:, None, None]


def _described(mix: LightMix) -> dict[str, list[float]]:
    """`mix` for JSON."""
    return {"alpha": list(mix.alpha)} | ({} if mix.colour is None else {"colour": list(mix.colour)})


def _channels(picture: Tensor) -> dict[str, np.ndarray]:
    """Channels of an EXR file: Y, or R G B."""
    names = ("Y",) if picture.shape[0] == 1 else ("R", "G", "B")
    planes = picture.detach().float().cpu().numpy()
    return dict(zip(names, planes, strict=True))
