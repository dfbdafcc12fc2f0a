"""Light on a patch and straight off it: shadows, irradiance, local diffuse and off-specular reflection.

One unit of intensity is a directional light whose irradiance on a patch that faces it is pi: a white Lambertian patch
there has radiance 1. All of it in float64.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as nnf
from jaxtyping import Float
from torch import Tensor

from reflectsep.synth.objects import SimulatedObject

VIEW = (0.0, 0.0, 1.0)
SHADOW_STEP_PX = 0.5
PENUMBRA_PX = 0.5
"""Overhang at which a shadow is full; softens its edge to about a pixel."""
PRUNING = 8
"""Samples along a ray after which rays that have left the object are dropped."""


def fresnel(cosine: Float[Tensor, "*p"], ior: Float[Tensor, "*p"]) -> Float[Tensor, "*p"]:
    """Schlick's reflectance of a dielectric at an angle of incidence, 0..1."""
    facing = ((ior - 1) / (ior + 1)).square()
    return facing + (1 - facing) * (1 - cosine.clamp(0, 1)) ** 5


def visibility(
    obj: SimulatedObject, light: Float[Tensor, "3"], step_px: float = SHADOW_STEP_PX
) -> Float[Tensor, "patches"]:
    """How much of a directional light reaches every patch: 1 free, 0 in the shadow of another part of the object.

    The height field is followed towards the light until it is left behind; a patch is shadowed where the surface
    stands above the ray. Patches that face away (N.L <= 0) are 0.

    Args:
        obj: The object.
        light: Unit vector towards the light.
        step_px: Distance between samples along the ray, in the picture plane.
    """
    points, facing = obj.points, obj.patch_normals @ light > 0
    free = facing.to(torch.float64)
    slant = float(light[:2].norm())
    if slant > 1e-9 and float(light[2]) > 0:
        rise = float(light[2]) / slant
        heights = obj.z[obj.mask]
        floor = heights.min()
        # What is outside the object has no height: a floor there keeps the interpolation finite and casts nothing.
        field = torch.where(obj.mask, obj.z, floor)[None, None]
        reach = min(float(heights.max() - floor) / rise, math.hypot(*obj.size)) + step_px
        towards = light[:2] / slant
        below = facing.nonzero()[:, 0]
        for sample in range(2, int(reach / step_px) + 2):
            away = sample * step_px
            if sample % PRUNING == 0:  # a ray above the highest point meets nothing any more
                below = below[points[below, 2] + away * rise < heights.max()]
            here = points[below]
            overhang = _sampled(field, here[:, :2] + away * towards) - (here[:, 2] + away * rise)
            free[below] = torch.minimum(free[below], 1 - (overhang / PENUMBRA_PX).clamp(0, 1))
    return free


def irradiance(obj: SimulatedObject, light: Float[Tensor, "3"]) -> Float[Tensor, "patches"]:
    """Irradiance of every patch under a light of intensity 1: pi (N.L)_+ visibility."""
    return math.pi * (obj.patch_normals @ light).clamp_min(0) * visibility(obj, light)


def local_diffuse(obj: SimulatedObject, light: Float[Tensor, "3"]) -> Float[Tensor, "channels patches"]:
    """Radiance towards the camera, per unit irradiance, of light that leaves where it entered (Oren & Nayar 1994).

    Fresnel takes its part on the way in and on the way out.
    """
    normals = obj.patch_normals
    cos_in, cos_out = (normals @ light).clamp(1e-6, 1), normals[:, 2].clamp(1e-6, 1)
    albedo = albedo_of(obj, [material.diffuse for material in obj.materials])
    sigma = per_patch(obj, [math.radians(material.diffuse_roughness_deg) for material in obj.materials]).square()
    ior = per_patch(obj, [material.ior for material in obj.materials])
    a, b = 1 - 0.5 * sigma / (sigma + 0.33), 0.45 * sigma / (sigma + 0.09)
    view = normals.new_tensor(VIEW)
    in_plane, out_plane = light - cos_in[:, None] * normals, view - cos_out[:, None] * normals
    azimuth = nnf.cosine_similarity(in_plane, out_plane, dim=-1, eps=1e-9).clamp_min(0)
    angle_in, angle_out = cos_in.acos(), cos_out.acos()
    lobe = a + b * azimuth * torch.maximum(angle_in, angle_out).sin() * torch.minimum(angle_in, angle_out).tan()
    return albedo * lobe * (1 - fresnel(cos_in, ior)) * (1 - fresnel(cos_out, ior)) / math.pi


def specular(obj: SimulatedObject, light: Float[Tensor, "3"]) -> Float[Tensor, "patches"]:
    """Radiance towards the camera, per unit irradiance, off the boundary: GGX, Smith, Schlick. White.

    f = D(h) G(l, v) F(l.h) / (4 N.L N.V), with Walter et al.'s (2007) D and separable G.
    """
    normals = obj.patch_normals
    view = normals.new_tensor(VIEW)
    half = (light + view) / (light + view).norm()
    alpha = per_patch(obj, [material.roughness for material in obj.materials]).square()
    ior = per_patch(obj, [material.ior for material in obj.materials])
    strength = per_patch(obj, [material.specular for material in obj.materials])
    cos_in, cos_out = (normals @ light).clamp(1e-6, 1), normals[:, 2].clamp(1e-6, 1)
    cos_half = (normals @ half).clamp(0, 1).square()
    density = alpha / (math.pi * (cos_half * (alpha - 1) + 1).square())

    def smith(cosine: Tensor) -> Tensor:
        return 2 * cosine / (cosine + (alpha + (1 - alpha) * cosine.square()).sqrt())

    bounced = fresnel((light @ half).expand_as(ior), ior)
    return strength * density * smith(cos_in) * smith(cos_out) * bounced / (4 * cos_in * cos_out)


def per_patch(obj: SimulatedObject, values: list[float] | list[tuple[float, ...]]) -> Float[Tensor, "patches ..."]:
    """Values given by material, at every patch."""
    return torch.tensor(values, dtype=torch.float64)[obj.patch_material]


def albedo_of(obj: SimulatedObject, albedos: list[tuple[float, ...]]) -> Float[Tensor, "channels patches"]:
    """Albedos given by material, at every patch, times the object's tint there."""
    plain = per_patch(obj, albedos).mT.contiguous()
    return plain if obj.tint is None else plain * obj.tint[:, obj.mask]


def _sampled(field: Float[Tensor, "1 1 height width"], xy: Float[Tensor, "patches 2"]) -> Float[Tensor, "patches"]:
    """Bilinear height at (x, y); the edge is repeated beyond the picture."""
    height, width = field.shape[-2:]
    scaled = xy * xy.new_tensor([2 / width, -2 / height])
    grid = scaled[None, None]
    return nnf.grid_sample(field, grid, mode="bilinear", padding_mode="border", align_corners=False)[0, 0, 0]
