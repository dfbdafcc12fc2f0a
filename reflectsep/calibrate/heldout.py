"""Pictures that a fit never saw, as it would have seen them: developed alike, and in the first basis picture's place.

A camera that drifted between the other lights drifted before a held-out one too, and a picture that lies elsewhere is
unlike any relit one. Its motion is found as that of any picture under another light (`between_lights`), from measured
pictures alone: by what is relit, the comparison would be made to agree with the model that it judges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.calibrate.align_options import AlignOptions
from reflectsep.calibrate.between_lights import Anchor, anchored, between
from reflectsep.calibrate.exposure import response_of
from reflectsep.calibrate.motion import Motion, warp
from reflectsep.calibrate.stack import check_names, develop_pictures
from reflectsep.data import Capture, Region
from reflectsep.errors import LightError
from reflectsep.io.stack import read_full, read_mask


@dataclass(frozen=True, kw_only=True)
class HeldOutPictures:
    """Pictures of lights that a fit left out."""

    names: tuple[str, ...]
    values: Float[Tensor, "lights channels height width"]
    """In the capture's units; 0 where a value is not finite."""
    clipped: Bool[Tensor, "lights channels height width"]
    """Values that say nothing: clipped, not finite, or from outside the picture."""
    motions: tuple[Motion, ...]
    """Of every picture against the first basis light's."""


@dataclass(frozen=True, kw_only=True)
class Still:
    """What held-out pictures are registered against."""

    anchor: Anchor
    """The first basis light's full picture, prepared."""
    options: AlignOptions | None
    """None, or with the scope `same_light`: pictures stay as they lie."""
    region: Region | None = None
    """What is kept of a picture once it is in its place."""

    def place(
        self, picture: Float[Tensor, "channels height width"], bad: Bool[Tensor, "channels height width"]
    ) -> tuple[Tensor, Tensor, Motion]:
        """A picture in the reference's place, resampled once or not at all; its bad values; and the motion."""
        values, clipped, motion = self._placed(picture, bad)
        return kept(self.region, values), kept(self.region, clipped), motion

    def _placed(self, picture: Tensor, bad: Tensor) -> tuple[Tensor, Tensor, Motion]:
        if self.options is None or self.options.scope != "all" or picture.shape[1:] != self.anchor.mask.shape:
            return picture, bad, Motion(reason="not looked for")
        motion = between(self.anchor, torch.where(bad, 0.0, picture).mean(0).double(), self.options)
        if not motion.applied:
            return picture, bad, motion
        values, clipped, seen = warp(picture, motion.matrix, bad)
        return values, ~seen if clipped is None else clipped | ~seen, motion


def still_of(capture: Capture, options: AlignOptions | None) -> Still:
    """The first basis light's full picture, and the object in it.

    Raises:
        CaptureError: a picture or mask that cannot be read.
    """
    region, capture = capture.region, replace(capture, region=None)
    _, pictures, _ = _developed(capture, [])
    return Still(anchor=anchored(pictures[0].mean(0).double(), read_mask(capture)), options=options, region=region)


def kept(region: Region | None, picture: Tensor) -> Tensor:
    """What is kept of a picture (..., height, width)."""
    return picture if region is None else region.of(picture)


def held_out_pictures(capture: Capture, names: Sequence[str], options: AlignOptions | None = None) -> HeldOutPictures:
    """Pictures of lights that a fit left out, developed and registered as its stack was.

    Args:
        capture: whose pictures.
        names: of the lights.
        options: of the registration, as the fit's; None: none.

    Raises:
        LightError: a name without a full picture, or no name.
        CaptureError: as `calibrate_stack`.
    """
    check_names(capture, names)
    if not names:
        raise LightError(f"{capture.folder}: no held-out lights named; expected at least one")
    # Registered whole: a part may show too little of the object, or none of its edges.
    region, capture = capture.region, replace(capture, region=None)
    found, pictures, bad = _developed(capture, names)
    still = Still(anchor=anchored(pictures[0].mean(0).double(), read_mask(capture)), options=options)
    placed = [still.place(pictures[i], bad[i]) for i in (found.index(name) for name in names)]
    return HeldOutPictures(
        names=tuple(names),
        values=torch.stack([kept(region, values) for values, _, _ in placed]),
        clipped=torch.stack([kept(region, clipped) for _, clipped, _ in placed]),
        motions=tuple(motion for _, _, motion in placed),
    )


def _developed(capture: Capture, names: Sequence[str]) -> tuple[tuple[str, ...], Tensor, Tensor]:
    """The first basis picture, whose size and channels are expected of all, and those of `names`; 0 where bad."""
    first = capture.basis[0]
    wanted = {*names, first}
    images = tuple(picture for picture in capture.images if picture.kind != "full" or picture.light in wanted)
    raw = read_full(replace(capture, images=images, basis=(first, first, first)))
    pictures, saturated = develop_pictures(capture, raw, response_of(capture))
    finite = torch.isfinite(pictures)
    return raw.names, torch.where(finite, pictures, 0.0), saturated | ~finite
