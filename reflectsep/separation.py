"""The result: off-specular, local diffuse and scattering of an object, able to relight itself.

Parameters are for lights of unit intensity; a picture is its light's intensity times the model, because light adds
in radiance. Components, for basis light k of intensity t_k:

    off-specular    t_k F(a_k + B m_k)            local diffuse   t_k (d_k)_+ ^ n_d
    scattering      t_k (s_k)_+ ^ n_d             whole diffuse   t_k (q T(d_k + s_k)) ^ n_d

with F, T, q and m as in `reflectsep.model`. The whole diffuse is not quite the sum of its two parts: for n_d != 1 by
the power, and otherwise by what T adds at the edge of a shadow and takes at grazing angles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from reflectsep.data import Fit, PhotometricStack, Scattering
from reflectsep.errors import ResultError
from reflectsep.flags import count
from reflectsep.io.result import read_result, write_result
from reflectsep.model import Globals, length, lobe_of, lobe_vector, positive_power, reflectance
from reflectsep.room import cuts, empty, room_beside, stacked

COMPONENTS = ("specular", "local_diffuse", "scattering", "diffuse", "highlight_free")
LAYERS = (*(f"{name}.exr" for name in COMPONENTS), "residual.exr", "parameters.exr")
MAPS = (*COMPONENTS, "mask", "flags", "material", "d", "s", "B", "d_sd", "s_sd", "B_sd", "residual")
PIXELS_AT_ONCE = 1 << 18
"""Of which components are made."""
PEAK_FACTOR = 2.0
"""The same factor on the brightest highlight seen is what a fit believes of the lobe's peak."""
GREY, COLOUR = ("Y",), ("R", "G", "B")


@dataclass(frozen=True, kw_only=True)
class Separation:
    """Parameters and components of a separated object; everything is zero outside `mask`."""

    names: tuple[str, ...]
    """Lights of the fit, the basis first."""
    alpha: Float[Tensor, "lights 3"]
    light_vectors: Float[Tensor, "lights 3"] | None
    """Direction times intensity; None where unknown, then only alpha relights."""
    view: Float[Tensor, "3"]
    mask: Bool[Tensor, "height width"]
    flags: Int[Tensor, "height width"]
    a: Float[Tensor, "3"]
    n_s: Float[Tensor, ""]
    n_d: Float[Tensor, ""]
    f: Float[Tensor, ""]
    """Share of the scattered light that has forgotten the normal: the lobe turns with d + (1 - f) s."""
    softness: Float[Tensor, ""]
    fresnel: Float[Tensor, ""]
    ggx: bool
    """Whether the lobe is that of GGX microfacets; else the paper's power."""
    materials: Float[Tensor, "K 2"]
    """Of every material: C_1 over that of the first, and n_s; a and n_s are those of the first."""
    material: Int[Tensor, "height width"]
    """Which material a pixel is of, from 0."""
    d: Float[Tensor, "3 channels height width"]
    s: Float[Tensor, "3 channels height width"]
    B: Float[Tensor, "height width"]
    d_sd: Float[Tensor, "3 channels height width"]
    s_sd: Float[Tensor, "3 channels height width"]
    B_sd: Float[Tensor, "height width"]
    specular: Float[Tensor, "3 channels height width"]
    local_diffuse: Float[Tensor, "3 channels height width"]
    scattering: Float[Tensor, "3 channels height width"]
    diffuse: Float[Tensor, "3 channels height width"]
    """Whole diffuse of the basis lights: the picture without its highlight, by the model."""
    highlight_free: Float[Tensor, "3 channels height width"]
    """Picture minus specular: keeps what the model does not explain; the whole diffuse where the picture is clipped."""
    residual: Float[Tensor, "lights channels height width"]
    ceilings: Float[Tensor, "K"] = field(default_factory=lambda: torch.tensor([math.inf]))
    """Of every material, the largest |w| of a lobe when relighting: of a highlight `PEAK_FACTOR` times as high as those
    of most pixels. Where no picture saw the highlight, nothing else bounds it."""
    document: Mapping[str, Any]
    """What `separation.json` says beside the globals: settings, versions, timings, statistics."""

    @property
    def basis(self) -> tuple[str, ...]:
        """Names of the basis lights."""
        return self.names[:3]

    @property
    def intensity(self) -> Float[Tensor, "3"]:
        """Of the basis lights; ones where the lights are unknown."""
        if self.light_vectors is None:
            return torch.ones(3, dtype=self.d.dtype)
        return self.light_vectors[:3].norm(dim=-1)

    @property
    def globals(self) -> Globals:
        """The shared parameters as the model takes them."""
        n_d = 1.0 if float(self.n_d) == 1.0 else self.n_d
        a, n_s = self.a, self.n_s
        if len(self.materials) > 1:
            scale, exponents = self.materials.T
            a, n_s = a[:, None, None] * scale[self.material.long()], exponents[self.material.long()]
        return Globals(
            a=a,
            n_s=n_s,
            n_d=n_d,
            f=self.f,
            softness=self.softness,
            fresnel=self.fresnel,
            ggx=self.ggx,
            M=self.M,
        )

    @property
    def ceiling(self) -> Tensor:
        """Largest |w| of a lobe when relighting; of every pixel where there are several materials."""
        return self.ceilings[0] if len(self.ceilings) == 1 else self.ceilings[self.material.long()]

    @property
    def M(self) -> Float[Tensor, "3 3"]:  # noqa: N802  (the symbol of `reflectsep.model`)
        """Inverse of the basis lights' directions; the identity where they are unknown."""
        if self.light_vectors is None:
            return torch.eye(3, dtype=self.d.dtype)
        basis = self.light_vectors[:3].double()
        return torch.linalg.inv(basis / basis.norm(dim=-1, keepdim=True)).to(self.d.dtype)

    @property
    def lobe_vector(self) -> Float[Tensor, "3 height width"]:
        """A + B m of every pixel: the lobe's argument under the basis lights, zero outside the mask."""
        return lobe_vector(self.d, self.s, self.B, self.globals) * self.mask

    def relight(self, alpha: Float[Tensor, "*lights 3"]) -> Float[Tensor, "*lights channels height width"]:
        """Pictures under lights sum_k alpha_k L_k (Eqs. 15 and 21), linear, in the capture's units.

        Batched and differentiable in alpha. Where the light vectors are known, the length of the mixed vector is the
        light's intensity and scales the picture, so that `relight(2 * alpha) == 2 * relight(alpha)`; where they are
        unknown, alpha enters Eq. 21 as it stands. No lobe goes beyond `ceiling`. Memory grows with the
        number of lights; loop over many.

        Raises:
            ValueError: alpha does not end in three numbers, or is not finite.
        """
        alpha = torch.as_tensor(alpha)  # a list or an array will do
        if alpha.shape[-1:] != (3,):
            raise ValueError(f"alpha has shape {tuple(alpha.shape)}, expected (..., 3)")
        if not bool(alpha.isfinite().all()):
            raise ValueError("alpha is not finite")
        lead = alpha.shape[:-1]
        unit, intensity = self.unit_mix(alpha.reshape(-1, 3).to(self.d))
        pictures = reflectance(self.d, self.B, self.globals, s=self.s, alpha=unit, ceiling=self.ceiling)
        pictures = pictures * intensity[:, None, None, None] * self.mask
        return pictures.reshape(*lead, *pictures.shape[1:])

    def rows(self, rows: slice) -> Separation:
        """The same of some of the picture's rows; it shares their memory."""
        maps = {name: value[..., rows, :] for name, value in vars(self).items() if name in MAPS}
        return replace(self, **maps)

    def unit_mix(self, alpha: Float[Tensor, "lights 3"]) -> tuple[Float[Tensor, "lights 3"], Float[Tensor, "lights"]]:
        """Alpha among basis lights of unit intensity for a light of unit intensity, and the light's intensity."""
        if self.light_vectors is None:
            return alpha, torch.ones_like(alpha[:, 0])
        vector = alpha @ self.light_vectors[:3]
        # A light of no intensity has no direction; any finite one gives the black picture.
        length = (vector.square().sum(-1) + torch.finfo(alpha.dtype).tiny).sqrt()
        return alpha * self.intensity / length.clamp_min(1e-12)[:, None], length

    def save(self, out: Path | str, *, overwrite: bool = False, previews: Mapping[str, Tensor] | None = None) -> None:
        """Write the result folder, whole or not at all.

        Raises:
            ResultError: `out` exists and `overwrite` is false, or it is no result.
        """
        channels = GREY if self.d.shape[1] == 1 else COLOUR
        layers: dict[str, Mapping[str, np.ndarray]] = {}
        for name in COMPONENTS:
            layers[f"{name}.exr"] = picture_channels(self.basis, getattr(self, name), channels)
        layers["residual.exr"] = picture_channels(self.names, self.residual, channels)
        layers["parameters.exr"] = self._parameters(channels)
        write_result(out, layers, self._document(), overwrite, previews)

    def _repr_html_(self) -> str:
        return import_module("reflectsep.notebook").separation_html(self)

    def plot(self) -> Any:
        """Components of the basis lights as a matplotlib figure, for a notebook."""
        return import_module("reflectsep.notebook").separation_plot(self)

    def _parameters(self, channels: tuple[str, ...]) -> dict[str, np.ndarray]:
        ranks = ("1", "2", "3")
        planes: dict[str, np.ndarray] = {}
        for prefix, stack in (("d", self.d), ("s", self.s), ("d_sd", self.d_sd), ("s_sd", self.s_sd)):
            stem, tail = prefix.partition("_")[0], prefix.partition("_")[1] + prefix.partition("_")[2]
            planes |= picture_channels(tuple(f"{stem}{k}{tail}" for k in ranks), stack, channels)
        planes["B"], planes["B_sd"] = self.B.numpy(), self.B_sd.numpy()
        planes["flags"] = self.flags.numpy().astype(np.uint32)
        planes["material"] = self.material.numpy().astype(np.uint32)
        planes["mask"] = self.mask.numpy().astype(np.uint32)
        return planes

    def _document(self) -> dict[str, Any]:
        vectors = self.light_vectors
        lights: dict[str, Any] = {}
        for i, name in enumerate(self.names):
            lights[name] = {"alpha": self.alpha[i].tolist()}
            if vectors is not None:
                lights[name]["vector"] = vectors[i].tolist()
        shared = {name: getattr(self, name).tolist() for name in ("a", "n_s", "n_d", "f", "softness", "fresnel")}
        shared["lobe"] = "ggx" if self.ggx else "power"
        shared["materials"] = self.materials.tolist()
        shared |= {"ceilings": self.ceilings.tolist()} if bool(self.ceilings.isfinite().all()) else {}
        return {
            **self.document,
            "basis": list(self.basis),
            "lights": lights,
            "view": self.view.tolist(),
            "globals": shared,
            "flags": count(self.flags),
        }


def picture_channels(names: tuple[str, ...], stack: Tensor, channels: tuple[str, ...]) -> dict[str, np.ndarray]:
    """`stack` (names, channels, height, width) as planes `NAME.R` or `NAME.Y`."""
    return {
        f"{name}.{c}": np.ascontiguousarray(stack[i, j].detach().cpu().numpy(), np.float32)
        for i, name in enumerate(names)
        for j, c in enumerate(channels)
    }


def separate(
    stack: PhotometricStack, scattering: Scattering | None, fit: Fit, document: Mapping[str, Any]
) -> Separation:
    """Components of every basis light from the fitted parameters."""
    nothing = fit.d.new_zeros(()).expand_as(fit.d)  # in the memory of one value
    s_sd = nothing
    if scattering is not None and scattering.root_sd is not None:
        s_sd = stacked((picture.float() * stack.mask for picture in scattering.root_sd[:3]), 3)
    alpha, vectors = stack.alpha.float(), None if stack.light_vectors is None else stack.light_vectors.float()
    if fit.alpha is not None:
        alpha = fit.alpha
        vectors = None if vectors is None else torch.cat([vectors[:3], alpha[3:] @ vectors[:3]])
    separation = Separation(
        names=stack.names,
        alpha=alpha,
        light_vectors=vectors,
        view=stack.view.float(),
        mask=stack.mask,
        flags=fit.flags,
        a=fit.a,
        n_s=fit.n_s,
        n_d=fit.n_d,
        f=fit.f,
        softness=fit.softness,
        fresnel=fit.fresnel,
        ggx=fit.ggx,
        materials=fit.materials,
        material=fit.material,
        d=fit.d,
        s=fit.s[:3],
        B=fit.B,
        d_sd=fit.d_sd,
        s_sd=s_sd,
        B_sd=fit.B_sd,
        specular=nothing,
        local_diffuse=nothing,
        scattering=nothing,
        diffuse=nothing,
        highlight_free=nothing,
        residual=fit.residual,
        document=document,
    )
    intensity_root = fit.intensity[:3, None, None, None] ** (1.0 / float(fit.n_d))

    def measured(rows: slice) -> Tensor:
        if scattering is None:
            return separation.s[:, :, rows]
        return scattering.root[:3, :, rows].float() / intensity_root

    return with_components(replace(separation, ceilings=lobe_ceilings(separation)), stack, measured)


def lobe_ceilings(separation: Separation) -> Float[Tensor, "K"]:
    """`Separation.ceilings`: from the 99 % quantile of |w|, so that a few wrong pixels do not set it."""
    sizes, kinds = [], []
    step = max(1, separation.mask.numel() >> 20)
    for rows in bands(separation.mask):
        part = separation.rows(rows)
        sizes.append(length(part.M, part.lobe_vector)[part.mask][::step])
        kinds.append(part.material[part.mask][::step])
    size, kind = torch.cat(sizes), torch.cat(kinds)
    result = torch.full((len(separation.materials),), math.inf)
    for k, n_s in enumerate(separation.materials[:, 1]):
        found = size[kind == k]
        if len(found):
            high = found.kthvalue(max(1, int(0.99 * len(found)))).values
            result[k] = PEAK_FACTOR ** (1.0 / n_s) * high
    return result


def bands(mask: Bool[Tensor, "height width"]) -> Iterator[slice]:
    """Rows of a picture, about `PIXELS_AT_ONCE` at a time."""
    height, width = mask.shape
    return cuts(height, max(1, PIXELS_AT_ONCE // width))


def with_components(separation: Separation, stack: PhotometricStack, measured: Callable[[slice], Tensor]) -> Separation:
    """`separation` with its components filled in; `measured` gives rows of s_k as the sweeps had it."""
    found = {name: empty(*separation.d.shape, dtype=separation.d.dtype) for name in COMPONENTS}
    for band_rows in bands(separation.mask):
        for name, values in _components(separation, stack, measured(band_rows), band_rows).items():
            found[name][..., band_rows, :] = values
    return replace(separation, **found)


def _components(separation: Separation, stack: PhotometricStack, measured: Tensor, rows: slice) -> dict[str, Tensor]:
    """Components of some of the picture's rows."""
    part = separation.rows(rows)
    t = part.intensity[:, None, None, None]
    shine = lobe_of(lobe_vector(part.d, part.s, part.B, part.globals), part.globals, torch.eye(3), part.ceiling)
    specular = (t * shine[:, None] * part.mask).expand_as(part.d)
    diffuse = part.relight(torch.eye(3)) - specular
    pictures = stack.images[:3, :, rows]
    unknown = stack.saturated[:3, :, rows] | ~pictures.isfinite() | ~part.mask
    return {
        "specular": specular,
        "local_diffuse": t * positive_power(part.d, part.n_d),
        "scattering": t * positive_power(measured, part.n_d) * part.mask,
        "diffuse": diffuse,
        "highlight_free": torch.where(unknown, diffuse, pictures.float() - specular),
    }


def extensions(separation: Separation | Fit) -> str:
    """What a result has beyond the paper's formula, in a sentence; empty where it has nothing."""
    f, e, k = float(separation.f), float(separation.softness), float(separation.fresnel)
    rough = ", ".join(f"{1.0 / math.sqrt(1.0 + n_s):.2f}" for n_s in separation.materials[:, 1].tolist())
    count = len(separation.materials)
    kinds = f"{count} materials, " if count > 1 else ""
    parts = [f"{kinds}GGX lobe of roughness {rough}"] if separation.ggx else []
    parts += [f"the lobe turns with d + {1 - f:.2f} s"] if f < 1 else []
    parts += [f"shadow edges soft by {e:.2f} of the cosine"] if e > 0.02 else []
    parts += [f"{100 * k:.0f} % of Fresnel's losses in the body"] if k > 0 else []
    return "; ".join(parts)


def load(folder: Path | str) -> Separation:
    """Read a result folder back, tensors bit for bit.

    Raises:
        ResultError: not a result, another format, a damaged or missing file, or an inconsistent document.
    """
    folder = Path(folder)
    _, document = read_result(folder, ())
    try:
        with room_beside(folder):
            return from_layers(folder, document)
    except (KeyError, TypeError, ValueError) as error:
        raise ResultError(
            f"{folder}: separation.json and the EXR layers do not belong together ({type(error).__name__}: {error})"
        ) from error


def from_layers(folder: Path, document: Mapping[str, Any]) -> Separation:
    """A separation from its document and its layers, of which one file is in memory at a time."""
    layers = {name: partial(_layer, folder, name) for name in LAYERS}
    lights = document["lights"]
    basis = tuple(document["basis"])
    names = (*basis, *(name for name in lights if name not in basis))
    parameters = layers["parameters.exr"]()
    channels = GREY if "d1.Y" in parameters else COLOUR

    def stack(planes: Mapping[str, np.ndarray], rows: tuple[str, ...]) -> Tensor:
        part = lambda row: torch.stack([torch.from_numpy(planes[f"{row}.{c}"]) for c in channels])  # noqa: E731
        return stacked((part(row) for row in rows), len(rows))

    maps = {
        name: stack(parameters, tuple(f"{name[0]}{k}{name[1:]}" for k in "123")) for name in ("d", "s", "d_sd", "s_sd")
    }
    maps |= {name: torch.from_numpy(parameters[name].astype(np.float32)) for name in ("B", "B_sd")}
    maps["mask"] = torch.from_numpy(parameters["mask"].astype(np.int64)) > 0
    maps["flags"] = torch.from_numpy(parameters["flags"].astype(np.int32))
    maps["material"] = torch.from_numpy(parameters["material"].astype(np.int32))
    del parameters
    maps |= {name: stack(layers[f"{name}.exr"](), basis) for name in COMPONENTS}
    maps["residual"] = stack(layers["residual.exr"](), names)
    vectors = [lights[name].get("vector") for name in names]
    given = dict(document["globals"])
    ggx = {"ggx": True, "power": False}[given.pop("lobe")]
    shared = {key: torch.tensor(given[key], dtype=torch.float32) for key in given}
    if any(not math.isfinite(v) for tensor in shared.values() for v in tensor.flatten().tolist()):
        raise ValueError("a global is not finite")
    ours = {"format", "checksums", "basis", "lights", "view", "globals", "flags"}
    return Separation(
        names=names,
        alpha=torch.tensor([lights[name]["alpha"] for name in names], dtype=torch.float32),
        light_vectors=None if None in vectors else torch.tensor(vectors, dtype=torch.float32),
        view=torch.tensor(document["view"], dtype=torch.float32),
        **shared,
        ggx=ggx,
        **maps,
        document={key: value for key, value in document.items() if key not in ours},
    )


def _layer(folder: Path, name: str) -> dict[str, np.ndarray]:
    """Planes of one file of a result."""
    return read_result(folder, (name,))[0][name]
