"""Uneven light over the field: all is divided by a picture of an even, matte target under the same light."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from kornia.filters import gaussian_blur2d
from torch import Tensor

from reflectsep.calibrate.develop import Response, develop
from reflectsep.data import Capture, Picture
from reflectsep.errors import CaptureError
from reflectsep.io.stack import read_dark, read_mask, read_one, windowed

BLUR_PX = 2.0
"""A flat's own noise would go into every picture; unevenness is smooth."""
LEAST = 0.05
"""Of its mean: darker than this a flat says that there was no light, not how much."""


def flat_of(capture: Capture, light: str | None, response: Response) -> Float[Tensor, "channels height width"] | None:
    """The flat field of a light, mean 1 on the object: its own, else the one that names no light, else None.

    Raises:
        CaptureError: it cannot be read, or has values on the object that are no light.
    """
    found = _choose(capture, light)
    if found is None:
        return None
    # Of the whole object also where only a region is kept: parts must not differ by their flats' means.
    region, capture = capture.region, replace(capture, region=None)
    values = develop(read_one(capture, found.file), response, read_dark(capture, found.exposure_s), 1.0)
    mask = read_mask(capture)
    place = capture.folder / found.file
    if not bool(torch.isfinite(values).all()):
        raise CaptureError(f"{place}: a flat field with values that are not finite numbers; expected none")
    size = 2 * round(3 * BLUR_PX) + 1
    smooth = gaussian_blur2d(values[None], (size, size), (BLUR_PX, BLUR_PX), border_type="replicate")[0]
    mean = smooth[:, mask].mean(1)[:, None, None]
    if not bool((mean > 0).all()):
        raise CaptureError(f"{place}: a flat field that is dark on the object; expected an even bright target")
    field = smooth / mean
    if float(field[:, mask].min()) < LEAST:
        raise CaptureError(
            f"{place}: a flat field of {float(field[:, mask].min()):.1%} of its mean somewhere on the object; expected "
            f"at least {LEAST:.0%}"
        )
    return windowed(place, region, field.clamp_min(LEAST))[0]


def _choose(capture: Capture, light: str | None) -> Picture | None:
    flats = [picture for picture in capture.images if picture.kind == "flat"]
    own = [picture for picture in flats if picture.light == light]
    shared = [picture for picture in flats if picture.light is None]
    return (own or shared or [None])[0]
