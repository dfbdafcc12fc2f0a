"""The simulated objects that come with the package: wax, pudding, plastic, marble, skin and a turtle."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from reflectsep.errors import SettingsError
from reflectsep.synth.kernels import DipoleKernel, ExponentialKernel, Kernel
from reflectsep.synth.objects import HeightFunction, Material, SimulatedObject, from_height, in_channels
from reflectsep.synth.turtle import in_eye, on_shell, stain, turtle_height

Colour = tuple[float, float, float]

SMALLEST = 16
LABEL = (-0.24, 0.24, -0.22, 0.10)
"""Left, right, bottom, top of the pudding's label, as fractions of the picture."""
GLYPHS = {
    "F": ("#####", "#....", "#....", "####.", "#....", "#....", "#...."),
    "L": ("#....", "#....", "#....", "#....", "#....", "#....", "#####"),
    "A": (".###.", "#...#", "#...#", "#####", "#...#", "#...#", "#...#"),
    "N": ("#...#", "##..#", "#.#.#", "#.#.#", "#..##", "#..##", "#...#"),
}


def make_object(name: str, *, size: int = 96, channels: int = 1, seed: int = 0) -> SimulatedObject:
    """A preset object in a square picture.

    Args:
        name: One of `OBJECTS`.
        size: Width and height in pixels, at least 16; heights and scattering lengths scale with it.
        channels: 1 (grey) or 3.
        seed: Chooses the bumps.

    Returns:
        The object.

    Raises:
        SettingsError: an unknown name, a picture too small, or another number of channels.
    """
    if name not in OBJECTS:
        raise SettingsError(f"object {name!r} is not known, expected one of {', '.join(sorted(OBJECTS))}")
    if size < SMALLEST:
        raise SettingsError(f"object {name}: size {size} px, expected at least {SMALLEST}")
    return OBJECTS[name](size, channels, seed)


def wax(size: int, channels: int, seed: int) -> SimulatedObject:
    """A smooth bumpy blob, strongly translucent, with a clear highlight."""
    material = _material(
        "wax",
        channels,
        diffuse=(0.12, 0.10, 0.08),
        scattering=(0.74, 0.66, 0.54),
        kernels=_exponentials(size, (0.55, 0.45), ((0.017, 0.050), (0.015, 0.042), (0.012, 0.034))),
        roughness=0.2,
    )
    return from_height("wax", _blob(size, seed), size=(size, size), materials=(material,))


def plastic(size: int, channels: int, seed: int) -> SimulatedObject:
    """An opaque glossy blob: nothing scatters."""
    material = _material("plastic", channels, diffuse=(0.25, 0.42, 0.62), scattering=(0, 0, 0), roughness=0.22, ior=1.5)
    return from_height("plastic", _blob(size, seed + 1), size=(size, size), materials=(material,))


def marble(size: int, channels: int, seed: int) -> SimulatedObject:
    """A polished blob with darker, less translucent veins: two materials."""
    stone = _material(
        "stone",
        channels,
        diffuse=(0.22, 0.21, 0.20),
        scattering=(0.62, 0.60, 0.56),
        kernels=_exponentials(size, (0.6, 0.4), ((0.012, 0.036), (0.011, 0.033), (0.010, 0.030))),
        roughness=0.15,
        ior=1.5,
    )
    vein = _material(
        "vein",
        channels,
        diffuse=(0.20, 0.18, 0.18),
        scattering=(0.18, 0.16, 0.18),
        kernels=_exponentials(size, (0.6, 0.4), ((0.009, 0.024), (0.008, 0.022), (0.008, 0.020))),
        roughness=0.15,
        ior=1.5,
    )

    def paint(x: Tensor, y: Tensor) -> Int[Tensor, "height width"]:
        wave = bumps(x / size, y / size, seed + 2)
        return ((torch.sin(14 * (x + 0.6 * y) / size + 5 * wave)).abs() < 0.22).to(torch.int64)

    return from_height("marble", _blob(size, seed + 3), size=(size, size), materials=(stone, vein), paint=paint)


def skin(size: int, channels: int, seed: int) -> SimulatedObject:
    """A rough, oily blob with a dipole kernel whose red reaches furthest."""
    scale = 96 / size
    # The coefficients differ by channel as those of blood and tissue do: little absorption in red, much in blue.
    dipoles: tuple[Kernel, ...] = tuple(
        DipoleKernel(scattering_per_px=s * scale, absorption_per_px=a * scale, ior=1.4)
        for s, a in ((0.55, 0.012), (0.70, 0.050), (0.90, 0.120))
    )
    material = _material(
        "skin",
        channels,
        diffuse=(0.10, 0.09, 0.08),
        scattering=(0.85, 0.80, 0.75),
        kernels=dipoles if channels == 3 else dipoles[1:2],
        diffuse_roughness_deg=20.0,
        specular=0.9,
        roughness=0.32,
        ior=1.4,
    )
    return from_height("skin", _blob(size, seed + 4), size=(size, size), materials=(material,))


def pudding(size: int, channels: int, seed: int) -> SimulatedObject:
    """A very translucent body with a flattish front and bevelled edges, and a printed paper label on it."""
    body = _material(
        "pudding",
        channels,
        diffuse=(0.05, 0.04, 0.03),
        scattering=(0.84, 0.72, 0.48),
        kernels=_exponentials(size, (0.45, 0.55), ((0.030, 0.080), (0.026, 0.068), (0.020, 0.050))),
        specular=1.0,
        roughness=0.25,
        ior=1.4,
    )
    fibres = _exponentials(size, (0.7, 0.3), ((0.010, 0.024), (0.010, 0.022), (0.009, 0.020)))
    paper = _material(
        "paper", channels, diffuse=(0.52, 0.52, 0.50), diffuse_roughness_deg=15.0,
        scattering=(0.26, 0.26, 0.25), kernels=fibres, specular=0.35, roughness=0.45,
    )  # fmt: skip
    ink = _material(
        "ink", channels, diffuse=(0.05, 0.05, 0.09), diffuse_roughness_deg=15.0,
        scattering=(0.03, 0.03, 0.04), kernels=fibres, specular=0.35, roughness=0.45,
    )  # fmt: skip
    return from_height(
        "pudding",
        _box(size, seed),
        size=(size, size),
        materials=(body, paper, ink),
        paint=lambda x, y: _label(x / size, y / size),
    )


def turtle(size: int, channels: int, seed: int) -> SimulatedObject:  # noqa: ARG001  (presets are called alike)
    """A carved turtle: soft green wax with fine grains, an amber shell under a sharp glaze, black eyes."""
    kernels = _exponentials(size, (0.55, 0.45), ((0.014, 0.042), (0.011, 0.030), (0.008, 0.020)))
    skin = _material(
        "wax", channels, diffuse=(0.10, 0.17, 0.09), scattering=(0.42, 0.66, 0.38), kernels=kernels, roughness=0.35,
    )  # fmt: skip
    shell = _material(
        "glaze", channels, diffuse=(0.16, 0.085, 0.03), scattering=(0.78, 0.50, 0.20), kernels=kernels,
        roughness=0.12, ior=1.55,
    )  # fmt: skip
    eye = _material(
        "eye", channels, diffuse=(0.012, 0.010, 0.010), scattering=(0.02, 0.02, 0.02), kernels=kernels,
        roughness=0.12, ior=1.55,
    )  # fmt: skip
    # The stain takes blue first and red last, as varnish does.
    depth = torch.tensor([1.0, 1.9, 2.5] if channels == 3 else [1.8], dtype=torch.float64)[:, None, None]
    return from_height(
        "turtle",
        lambda x, y: size * turtle_height(x / size, y / size),
        size=(size, size),
        materials=(skin, shell, eye),
        paint=lambda x, y: torch.where(in_eye(x / size, y / size), 2, on_shell(x / size, y / size).to(torch.int64)),
        tint=lambda x, y: torch.exp(-depth * stain(x / size, y / size)),
    )


OBJECTS: dict[str, Callable[[int, int, int], SimulatedObject]] = {
    "wax": wax,
    "pudding": pudding,
    "plastic": plastic,
    "marble": marble,
    "skin": skin,
    "turtle": turtle,
}
"""Every preset by name: (size, channels, seed) -> object."""


def plain_material(name: str, channels: int) -> Material:
    """An opaque grey material without a highlight, for objects whose reflectance is given otherwise."""
    return _material(name, channels, diffuse=(0.5, 0.5, 0.5), scattering=(0, 0, 0), specular=0.0)


def bumps(u: Float[Tensor, "*p"], v: Float[Tensor, "*p"], seed: int, waves: int = 7) -> Float[Tensor, "*p"]:
    """A smooth random function of about -1..1: a few plane waves of 1.2 to 3.2 periods across the picture.

    Args:
        u: x as a fraction of the picture's size.
        v: y as a fraction of it.
        seed: Chooses the waves.
        waves: How many.
    """
    generator = torch.Generator().manual_seed(seed)
    angle, phase, rate = torch.rand(3, waves, dtype=torch.float64, generator=generator)
    total = torch.zeros_like(u)
    for wave in range(waves):
        along = u * math.cos(math.pi * angle[wave]) + v * math.sin(math.pi * angle[wave])
        total = total + torch.sin(2 * math.pi * ((1.2 + 2 * rate[wave]) * along + phase[wave]))
    return total / math.sqrt(waves)


def _material(name: str, channels: int, *, diffuse: Colour, scattering: Colour, **rest: object) -> Material:
    values = in_channels({"diffuse": diffuse, "scattering": scattering}, channels)
    kernels = rest.pop("kernels", ())
    assert isinstance(kernels, tuple)
    # A grey camera sees something like green.
    chosen = kernels if channels == 3 or len(kernels) <= 1 else kernels[1:2]
    return Material(name=name, kernels=chosen, **values, **rest)  # pyright: ignore[reportArgumentType]


def _exponentials(size: int, weights: tuple[float, ...], lengths: tuple[tuple[float, ...], ...]) -> tuple[Kernel, ...]:
    """A kernel a channel; lengths are fractions of the picture."""
    return tuple(ExponentialKernel(weights, tuple(length * size for length in channel)) for channel in lengths)


def _blob(size: int, seed: int) -> HeightFunction:
    """A flattened, slightly lopsided ball with bumps that fade towards its silhouette."""

    def height(x: Tensor, y: Tensor) -> Float[Tensor, "height width"]:
        u, v = x / size, y / size
        angle = torch.atan2(v, u)
        radius = 0.42 + 0.018 * torch.sin(2 * angle + seed + 0.7) + 0.012 * torch.sin(3 * angle + 2 * seed)
        rim = 1 - (u.square() + v.square()) / radius.square()
        inside = rim.clamp_min(0)
        z = size * (0.30 * inside.sqrt() + 0.013 * inside * bumps(u, v, seed))
        return torch.where(rim > 0, z, torch.nan)

    return height


def _box(size: int, seed: int) -> HeightFunction:
    """A rounded box, wider below, seen from its front: a slight dome so that highlights travel, bevelled edges."""
    half_width, half_height, corner, bevel, depth = 0.37, 0.38, 0.10, 0.14, 0.16

    def height(x: Tensor, y: Tensor) -> Float[Tensor, "height width"]:
        u, v = x / size * (1 + 0.25 * y / size), y / size
        across, up = u.abs() - (half_width - corner), v.abs() - (half_height - corner)
        outside = (across.clamp_min(0).square() + up.clamp_min(0).square() + 1e-12).sqrt()
        inset = corner - outside - torch.maximum(across, up).clamp_max(0)
        rise = (1 - (inset / bevel).clamp(0, 1)).square()
        dome = 1 - 2.2 * u.square() - 2.0 * v.square()
        z = size * (depth * (1 - rise).clamp_min(0).sqrt() * dome + 0.0022 * (1 - rise) * bumps(u, v, seed))
        return torch.where(inset > 0, z, torch.nan)

    return height


def _label(u: Float[Tensor, "*p"], v: Float[Tensor, "*p"]) -> Int[Tensor, "*p"]:
    """Material of the pudding at (u, v), fractions of the picture: 0 body, 1 paper, 2 ink."""
    left, right, bottom, top = LABEL
    paper = (u > left) & (u < right) & (v > bottom) & (v < top)
    ink = _printed(u, v, 0.85 * left, 0.85 * right, top - 0.22, top - 0.035)
    for low in (-0.160, -0.202):
        ink |= (u > 0.85 * left) & (u < 0.85 * right) & (v > low) & (v < low + 0.018)
    return paper.to(torch.int64) + (paper & ink).to(torch.int64)


def _printed(u: Tensor, v: Tensor, left: float, right: float, bottom: float, top: float) -> Bool[Tensor, "*p"]:
    """Where the word is, drawn to fill a rectangle."""
    rows = [".".join(GLYPHS[letter][row] for letter in "FLAN") for row in range(7)]
    bitmap = torch.tensor([[cell == "#" for cell in row] for row in rows])
    column = ((u - left) / (right - left) * bitmap.shape[1]).floor().to(torch.int64)
    row = ((top - v) / (top - bottom) * bitmap.shape[0]).floor().to(torch.int64)
    inside = (column >= 0) & (column < bitmap.shape[1]) & (row >= 0) & (row < bitmap.shape[0])
    return inside & bitmap[row.clamp(0, bitmap.shape[0] - 1), column.clamp(0, bitmap.shape[1] - 1)]
