"""Simulated objects: a height field seen from straight above (orthographic, one pixel = one unit), and its materials.

    x = column - (width - 1) / 2,   y = (height - 1) / 2 - row,   z towards the camera

The presets are built from functions z(x, y); normals are their derivatives, not differences between pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from reflectsep.errors import SettingsError
from reflectsep.synth.kernels import Kernel

HeightFunction = Callable[[Tensor, Tensor], Tensor]

STEEPEST = 0.18
"""Smallest N.V of a patch: beyond it a pixel at the silhouette would stand for an arbitrarily large patch."""


@dataclass(frozen=True, kw_only=True)
class Material:
    """What a patch is made of; tuples have one value a channel."""

    name: str
    diffuse: tuple[float, ...]
    """Albedo of the light that leaves where it entered, 0..1."""
    diffuse_roughness_deg: float = 0.0
    """Oren-Nayar's sigma in degrees; 0 is Lambert."""
    scattering: tuple[float, ...]
    """Albedo of the light that wanders, 0..1; 0 is opaque."""
    kernels: tuple[Kernel, ...] = ()
    """How it wanders; may be empty where nothing does."""
    specular: float = 1.0
    """Factor on the microfacet lobe; 1 is a clean dielectric."""
    roughness: float = 0.2
    """GGX alpha."""
    ior: float = 1.45

    def __post_init__(self) -> None:
        """Refuse materials that make light."""
        for albedo, wander in zip(self.diffuse, self.scattering, strict=True):
            if not (albedo >= 0 and wander >= 0 and albedo + wander <= 1):
                raise SettingsError(
                    f"material {self.name}: diffuse {albedo} and scattering {wander}, expected both >= 0, sum <= 1"
                )
        if max(self.scattering) > 0 and len(self.kernels) != len(self.scattering):
            raise SettingsError(
                f"material {self.name}: {len(self.kernels)} kernels, expected {len(self.scattering)}: one a channel"
            )
        if not (self.specular >= 0 and 0 < self.roughness <= 1 and self.ior > 1 and self.diffuse_roughness_deg >= 0):
            raise SettingsError(
                f"material {self.name}: specular {self.specular}, roughness {self.roughness}, ior {self.ior}, "
                f"diffuse roughness {self.diffuse_roughness_deg}; expected >= 0, in (0, 1], > 1, >= 0"
            )


@dataclass(frozen=True, kw_only=True)
class SimulatedObject:
    """A height field with materials. Outside the mask there is nothing, and nothing casts a shadow from there."""

    name: str
    z: Float[Tensor, "height width"]
    """Height in pixels, float64; finite inside the mask."""
    mask: Bool[Tensor, "height width"]
    normals: Float[Tensor, "3 height width"]
    """Unit normals towards the camera; (0, 0, 1) outside the mask."""
    material: Int[Tensor, "height width"]
    """Index into `materials`; -1 outside the mask."""
    materials: tuple[Material, ...]
    tint: Float[Tensor, "channels height width"] | None = None
    """What both albedos of the material are multiplied by at a patch, 0..1; None is 1 everywhere."""

    def __post_init__(self) -> None:
        """Refuse an empty object, materials that do not agree, and numbers that are none."""
        if not bool(self.mask.any()):
            raise SettingsError(f"object {self.name}: its mask is empty, expected at least one pixel")
        if not bool(torch.isfinite(self.z[self.mask]).all() & torch.isfinite(self.normals).all()):
            raise SettingsError(f"object {self.name}: heights or normals are not finite inside the mask")
        if len({len(material.diffuse) for material in self.materials}) != 1:
            raise SettingsError(f"object {self.name}: its materials differ in their number of channels")
        inside = self.material[self.mask]
        if int(inside.min()) < 0 or int(inside.max()) >= len(self.materials):
            raise SettingsError(f"object {self.name}: a material index outside 0..{len(self.materials) - 1}")
        if self.tint is not None and not (bool((self.tint >= 0).all()) and bool((self.tint <= 1).all())):
            raise SettingsError(f"object {self.name}: a tint outside 0..1")

    @property
    def channels(self) -> int:
        """1 (grey) or 3 (red, green, blue)."""
        return len(self.materials[0].diffuse)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.z.shape[1], self.z.shape[0]

    @property
    def points(self) -> Float[Tensor, "patches 3"]:
        """Position (x, y, z) of every patch of the mask, in row order."""
        height, width = self.z.shape
        x, y = grid(width, height)
        return torch.stack([x[self.mask], y[self.mask], self.z[self.mask]], -1)

    @property
    def patch_normals(self) -> Float[Tensor, "patches 3"]:
        """Unit normal of every patch of the mask."""
        return self.normals[:, self.mask].mT

    @property
    def patch_material(self) -> Int[Tensor, "patches"]:
        """Material index of every patch of the mask."""
        return self.material[self.mask]

    def picture(self, patches: Float[Tensor, "channels patches"]) -> Float[Tensor, "channels height width"]:
        """Values of the patches at their pixels, 0 outside the mask."""
        picture = patches.new_zeros(patches.shape[0], self.mask.numel())
        picture[:, self._places] = patches
        return picture.view(-1, *self.mask.shape)

    @cached_property
    def _places(self) -> Int[Tensor, "patches"]:
        """Of the patches in the flattened picture: to write by number is several times faster than by mask."""
        return self.mask.flatten().nonzero()[:, 0]


def grid(width: int, height: int) -> tuple[Float[Tensor, "height width"], Float[Tensor, "height width"]]:
    """(x, y) of the pixel centres, float64; the picture's middle is (0, 0), row 0 the largest y."""
    x = torch.arange(width, dtype=torch.float64) - (width - 1) / 2
    y = (height - 1) / 2 - torch.arange(height, dtype=torch.float64)
    return x.expand(height, width).contiguous(), y[:, None].expand(height, width).contiguous()


def from_height(
    name: str,
    height: HeightFunction,
    *,
    size: tuple[int, int],
    materials: tuple[Material, ...],
    paint: Callable[[Tensor, Tensor], Tensor] | None = None,
    tint: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> SimulatedObject:
    """An object from its height function.

    Args:
        name: Name in the capture.
        height: z(x, y) in pixels, NaN where there is no object.
        size: (width, height) in pixels.
        materials: At least one.
        paint: Material index at (x, y); 0 everywhere without it.
        tint: Factor on the albedos at (x, y), (channels, height, width); 1 everywhere without it.

    Returns:
        The object. Patches steeper than N.V = `STEEPEST` are left out of the mask.

    Raises:
        SettingsError: nothing of the object is inside the picture, or the materials are impossible.
    """
    x, y = grid(*size)
    z = height(x, y)
    eps = 1e-3
    slope_x = (height(x + eps, y) - height(x - eps, y)) / (2 * eps)
    slope_y = (height(x, y + eps) - height(x, y - eps)) / (2 * eps)
    normals = torch.stack([-slope_x, -slope_y, torch.ones_like(z)])
    normals = normals / normals.norm(dim=0)
    mask = torch.isfinite(z) & torch.isfinite(normals).all(0) & (normals[2] > STEEPEST)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=z.dtype)[:, None, None]
    material = paint(x, y) if paint else torch.zeros_like(x, dtype=torch.int64)
    return SimulatedObject(
        name=name,
        z=torch.where(mask, z, 0.0),
        mask=mask,
        normals=torch.where(mask, normals, up),
        material=torch.where(mask, material, -1),
        materials=materials,
        tint=tint(x, y) if tint else None,
    )


def in_channels(material: Mapping[str, tuple[float, float, float]], channels: int) -> dict[str, tuple[float, ...]]:
    """Values given for red, green, blue as they are, or their mean for a grey object.

    Raises:
        SettingsError: `channels` is neither 1 nor 3.
    """
    if channels not in (1, 3):
        raise SettingsError(f"object: {channels} channels, expected 1 (grey) or 3 (red, green, blue)")
    return {key: value if channels == 3 else (sum(value) / 3,) for key, value in material.items()}
