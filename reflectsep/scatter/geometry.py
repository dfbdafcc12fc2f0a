"""How far apart on the surface two pixels are, and how much light each takes in.

A distance that light has wandered is one along the surface, not in the picture. Crude normals are enough to tell it;
they come from the full pictures.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.data import PhotometricStack
from reflectsep.scatter.local import gaussian

STEEPEST = 0.3
"""Smallest N.V that is told apart."""
DIMMEST = 0.05
"""Smallest N.L of a pixel that is lit."""
SMOOTHING_PX = 1.5
"""Of slopes: a highlight bends the normals beside it."""
SLOWEST = 0.15
"""Frames a pixel below which a passage tells no distance."""
SHADED = 0.12
"""Values below this share of a pixel's brightest picture are taken for attached shadow."""
PIXELS_AT_ONCE = 1 << 16


def crude_normals(stack: PhotometricStack) -> Float[Tensor, "height width 3"] | None:
    """Unit normals of a Lambertian surface seen in the full pictures; None where the lights are unknown.

    Least squares over the lights that reach a pixel, the brightest left out where four or more remain: the highlight.
    """
    if stack.light_vectors is None:
        return None
    result = torch.zeros(*stack.mask.shape, 3)
    result[..., 2] = 1.0
    where = stack.mask.nonzero()
    for some in where.split(PIXELS_AT_ONCE):
        rows, columns = some.unbind(1)
        grey = torch.stack([picture[:, rows, columns].mean(0) for picture in stack.images], -1)
        result[rows, columns] = _normals(grey, stack.light_vectors.to(grey))
    return result


def _normals(grey: Float[Tensor, "pixels lights"], L: Float[Tensor, "lights 3"]) -> Float[Tensor, "pixels 3"]:
    """Of some pixels."""
    use = grey > SHADED * grey.amax(1, keepdim=True)
    if grey.shape[1] > 4:
        brightest = torch.nn.functional.one_hot(grey.argmax(1), grey.shape[1]).bool()
        use &= ~(brightest & (use.sum(1, keepdim=True) > 4))
    weight = use.to(grey)
    normal = torch.einsum("pl,li,lj->pij", weight, L, L) + 1e-4 * torch.eye(3)
    scaled = torch.linalg.solve(normal, torch.einsum("pl,li,pl->pi", weight, L, grey)[..., None])[..., 0]
    return torch.nn.functional.normalize(scaled, dim=-1)


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Shape of what is seen, under one light; flat, and evenly lit, where normals are not known."""

    slope_x: Float[Tensor, "height width"]
    slope_y: Float[Tensor, "height width"]
    """By how much it rises towards the camera from a pixel to the next, to the right and down."""
    facing: Float[Tensor, "height width"]
    """N.V."""
    light: Float[Tensor, "height width"]
    """Light that a pixel takes in: N.L times its area on the surface."""

    def pace(self, centre: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
        """Pixels along the surface that the slab moves in a frame."""
        down, across = torch.gradient(centre)
        a, b = self.slope_x, self.slope_y
        # |grad c| in the metric [[1 + a^2, a b], [a b, 1 + b^2]] of the surface.
        square = (1 + b * b) * across**2 - 2 * a * b * across * down + (1 + a * a) * down**2
        return (square / (1 + a * a + b * b)).clamp(min=SLOWEST**2).rsqrt()


def surface_under(
    normals: Float[Tensor, "height width 3"] | None,
    light: Float[Tensor, "3"] | None,
    mask: Bool[Tensor, "height width"],
) -> Surface:
    """The surface by crude normals (x right, y up, z to the camera), as a light reaches it."""
    flat, even = torch.zeros(mask.shape), torch.ones(mask.shape)
    if normals is None or light is None:
        return Surface(slope_x=flat, slope_y=flat, facing=even, light=even)
    z = normals[..., 2].clamp(min=STEEPEST)
    weight = mask.float()
    mass = gaussian(weight, SMOOTHING_PX).clamp(min=1e-6)

    def smooth(each: Tensor) -> Tensor:
        return gaussian(each * weight, SMOOTHING_PX) / mass

    return Surface(
        slope_x=smooth(-normals[..., 0] / z),
        slope_y=smooth(normals[..., 1] / z),
        facing=normals[..., 2].clamp(0, 1),
        light=smooth((normals @ light.float()).clamp(min=DIMMEST) / z),
    )
