"""Writes simulated pictures as a capture folder with the lights to relight and the truth beside it.

capture.json  mask.png  full/L1.exr  sweep/L1/0000.exr  sweep_y/L1/0000.exr  dark.exr  dark_sweep.exr
heldout.json  heldout/L7.exr         truth/L1.exr (channels specular.Y, ...)  truth/*
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.data import Capture, Encoding, Light, Picture, Sweep
from reflectsep.errors import SettingsError
from reflectsep.io.ahead import in_order, lead_for
from reflectsep.io.capture import write_manifest
from reflectsep.io.exr import write_channels
from reflectsep.io.files import write_json
from reflectsep.io.pictures import write_picture
from reflectsep.synth.camera import exposed, noise, store, suffix
from reflectsep.synth.drift import Pose, binned, moved, pose
from reflectsep.synth.objects import SimulatedObject
from reflectsep.synth.rig import SimulatedRig

Progress = Callable[[str, int, int], None]
"""Told (stage, done, total)."""


@dataclass(frozen=True, kw_only=True)
class SimulatedPictures:
    """Noise-free pictures in the capture's units: of every light, held-out ones included.

    With as many patches along a pixel's side as the camera's `oversample` says.
    """

    object: str
    mask: Bool[Tensor, "height width"]
    full: Mapping[str, Float[Tensor, "channels height width"]]
    components: Mapping[str, Mapping[str, Float[Tensor, "channels height width"]]]
    """By light, then by component."""
    frame_counts: tuple[int, ...]
    """Number of frames of every sweep of the rig, in its order."""


@dataclass(frozen=True, kw_only=True)
class SimulatedFrame:
    """One noise-free slab frame, at the exposure of the full pictures."""

    sweep: int
    """Which of the rig's sweeps."""
    index: int
    values: Float[Tensor, "channels height width"]


def channel_names(channels: int) -> str:
    """Y, or RGB."""
    return "Y" if channels == 1 else "RGB"


def write_capture(
    folder: Path,
    rig: SimulatedRig,
    pictures: SimulatedPictures,
    frames: Iterable[SimulatedFrame],
    *,
    seed: int,
    progress: Progress | None = None,
) -> Capture:
    """Write everything but what only the caller knows; frames are taken one at a time, the manifest comes last.

    Args:
        folder: An existing folder.
        rig: What took the pictures.
        pictures: Noise-free pictures, before the camera adds up each pixel's patches.
        frames: Every frame of every sweep, in any order.
        seed: Of the noise.
        progress: Told about the stage "frames".

    Returns:
        The capture as written.

    Raises:
        SettingsError: a full picture is not finite, or all its pixels are zero.
    """
    camera, fine = rig.camera, rig.camera.oversample
    shape = binned(next(iter(pictures.full.values())), fine).shape
    _check(pictures)
    poses = poses_of(rig, (shape[2], shape[1]), seed)
    for light in rig.lights:
        name = f"full/{light.name}"
        seen = moved(pictures.full[light.name], poses[name].matrix, fine)
        picture = exposed(camera, seen, camera.full_exposure_s, sigma=camera.full_sigma, rng=noise(seed, name))
        _store(rig, folder, name, picture)
    if camera.has_dark:
        _write_dark(rig, folder, "dark", camera.full_exposure_s, shape, seed)
        if rig.sweeps:
            _write_dark(rig, folder, "dark_sweep", camera.slab_exposure_s, shape, seed)
    mask = binned(pictures.mask[None].to(torch.float32), fine) >= 0.5
    write_picture(folder / "mask.png", mask.to(torch.float32))
    _write_truth(folder, rig, pictures)
    if rig.drift.any:
        write_json(folder / "truth" / "drift.json", {name: at.document() for name, at in poses.items()})
    total = sum(pictures.frame_counts)

    def take(frame: SimulatedFrame) -> None:
        place = frame_folder(*rig.sweeps[frame.sweep])
        name = f"{place}/{frame.index:04d}"
        time = 2.0 * frame.index / max(1, pictures.frame_counts[frame.sweep] - 1) - 1.0
        seen = moved(frame.values, poses[place].at(time), fine)
        picture = exposed(camera, seen, camera.slab_exposure_s, sigma=camera.frame_sigma, rng=noise(seed, name))
        _store(rig, folder, name, picture)

    for done, _ in enumerate(in_order(take, frames, lead_for(pictures.mask.numel() * shape[0] * 8))):
        if progress:
            progress("frames", done + 1, total)
    return write_manifest(folder, _manifest(folder, rig, pictures))


def poses_of(rig: SimulatedRig, size: tuple[int, int], seed: int) -> dict[str, Pose]:
    """Where the camera is in every full picture and sweep, by their names in the folder."""
    first = rig.lights[0].name
    poses = {
        f"full/{light.name}": pose(rig.drift, f"full/{light.name}", seed=seed, size=size)
        if light.name != first
        else Pose(matrix=torch.eye(3, dtype=torch.float64))
        for light in rig.lights
    }
    for light, axis in rig.sweeps:
        name = frame_folder(light, axis)
        poses[name] = pose(rig.drift, name, seed=seed, size=size, still=poses[f"full/{light}"])
    return poses


def frame_folder(light: str, axis: Literal["x", "y"]) -> str:
    """Where a sweep's frames are."""
    return f"sweep/{light}" if axis == "x" else f"sweep_y/{light}"


def write_layers(path: Path, layers: Mapping[str, Float[Tensor, "channels height width"]]) -> None:
    """An EXR with channels LAYER.Y, or LAYER.R, LAYER.G, LAYER.B, float32."""
    write_channels(
        path,
        {
            f"{layer}.{channel}": plane.to(torch.float32).numpy()
            for layer, values in layers.items()
            for channel, plane in zip(channel_names(values.shape[0]), values, strict=True)
        },
    )


def write_geometry(path: Path, obj: SimulatedObject, oversample: int = 1) -> None:
    """An EXR with channels normal.X, .Y, .Z, depth (height towards the camera, pixels) and material (-1 is outside).

    Of every pixel the patch next to its middle.
    """
    planes = {f"normal.{axis}": plane for axis, plane in zip("XYZ", obj.normals, strict=True)}
    planes |= {"depth": obj.z / oversample, "material": obj.material}
    every = slice(oversample // 2, None, oversample)
    write_channels(path, {name: plane[every, every].to(torch.float32).numpy() for name, plane in planes.items()})


def _check(pictures: SimulatedPictures) -> None:
    for name, values in pictures.full.items():
        if not bool(torch.isfinite(values).all()):
            raise SettingsError(f"object {pictures.object}: its picture under {name} has values that are not finite")
        if not bool((values > 0).any()):
            raise SettingsError(f"object {pictures.object}: light {name} reaches no part of it that the camera sees")


def _store(rig: SimulatedRig, folder: Path, name: str, picture: Tensor) -> None:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    store(rig.camera, folder / name, picture)


def _write_dark(rig: SimulatedRig, folder: Path, name: str, exposure_s: float, shape: torch.Size, seed: int) -> None:
    nothing = torch.zeros(shape, dtype=torch.float64)
    camera = rig.camera
    picture = exposed(camera, nothing, exposure_s, sigma=0.0, rng=noise(seed, name), average=camera.dark_frames)
    _store(rig, folder, name, picture)


def _write_truth(folder: Path, rig: SimulatedRig, pictures: SimulatedPictures) -> None:
    for light in rig.heldout:
        seen = binned(pictures.full[light.name], rig.camera.oversample)
        write_picture(folder / "heldout" / f"{light.name}.exr", seen.to(torch.float32))
    write_json(folder / "heldout.json", {"lights": {light.name: _light(light) for light in rig.heldout}})
    for name, components in pictures.components.items():
        seen = {key: binned(picture, rig.camera.oversample) for key, picture in components.items()}
        write_layers(folder / "truth" / f"{name}.exr", seen)


def _light(light: Light) -> dict[str, object]:
    intensity = light.intensity[0] if len(light.intensity) == 1 else list(light.intensity)
    return {"direction": list(light.direction or ()), "intensity": intensity}


def _manifest(folder: Path, rig: SimulatedRig, pictures: SimulatedPictures) -> Capture:
    camera, ending = rig.camera, suffix(rig.camera)
    height, width = (side // camera.oversample for side in pictures.mask.shape)
    images = [
        Picture(kind="full", light=light.name, file=f"full/{light.name}{ending}", exposure_s=camera.full_exposure_s)
        for light in rig.lights
    ]
    if camera.has_dark:
        images.append(Picture(kind="dark", file=f"dark{ending}", exposure_s=camera.full_exposure_s))
    sweeps = tuple(
        Sweep(
            light=light,
            direction=axis,
            exposure_s=camera.slab_exposure_s,
            frames=frame_folder(light, axis) + "/{:04d}" + ending,
            count=count,
            dark=f"dark_sweep{ending}" if camera.has_dark else None,
        )
        for (light, axis), count in zip(rig.sweeps, pictures.frame_counts, strict=True)
    )
    first, second, third = (light.name for light in rig.lights[:3])
    return Capture(
        folder=folder,
        object=pictures.object,
        encoding=Encoding() if camera.gamma is None else Encoding(kind="gamma", gamma=camera.gamma),
        size=(width, height),
        mask="mask.png",
        lights=rig.lights_by_name,
        basis=(first, second, third),
        images=tuple(images),
        sweeps=sweeps,
    )
