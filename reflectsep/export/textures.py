"""Textures for a renderer that knows a diffuse colour, a highlight and a normal, and no more.

From the roots r_k = d_k + s_k under basis lights of unit vectors L_k, g with L_k . g = r_k: a Lambertian surface of
albedo |g| and normal g / |g|. The lobe's root is linear in the light, u(L) = h . L with L_k . h = a_k + B m_k: at most
|h|, which gives the highlight's peak. Around it u falls as the cosine of the angle to h. A power of it is a Phong lobe;
its exponent for the half-vector is about 4 n_s, to which a microfacet width of alpha = sqrt(2 / (4 n_s + 2)) belongs
(Walter, Marschner, Li and Torrance, 2007). A GGX lobe has alpha = 1 / sqrt(1 + n_s) itself (`model`). Renderers that
take a perceptual roughness use the square root of alpha (Burley, 2012).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.model import length, lobe, positive_power
from reflectsep.separation import Separation
from reflectsep.srgb import encoded


@dataclass(frozen=True, kw_only=True)
class Textures:
    """Linear, (channels, height, width), in units of the white of the result's pictures."""

    base_colour: Float[Tensor, "channels height width"]
    specular: Float[Tensor, "1 height width"]
    """Peak of the highlight."""
    normal: Float[Tensor, "3 height width"]
    """Unit vectors; (0, 0, 1) off the object."""
    scattering_colour: Float[Tensor, "channels height width"]
    """Scattered light of a pixel over its whole diffuse light, 0 to 1."""
    alpha: float
    """Width of the microfacet distribution."""
    n_s: float
    ggx: bool
    """Whether the lobe is that of GGX microfacets; else a Phong lobe."""
    view: Float[Tensor, "3"]

    @property
    def roughness(self) -> float:
        """Perceptual roughness."""
        return math.sqrt(self.alpha)


def textures_of(separation: Separation, *, white: float) -> Textures:
    """The textures of a result with known lights (check with `export.lights.mixes`)."""
    assert separation.light_vectors is not None
    unit = torch.nn.functional.normalize(separation.light_vectors[:3].double(), dim=1)
    intensity = float(separation.intensity.double().mean())
    mask = separation.mask
    root = (separation.d + separation.s).double()
    solve = torch.linalg.inv(unit)
    g = torch.einsum("ik,kchw->ichw", solve, root)
    grey = g.mean(1)
    normal = torch.nn.functional.normalize(grey, dim=0)
    normal = torch.where(mask, normal, torch.tensor([0.0, 0.0, 1.0], dtype=normal.dtype)[:, None, None])
    n_d = float(separation.n_d)
    albedo = positive_power((g * normal[:, None]).sum(0), n_d) * intensity / white
    h = length(separation.M.double(), separation.lobe_vector.double()).minimum(separation.ceiling.double())
    kinds = torch.bincount(separation.material[mask].long(), minlength=len(separation.materials))
    # One roughness for the whole: that of the largest material.
    n_s = float(separation.materials[kinds.argmax(), 1])
    whole = separation.diffuse.double().mean(0)
    share = separation.scattering.double().mean(0) / whole.clamp_min(1e-12)
    return Textures(
        base_colour=albedo * mask,
        specular=(lobe(h, h, separation.globals.n_s.double(), separation.ggx) * intensity / white * mask)[None],
        normal=normal,
        scattering_colour=torch.where(mask & (whole > 1e-6 * white), share, 0.0).clamp(0.0, 1.0),
        alpha=1.0 / math.sqrt(1.0 + n_s) if separation.ggx else math.sqrt(2.0 / (4.0 * n_s + 2.0)),
        n_s=n_s,
        ggx=separation.ggx,
        view=separation.view.double(),
    )


def rendered(textures: Textures, direction: Float[Tensor, "3"]) -> Float[Tensor, "channels height width"]:
    """Screen picture that a renderer with a Lambertian base and a Phong or GGX highlight makes of the textures."""
    N, V, L = textures.normal, textures.view[:, None, None], direction.double()[:, None, None]
    lambert = (N * L).sum(0).clamp_min(0.0)
    mirrored = 2.0 * (N * V).sum(0) * N - V
    cosine, n_s = (mirrored * L).sum(0), torch.tensor(textures.n_s, dtype=torch.float64)
    shine = lobe(cosine, torch.ones_like(cosine), n_s, textures.ggx) * (lambert > 0)
    return encoded(textures.base_colour * lambert + textures.specular * shine)


def note(textures: Textures, white: float, inside_db: float, all_db: float) -> str:
    """What the textures are, and what they cannot carry."""
    formula, highlight = "sqrt(2 / (4 n_s + 2))", "a Phong highlight of exponent n_s"
    if textures.ggx:
        formula, highlight = "1 / sqrt(1 + n_s)", "a GGX highlight of that alpha"
    return f"""Textures of a separated object

base_colour.exr/.png       albedo of the whole diffuse part (local and scattered): length of the Lambertian vector
                           fitted to the diffuse roots of the three basis lights
specular.exr/.png          peak of the highlight in the same unit; no Fresnel effect in it
normal.png                 normal of that Lambertian vector, x right, y up, z to the camera, 16 bits: (n + 1) / 2
scattering_colour.exr/.png share of the diffuse light that left the object elsewhere than it entered
roughness                  {textures.roughness:.4f}, one for the object, from n_s = {textures.n_s:.3f}:
                           alpha = {formula} = {textures.alpha:.4f}, roughness = sqrt(alpha)

EXR files are linear, 1 is white = {white:.6g} in the capture's units under a light of the basis lights' mean
intensity; PNG files are the same through the sRGB curve (specular and scattering share: linear), clipped at 1.

Rendered with a Lambertian base and {highlight} these textures are {inside_db:.1f} dB from the
relit pictures for lights between the basis lights, {all_db:.1f} dB for all lights fitted (8-bit screen values, peak 1).

What they cannot carry: cast shadows and inter-reflections are baked into the colour; the width of the scattering and
its soft shadow edges are lost (the share is a colour, not a distance); normals from scattered light are flattened;
the absolute reflectance is unknown, since no white reference was measured; grazing angles were not measured.
"""
