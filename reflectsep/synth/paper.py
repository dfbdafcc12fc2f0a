"""Pictures made exactly by the paper's model, for recovery tests: no light transport, only the formula.

    I_k = (d_k + s_k)_+^n_d + (a_k + B d_k)_+^n_s          k = 1..3                   (Eqs. 18, 19)
    I_j = (sum_i alpha_ij (d_i + s_i))_+^n_d + (sum_i alpha_ij (a_i + B d_i))_+^n_s     (Eqs. 20, 21)

with d_k = q N.L_k (negative where the surface faces away), a_k = C_1 L_k.V and B = C_2 N.V / q, for a surface of
normals N and albedo root q; a mirror's lobe has C_2 = -2 C_1. L_j = sum_i alpha_ij L_i (Eq. 15).

A sweep is made so that Eq. 25 holds in every pixel: of the root of the picture, the scattering is dealt out over the
frames by the slab's distance, the rest goes to the frames in which the slab lights the pixel.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.data import Light
from reflectsep.errors import LightError, SettingsError
from reflectsep.io.files import atomic_folder, write_json
from reflectsep.synth.folder import (
    Progress,
    SimulatedFrame,
    SimulatedPictures,
    write_capture,
    write_geometry,
    write_layers,
)
from reflectsep.synth.objects import SimulatedObject, from_height, in_channels
from reflectsep.synth.presets import bumps, plain_material
from reflectsep.synth.rig import SimulatedCamera, SimulatedRig, make_rig, slab_coordinate, slab_frames

FALL_PX = 6.0
"""Length over which the scattering of a synthesised sweep falls by a factor e."""
STEEPNESS = 0.042
"""Height of the bumps as a share of the picture: normals up to about 25 degrees off the view."""


@dataclass(frozen=True, kw_only=True)
class PaperObject:
    """A bumpy surface that fills the picture, and the globals of the model."""

    name: str = "paper"
    size: int = 64
    channels: int = 1
    n_d: float = 1.0
    n_s: float = 14.0
    C_1: float = -0.91
    """Below 0 for a forward lobe."""
    mirror: float = 1.015
    """C_2 = -2 C_1 mirror: 1 is a mirror's lobe."""
    scattering: float = 0.19
    """Typical scattering root s; 0 is none."""
    shape_seed: int = 0

    def __post_init__(self) -> None:
        """Refuse what the model has no meaning for."""
        if not (self.n_d > 0 and self.n_s > 0 and self.C_1 < 0 and self.mirror > 0 and self.scattering >= 0):
            raise SettingsError(
                f"paper object: n_d {self.n_d}, n_s {self.n_s}, C_1 {self.C_1}, mirror {self.mirror}, "
                f"scattering {self.scattering}; expected > 0, > 0, < 0, > 0, >= 0"
            )
        if self.size < 8:
            raise SettingsError(f"paper object: size {self.size} px, expected at least 8")


@dataclass(frozen=True, kw_only=True)
class PaperTruth:
    """Parameters of every pixel, float64."""

    surface: SimulatedObject
    d: Float[Tensor, "3 channels height width"]
    s: Float[Tensor, "3 channels height width"]
    B: Float[Tensor, "channels height width"]
    a: Float[Tensor, "3"]
    n_d: float
    n_s: float


@dataclass(frozen=True, kw_only=True)
class PaperPicture:
    """One light's picture and its parts; the whole diffuse is not the sum of its two parts unless n_d = 1."""

    full: Float[Tensor, "channels height width"]
    specular: Float[Tensor, "channels height width"]
    local_diffuse: Float[Tensor, "channels height width"]
    scattering: Float[Tensor, "channels height width"]
    diffuse: Float[Tensor, "channels height width"]


@dataclass(frozen=True, kw_only=True)
class SlabSchedule:
    """A sweep over a surface that fills the picture."""

    lit: Float[Tensor, "frames height width"]
    """1 where the slab lights a pixel, else 0."""
    share: Float[Tensor, "frames height width"]
    """Weight of a pixel's scattering in each frame; sums to the number of frames in which it is lit."""


def paper_rig(lights: int = 6, *, sigma: float = 0.0, sweeps: int = 0) -> SimulatedRig:
    """Lights 15 to 30 degrees off the view, three to relight inside the cone of the basis, noise against a peak of 1.

    Args:
        lights: Pictures of the capture: 6, 12, 50 or any number from 3.
        sigma: Gaussian noise of pictures and frames.
        sweeps: Lights swept along x; 0 leaves the scattering to `truth/scattering.exr`.
    """
    return make_rig(
        f"paper{lights}",
        lights=lights,
        basis_tilt_deg=28.0,
        spread_deg=(15.0, 30.0),
        heldout=(3, 0),
        sweeps=(sweeps, 0),
        camera=SimulatedCamera(full_sigma=sigma, frame_sigma=sigma),
    )


def paper_truth(obj: PaperObject, rig: SimulatedRig) -> PaperTruth:
    """Parameters of `obj` under the basis lights of `rig`."""
    surface = _surface(obj)
    height, width = surface.mask.shape
    x, y = (torch.arange(n, dtype=torch.float64) / obj.size for n in (width, height))
    u, v = x.expand(height, width), y[:, None].expand(height, width)
    tint = torch.tensor(in_channels({"q": (1.10, 0.95, 0.80)}, obj.channels)["q"], dtype=torch.float64)
    paint = 0.37 + 0.055 * bumps(u, v, obj.shape_seed + 11)
    # n_d makes the picture d^n_d: the root of an albedo, so that pictures stay as bright whatever n_d is.
    q = (tint[:, None, None] * paint) ** (1 / obj.n_d)
    basis = _vectors(rig.lights[:3])
    towards = basis / basis.norm(dim=1, keepdim=True)
    strength = basis.norm(dim=1)
    facing = torch.einsum("kx,xhw->khw", towards, surface.normals)
    glow = torch.stack([1 + 0.25 * bumps(u, v, obj.shape_seed + 20 + k) for k in range(3)]).clamp_min(0.2)
    s = (obj.scattering * tint[:, None, None] * glow[:, None]) ** (1 / obj.n_d)
    return PaperTruth(
        surface=surface,
        d=strength[:, None, None, None] * q * facing[:, None],
        s=strength[:, None, None, None] * s,
        B=-2 * obj.C_1 * obj.mirror * surface.normals[2] / q,
        a=obj.C_1 * basis[:, 2],
        n_d=obj.n_d,
        n_s=obj.n_s,
    )


def paper_picture(truth: PaperTruth, alpha: Float[Tensor, "3"]) -> PaperPicture:
    """The picture under the mix `alpha` of the basis lights (Eqs. 20, 21)."""
    d, s = torch.tensordot(alpha, truth.d, 1), torch.tensordot(alpha, truth.s, 1)
    lobe = torch.dot(alpha, truth.a) + truth.B * d
    diffuse = (d + s).clamp_min(0) ** truth.n_d
    specular = lobe.clamp_min(0) ** truth.n_s
    return PaperPicture(
        full=diffuse + specular,
        specular=specular,
        local_diffuse=d.clamp_min(0) ** truth.n_d,
        scattering=s.clamp_min(0) ** truth.n_d,
        diffuse=diffuse,
    )


def simulate_paper(
    obj: PaperObject,
    rig: SimulatedRig,
    out: Path,
    *,
    seed: int,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Write a capture made exactly by the model, with truth beside it.

    Besides what `synth.simulate` writes (the `scattering_beyond_Npx` are all the same, for the model knows no
    distance) there are `truth/parameters.exr` (d1 d2 d3 s1 s2 s3 B), `truth/parameters.json` (globals, alpha) and
    `truth/scattering.exr` (scattering root s of every light, basis lights as they are and others mixed).

    Args:
        obj: Surface and globals.
        rig: Lights, camera, and sweeps if any; values are not rescaled to the camera's `peak`.
        out: Folder to make.
        seed: Of the noise.
        overwrite: Replace an existing capture.
        progress: Told (stage, done, total).

    Returns:
        `out`.

    Raises:
        ResultError: `out` exists and may not be replaced.
        LightError: the basis lights are coplanar, or their intensity is not one value.
    """
    truth = paper_truth(obj, rig)
    lights = (*rig.lights, *rig.heldout)
    alpha = dict(zip([light.name for light in lights], paper_alpha(lights), strict=True))
    made = {name: paper_picture(truth, mix) for name, mix in alpha.items()}
    with atomic_folder(out, overwrite) as folder:
        pictures = SimulatedPictures(
            object=obj.name,
            mask=truth.surface.mask,
            full={name: picture.full for name, picture in made.items()},
            components={name: _components(picture) for name, picture in made.items()},
            frame_counts=tuple(
                len(slab_schedule(truth.surface, rig.lights_by_name[name], axis, rig).lit) for name, axis in rig.sweeps
            ),
        )
        frames = _frames(truth, rig, made, alpha)
        write_capture(folder, rig, pictures, frames, seed=seed, progress=progress)
        _write_parameters(folder / "truth", obj, truth, alpha, rig)
    return Path(out)


def paper_alpha(lights: tuple[Light, ...]) -> Float[Tensor, "lights 3"]:
    """Every light as a mix of the first three, intensity included (Eq. 15).

    Raises:
        LightError: the first three are nearly coplanar, or an intensity is not one value.
    """
    vectors = _vectors(lights)
    condition = float(torch.linalg.cond(vectors[:3]))
    if not condition < 1e6:
        raise LightError(f"basis lights: condition number {condition:.3g}, expected below 1e6: they are coplanar")
    mixes = torch.linalg.solve(vectors[:3].mT, vectors.mT).mT.contiguous()
    mixes[:3] = torch.eye(3, dtype=mixes.dtype)
    return mixes


def paper_frames(
    picture: Float[Tensor, "channels height width"],
    s: Float[Tensor, "channels height width"],
    schedule: SlabSchedule,
    n_d: float,
) -> Iterator[Float[Tensor, "channels height width"]]:
    """Frames whose roots sum to (slab width / step) times the root of the picture, pixel by pixel (Eq. 25).

    Args:
        picture: The full picture, not negative.
        s: Its scattering root, not negative.
        schedule: The slab's way over the object.
        n_d: Exponent of the root.
    """
    root = picture ** (1 / n_d)
    # In an attached shadow the picture may be darker than its scattering: there all of it is scattering.
    wandering = torch.minimum(s, root)
    for lit, share in zip(schedule.lit, schedule.share, strict=True):
        yield (share * wandering + lit * (root - wandering)) ** n_d


def slab_schedule(surface: SimulatedObject, light: Light, axis: Literal["x", "y"], rig: SimulatedRig) -> SlabSchedule:
    """When a slab lights every pixel of a surface that fills the picture, and how its scattering is dealt out."""
    assert light.direction is not None  # a rig has no light without one
    lit = slab_frames(surface.points, light.direction, axis, rig.slab_width_px, rig.slab_step_px).to(torch.float64)
    times = torch.arange(lit.shape[1], dtype=torch.float64)
    u = slab_coordinate(surface.points, light.direction, axis) / rig.slab_step_px
    # When the slab's middle is over the patch: u but for a shift, which the lit frames give.
    centred = u + ((lit * times).sum(1) / lit.sum(1) - u).mean()
    share = torch.exp(-(times - centred[:, None]).abs() * (rig.slab_step_px / FALL_PX))
    share = share * (lit.sum(1, keepdim=True) / share.sum(1, keepdim=True))
    shape = (-1, *surface.mask.shape)
    return SlabSchedule(lit=lit.mT.reshape(shape), share=share.mT.reshape(shape))


def _surface(obj: PaperObject) -> SimulatedObject:
    def height(x: Tensor, y: Tensor) -> Float[Tensor, "height width"]:
        u, v = x / obj.size, y / obj.size
        dome = -0.10 * (u.square() + v.square())
        return obj.size * (STEEPNESS * bumps(u, v, obj.shape_seed) + dome)

    material = plain_material("model", obj.channels)
    return from_height(obj.name, height, size=(obj.size, obj.size), materials=(material,))


def _vectors(lights: tuple[Light, ...]) -> Float[Tensor, "lights 3"]:
    """Direction times intensity."""
    rows = []
    for light in lights:
        if light.direction is None or len(light.intensity) != 1:
            raise LightError(
                f"light {light.name}: needs a direction and an intensity of one value for the paper's model"
            )
        towards = torch.tensor(light.direction, dtype=torch.float64)
        rows.append(towards / towards.norm() * light.intensity[0])
    return torch.stack(rows)


def _components(picture: PaperPicture) -> dict[str, Tensor]:
    parts = {"specular": picture.specular, "local_diffuse": picture.local_diffuse, "diffuse": picture.diffuse}
    return parts | {f"scattering{tail}": picture.scattering for tail in ("", "_beyond_1px", "_beyond_2px")}


def _frames(
    truth: PaperTruth, rig: SimulatedRig, made: dict[str, PaperPicture], alpha: dict[str, Tensor]
) -> Iterator[SimulatedFrame]:
    for sweep, (name, axis) in enumerate(rig.sweeps):
        s = torch.tensordot(alpha[name], truth.s, 1).clamp_min(0)
        schedule = slab_schedule(truth.surface, rig.lights_by_name[name], axis, rig)
        for index, values in enumerate(paper_frames(made[name].full, s, schedule, truth.n_d)):
            yield SimulatedFrame(sweep=sweep, index=index, values=values)


def _write_parameters(
    folder: Path, obj: PaperObject, truth: PaperTruth, alpha: dict[str, Tensor], rig: SimulatedRig
) -> None:
    layers = {f"{prefix}{k + 1}": stack[k] for prefix, stack in (("d", truth.d), ("s", truth.s)) for k in range(3)}
    write_layers(folder / "parameters.exr", layers | {"B": truth.B})
    roots = {light.name: torch.tensordot(alpha[light.name], truth.s, 1) for light in rig.lights}
    write_layers(folder / "scattering.exr", roots)
    write_geometry(folder / "geometry.exr", truth.surface)
    facts = {
        "a": truth.a.tolist(),
        "n_s": truth.n_s,
        "n_d": truth.n_d,
        "C_1": obj.C_1,
        "C_2": -2 * obj.C_1 * obj.mirror,
    }
    write_json(folder / "parameters.json", facts | {"alpha": {name: mix.tolist() for name, mix in alpha.items()}})
