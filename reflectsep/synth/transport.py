"""Subsurface transport between the patches of an object: a linear operator from irradiance to radiance.

    L(j) = t_j / pi sum_i K(i, j) t_i A_i E_i,     K(i, j) = sqrt(rho_i rho_j) sqrt(R_i(r_ij) R_j(r_ij)),   i != j

E irradiance, A = 1 / N.V the area of a patch, t_out = 1 - F(N.V) on the way out, t_in = 1 - F(N.L) on the way in (it
belongs to the light, and is applied by `transmitted`), rho the material's scattering albedo, R its kernel, r the chord
between the patches. K is symmetric (reciprocity), also across materials. Light that leaves within the patch it entered
is none of this operator's: `self_share` gives it, and it counts as local.

"Beyond N pixels" weighs each pair by clamp(r - N + 1/2, 0, 1): the share of two pixel footprints that far apart that is
more than N apart, roughly; a hard threshold would jump between a flat and a slightly tilted part of the surface.

For many patches the chord gives way to the distance in the picture plane, and the sum to an FFT; K is then balanced by
sqrt(N.V_i N.V_j), so that a slope, whose patches are larger, scatters no more light than a flat part does. Light then
spreads 1 / N.V too far down a slope; symmetry, linearity and the energy bound are kept.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from reflectsep.io.ahead import in_order, lead_for
from reflectsep.synth.kernels import Kernel
from reflectsep.synth.objects import SimulatedObject
from reflectsep.synth.shading import albedo_of, fresnel, per_patch

MOST_CHORD_PATCHES = 12_000
BLOCK_ELEMENTS = 4_000_000
"""Pairs of patches held at a time: 32 MB an array."""
OWN_RADIUS_PX = 1 / math.sqrt(math.pi)
"""A disc of a pixel's area: where light leaves the patch that it entered."""
TAIL = 9.0
"""FFT padding in lengths of the longest kernel; exp(-9) of it comes round."""

Done = Callable[[int, int], None]


@dataclass(frozen=True, kw_only=True)
class _Plane:
    """A convolution in the picture plane, over the object's bounding box."""

    box: tuple[int, int]
    size: tuple[int, int]
    """Of the FFT."""
    places: list[Int[Tensor, "members"]]
    """Of each group's patches in the flattened box."""
    entering: list[Float[Tensor, "channels members"]]
    """Of each group: what irradiance is multiplied by on its way in, and what comes out on its way out."""
    leaving: list[Float[Tensor, "channels members"]]
    spectra: list[list[Tensor]]
    """[target group][source group], (channels, height, half the width)."""


@dataclass(frozen=True, kw_only=True)
class Transport:
    """The operator of one object."""

    obj: SimulatedObject
    distance: Literal["chord", "plane"]
    points: Float[Tensor, "patches 3"] = field(repr=False)
    area: Float[Tensor, "patches"] = field(repr=False)
    """1 / N.V, pixels^2."""
    out: Float[Tensor, "patches"] = field(repr=False)
    """Transmission towards the camera, over pi."""
    members: tuple[Int[Tensor, "members"], ...] = field(repr=False)
    """Patches of each group of materials that share their kernels."""
    kernels: tuple[tuple[Kernel, ...], ...]
    """Per group, per channel."""
    albedo: Float[Tensor, "channels patches"] = field(repr=False)

    def spread(
        self, irradiance: Float[Tensor, "patches columns"], beyond_px: float = 0.0, done: Done | None = None
    ) -> Float[Tensor, "channels patches columns"]:
        """Radiance that leaves towards the camera after wandering more than `beyond_px` pixels.

        Args:
            irradiance: Transmitted irradiance of every patch, one column a light or slab frame.
            beyond_px: Least distance in pixels; 0 is everything that leaves another patch than it entered.
            done: Told (blocks done, blocks in all).

        Returns:
            Radiance, as exact as `irradiance`: float64, or by FFT float32 (24 bits of the brightest) at half the time;
            0 everywhere for an opaque object.
        """
        count, columns = irradiance.shape
        # Each column in one piece: they are written, and read, one at a time.
        result = irradiance.new_zeros(self.albedo.shape[0], columns, count).mT
        steps = list(self._steps(irradiance, beyond_px))
        # Each writes values of its own, so threads may share them.
        for index, _ in enumerate(in_order(lambda step: step(result), steps, lead_for(self._step_bytes))):
            if done:
                done(index + 1, len(steps))
        return result

    @property
    def _step_bytes(self) -> int:
        """Memory that a step takes, roughly."""
        if self.distance == "chord":
            return 3 * 8 * BLOCK_ELEMENTS
        return 3 * 8 * len(self.albedo) * 4 * self.obj.mask.numel()

    def self_share(self) -> Float[Tensor, "channels patches"]:
        """Share of the light that enters a patch and leaves that same patch, albedo included, 0..1."""
        share = torch.zeros_like(self.albedo)
        for group, kernels in zip(self.members, self.kernels, strict=True):
            for channel, kernel in enumerate(kernels):
                share[channel, group] = self.albedo[channel, group] * kernel.within(OWN_RADIUS_PX)
        return share

    def _steps(self, columns: Tensor, beyond_px: float) -> Iterator[Callable[[Tensor], None]]:
        """Parts of the work, each adding its own to the result."""
        if self.distance == "plane" and self.members:
            plane = self._plane(columns.dtype, beyond_px)
            for column in range(columns.shape[1]):
                yield lambda result, at=column: self._add_convolved(result[..., at], columns[:, at], plane)
            return
        for target, to_group in enumerate(self.members):
            rows = max(1, BLOCK_ELEMENTS // max(1, len(self.points)))
            for block in to_group.split(rows):
                yield lambda result, b=block, t=target: self._add_block(result, columns, b, t, beyond_px)

    def _add_block(self, result: Tensor, columns: Tensor, block: Tensor, target: int, beyond_px: float) -> None:
        """Light from every patch to the patches of `block`, all of group `target`, by their chords."""
        for source, group in enumerate(self.members):
            r = torch.cdist(self.points[block], self.points[group], compute_mode="donot_use_mm_for_euclid_dist")
            if beyond_px > 0:
                share = (r - (beyond_px - 0.5)).clamp_(0, 1)
            else:
                share = (block[:, None] != group[None]).to(r.dtype)
            for channel, (ours, theirs) in enumerate(zip(self.kernels[target], self.kernels[source], strict=True)):
                kernel = ours(r) if ours == theirs else (ours(r) * theirs(r)).sqrt_()
                weight = (self.albedo[channel, group].sqrt() * self.area[group])[:, None]
                gain = (self.albedo[channel, block].sqrt() * self.out[block])[:, None]
                result[channel, block] += gain * (kernel.mul_(share) @ (weight * columns[group]))

    def _plane(self, dtype: torch.dtype, beyond_px: float) -> _Plane:
        """What every column's convolution needs, over the object's bounding box."""
        rows, columns = self.obj.mask.nonzero().mT
        top, left = int(rows.min()), int(columns.min())
        box = (int(rows.max()) - top + 1, int(columns.max()) - left + 1)
        root, balance = self.albedo.sqrt(), self.area.rsqrt()
        return _Plane(
            box=box,
            size=_padded(box, self.kernels),
            places=[((rows - top) * box[1] + columns - left)[group] for group in self.members],
            entering=[(root * self.area * balance)[:, group].to(dtype) for group in self.members],
            leaving=[(root * balance * self.out)[:, group].to(dtype) for group in self.members],
            spectra=_spectra(_padded(box, self.kernels), self.kernels, beyond_px, dtype),
        )

    def _add_convolved(self, result: Tensor, irradiance: Tensor, plane: _Plane) -> None:
        """One column, (channels, patches) += (patches), by FFT in the picture plane."""
        height, width = plane.box
        fields = []
        for group, places, weight in zip(self.members, plane.places, plane.entering, strict=True):
            field_of = weight.new_zeros(len(weight), height * width)
            field_of[:, places] = weight * irradiance[group]
            fields.append(torch.fft.rfft2(field_of.view(-1, height, width), s=plane.size))
        for target, group in enumerate(self.members):
            total = fields[0] * plane.spectra[target][0]
            for source in range(1, len(fields)):
                total = total.addcmul_(fields[source], plane.spectra[target][source])
            leaving = torch.fft.irfft2(total, s=plane.size)[:, :height, :width].flatten(1)
            result[:, group] += plane.leaving[target] * leaving[:, plane.places[target]]


def transport(obj: SimulatedObject, distance: Literal["chord", "plane"] | None = None) -> Transport:
    """The operator of an object.

    Args:
        obj: The object.
        distance: `chord` is explicit between patches, time and not memory growing with their square; `plane` is the
            FFT approximation; by default `chord` up to 12000 patches.
    """
    material = obj.patch_material
    groups: dict[tuple[Kernel, ...], list[int]] = {}
    for index, made_of in enumerate(obj.materials):
        if max(made_of.scattering) > 0:
            groups.setdefault(made_of.kernels, []).append(index)
    members = {kernels: torch.isin(material, torch.tensor(indices)) for kernels, indices in groups.items()}
    cosine = obj.patch_normals[:, 2]
    ior = per_patch(obj, [made_of.ior for made_of in obj.materials])
    chosen = distance or ("chord" if len(material) <= MOST_CHORD_PATCHES else "plane")
    return Transport(
        obj=obj,
        distance=chosen,
        points=obj.points,
        area=1 / cosine,
        out=(1 - fresnel(cosine, ior)) / math.pi,
        members=tuple(_indices(here) for here in members.values() if bool(here.any())),
        kernels=tuple(kernels for kernels, here in members.items() if bool(here.any())),
        albedo=albedo_of(obj, [made_of.scattering for made_of in obj.materials]),
    )


def transmitted(
    obj: SimulatedObject, light: Float[Tensor, "3"], irradiance: Float[Tensor, "patches"]
) -> Float[Tensor, "patches"]:
    """Irradiance below the boundary: (1 - F(N.L)) E."""
    ior = per_patch(obj, [material.ior for material in obj.materials])
    return (1 - fresnel((obj.patch_normals @ light).clamp(0, 1), ior)) * irradiance


def _indices(here: Bool[Tensor, "patches"]) -> Int[Tensor, "members"]:
    return here.nonzero().squeeze(1)


def _padded(shape: Sequence[int], kernels: tuple[tuple[Kernel, ...], ...]) -> tuple[int, int]:
    """Size at which a periodic convolution does not reach round; at most twice the picture."""
    reach = math.ceil(TAIL * max(kernel.reach_px for group in kernels for kernel in group))
    return _fast(shape[0] + min(shape[0], reach)), _fast(shape[1] + min(shape[1], reach))


def _fast(length: int) -> int:
    """The next even length with no prime factor above 7."""
    length += length % 2
    while True:
        rest = length
        for prime in (2, 3, 5, 7):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return length
        length += 2


def _spectra(
    size: tuple[int, int], kernels: tuple[tuple[Kernel, ...], ...], beyond_px: float, dtype: torch.dtype
) -> list[list[Tensor]]:
    """Spectrum of the kernel, real because it is even: [target group][source group], (channels, height, half width)."""
    down, right = (torch.fft.fftfreq(length, 1 / length, dtype=torch.float64) for length in size)
    r = (down[:, None].square() + right[None].square()).sqrt()
    share = (r - (beyond_px - 0.5)).clamp(0, 1) if beyond_px > 0 else (r > 0).to(r.dtype)

    def spectrum(ours: Kernel, theirs: Kernel) -> Tensor:
        kernel = ours(r) if ours == theirs else (ours(r) * theirs(r)).sqrt()
        return torch.fft.rfft2(kernel * share).real.to(dtype)

    return [
        [torch.stack([spectrum(*pair) for pair in zip(ours, theirs, strict=True)]) for theirs in kernels]
        for ours in kernels
    ]
