"""An object under a rig, as a capture folder: light transport in, pictures out.

Light adds in radiance, and every step from irradiance to radiance is linear. A slab frame is the picture of the same
light with its irradiance cut to the slab, so the frames of a sweep sum to (slab width / step) times the full picture.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.data import Light, Vector
from reflectsep.errors import SettingsError
from reflectsep.io.ahead import in_order, lead_for, one_thread
from reflectsep.io.files import atomic_folder, write_json
from reflectsep.synth.folder import Progress, SimulatedFrame, SimulatedPictures, write_capture, write_geometry
from reflectsep.synth.objects import SimulatedObject
from reflectsep.synth.rig import SimulatedRig, slab_frames
from reflectsep.synth.shading import irradiance, local_diffuse, specular
from reflectsep.synth.transport import Transport, transmitted, transport

BEYOND_PX = (1, 2)
COLUMNS = {"chord": 1024, "plane": 32}
"""Frames transported at a time: by chord the cost is the kernel, shared by all; by plane it is each frame's own."""
KIND = {"chord": torch.float64, "plane": torch.float32}
"""Arithmetic of the transport: that of large objects is of 24 bits, beyond what any camera stores."""


@dataclass(frozen=True, kw_only=True)
class Illuminated:
    """What one light does at the patches, per unit of scale; intensity included where there are channels."""

    specular: Float[Tensor, "channels patches"]
    local_diffuse: Float[Tensor, "channels patches"]
    entering: Float[Tensor, "patches"]
    """Irradiance below the boundary, without intensity."""
    intensity: Float[Tensor, "channels"]

    @property
    def direct(self) -> Float[Tensor, "channels patches"]:
        """Radiance of light that leaves the patch that it reached."""
        return self.specular + self.local_diffuse


def simulate(
    obj: SimulatedObject,
    rig: SimulatedRig,
    out: Path,
    *,
    seed: int,
    overwrite: bool = False,
    distance: Literal["chord", "plane"] | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write a capture of `obj` by `rig`, with held-out pictures and truth (layout: `synth.folder`).

    Args:
        obj: What is seen; with the camera's `oversample` patches along each of its pixels.
        rig: What sees it.
        out: Folder to make.
        seed: Of all noise; the same seed makes the same files.
        overwrite: Replace an existing capture.
        distance: How far apart patches are (`synth.transport`); by default the exact one up to 12000 patches.
        progress: Told (stage, done, total); stages are "lights", "transport" and "frames".

    Returns:
        `out`.

    Raises:
        ResultError: `out` exists and may not be replaced.
        SettingsError: an intensity with the wrong number of channels, or a light that reaches nothing.
    """
    lights = (*rig.lights, *rig.heldout)
    scattering = transport(obj, distance)
    with one_thread(), atomic_folder(out, overwrite) as folder:
        lit = _light_up(obj, scattering, lights, progress)
        slabs = [_lit_by_slab(obj, rig, name, axis) for name, axis in rig.sweeps]
        pictures, scale = _pictures(obj, rig, scattering, lit, [len(slab) for slab in slabs], progress)
        frames = _frames(obj, rig, scattering, lit, slabs, scale)
        write_capture(folder, rig, pictures, frames, seed=seed, progress=progress)
        write_geometry(folder / "truth" / "geometry.exr", obj, rig.camera.oversample)
        write_json(folder / "truth" / "simulation.json", _facts(obj, rig, scattering, scale, seed))
    return Path(out)


def illuminate(obj: SimulatedObject, scattering: Transport, light: Light) -> Illuminated:
    """Direct light of one light, and what of it enters the object.

    Raises:
        SettingsError: the light's direction is missing or its intensity has another number of channels.
    """
    if light.direction is None:
        raise SettingsError(f"light {light.name}: has no direction, and a simulated light needs one")
    if len(light.intensity) not in (1, obj.channels):
        raise SettingsError(
            f"light {light.name}: intensity of {len(light.intensity)} channels, but {obj.name} has {obj.channels}"
        )
    intensity = torch.tensor(light.intensity, dtype=torch.float64).expand(obj.channels)
    towards = torch.tensor(light.direction, dtype=torch.float64)
    towards = towards / towards.norm()
    reached = irradiance(obj, towards)
    entering = transmitted(obj, towards, reached)
    stays = scattering.self_share() * scattering.out * entering
    return Illuminated(
        specular=intensity[:, None] * (specular(obj, towards) * reached),
        local_diffuse=intensity[:, None] * (local_diffuse(obj, towards) * reached + stays),
        entering=entering,
        intensity=intensity,
    )


def _light_up(
    obj: SimulatedObject, scattering: Transport, lights: tuple[Light, ...], progress: Progress | None
) -> dict[str, Illuminated]:
    lit = {}
    lead = lead_for(8 * 20 * obj.mask.numel())
    found = in_order(lambda light: illuminate(obj, scattering, light), lights, lead)
    for index, (light, illuminated) in enumerate(zip(lights, found, strict=True)):
        lit[light.name] = illuminated
        if progress:
            progress("lights", index + 1, len(lights))
    return lit


def _pictures(
    obj: SimulatedObject,
    rig: SimulatedRig,
    scattering: Transport,
    lit: Mapping[str, Illuminated],
    frame_counts: Sequence[int],
    progress: Progress | None,
) -> tuple[SimulatedPictures, float]:
    """Noise-free pictures of every light, scaled, and the scale: values per unit of radiance."""
    wandering = _wandering(scattering, lit, rig.camera.oversample, progress)
    full = {name: light.direct + wandering["scattering"][name] for name, light in lit.items()}
    values = torch.cat([full[light.name].flatten() for light in rig.lights]).numpy()
    bright = float(np.quantile(values, 0.999))
    if not bright > 0:
        raise SettingsError(f"object {obj.name}: rig {rig.name} lights no part of it that the camera sees")
    scale = rig.camera.peak / bright

    def picture(patches: Tensor) -> Tensor:
        return obj.picture(scale * patches)

    components = {
        name: {"specular": picture(light.specular), "local_diffuse": picture(light.local_diffuse)}
        | {key: picture(by_light[name]) for key, by_light in wandering.items()}
        for name, light in lit.items()
    }
    pictures = SimulatedPictures(
        object=obj.name,
        mask=obj.mask,
        full={name: picture(patches) for name, patches in full.items()},
        components=components,
        frame_counts=tuple(frame_counts),
    )
    return pictures, scale


def _wandering(
    scattering: Transport, lit: Mapping[str, Illuminated], oversample: int, progress: Progress | None
) -> dict[str, dict[str, Float[Tensor, "channels patches"]]]:
    """Scattering of every light: all of it, and that beyond each of `BEYOND_PX`."""
    columns = torch.stack([light.entering for light in lit.values()]).to(KIND[scattering.distance]).mT
    keys = {"scattering": 0, **{f"scattering_beyond_{px}px": px for px in BEYOND_PX}}
    result = {}
    for index, (key, px) in enumerate(keys.items()):
        spread = scattering.spread(columns, px * oversample)
        result[key] = {name: light.intensity[:, None] * spread[..., at] for at, (name, light) in enumerate(lit.items())}
        if progress:
            progress("transport", index + 1, len(keys))
    return result


def _lit_by_slab(
    obj: SimulatedObject, rig: SimulatedRig, light: str, axis: Literal["x", "y"]
) -> Bool[Tensor, "frames patches"]:
    towards: Vector | None = rig.lights_by_name[light].direction
    assert towards is not None  # a rig has no light without one
    fine = rig.camera.oversample
    return slab_frames(obj.points, towards, axis, rig.slab_width_px * fine, rig.slab_step_px * fine).mT.contiguous()


def _frames(
    obj: SimulatedObject,
    rig: SimulatedRig,
    scattering: Transport,
    lit: Mapping[str, Illuminated],
    slabs: Sequence[Bool[Tensor, "frames patches"]],
    scale: float,
) -> Iterator[SimulatedFrame]:
    """Every frame of every sweep, noise-free; transported in batches that bound the memory."""
    jobs = [(sweep, index) for sweep, slab in enumerate(slabs) for index in range(len(slab))]
    size, kind = COLUMNS[scattering.distance], KIND[scattering.distance]
    lights = [lit[name] for name, _ in rig.sweeps]
    entering, direct = (
        [light.entering.to(kind) for light in lights],
        [scale * light.direct.to(kind) for light in lights],
    )
    intensity = [scale * light.intensity[:, None].to(kind) for light in lights]
    for start in range(0, len(jobs), size):
        batch = jobs[start : start + size]
        spread = scattering.spread(torch.stack([slabs[at][index] * entering[at] for at, index in batch]).mT)
        for column, (at, index) in enumerate(batch):
            patches = slabs[at][index] * direct[at] + intensity[at] * spread[..., column]
            yield SimulatedFrame(sweep=at, index=index, values=obj.picture(patches))


def _facts(
    obj: SimulatedObject, rig: SimulatedRig, scattering: Transport, scale: float, seed: int
) -> dict[str, object]:
    """What else a reader of the truth may want: exact gain C, units, and how it was made."""
    return {
        "object": obj.name,
        "rig": rig.name,
        "seed": seed,
        "distance": scattering.distance,
        "values_per_radiance": scale,
        "n_d": 1.0,
        "lit_frames": rig.lit_frames,
        "gain": rig.lit_frames * rig.camera.slab_exposure_s / rig.camera.full_exposure_s,
        "materials": [material.name for material in obj.materials],
    }
