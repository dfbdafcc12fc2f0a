"""A capture's full pictures as a photometric stack: linear, on one scale, bad pixels flagged, alpha of every light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.calibrate.alignment import Alignment, covered
from reflectsep.calibrate.alpha import CONDITION_LIMIT, AlphaReport, light_vector, solve_alpha
from reflectsep.calibrate.bracket import NEARLY, merge
from reflectsep.calibrate.develop import Response, develop
from reflectsep.calibrate.exposure import colour_of, exposure_ratio, response_of
from reflectsep.calibrate.flat import flat_of
from reflectsep.calibrate.linear_combination import EstimateSettings
from reflectsep.calibrate.motion import warp
from reflectsep.data import Capture, PhotometricStack
from reflectsep.errors import CaptureError, LightError
from reflectsep.flags import Flag, mark
from reflectsep.io.stack import RawPictures, read_bracket, read_dark, read_full, read_mask
from reflectsep.room import empty
from reflectsep.settings import nearest

MINIMUM = 6
"""Full pictures that the method needs with the scattering known: p >= 4 / (n - 4) pixels carry the rest."""


def build_stack(
    capture: Capture,
    *,
    drop: Sequence[str] = (),
    minimum: int = MINIMUM,
    settings: EstimateSettings | None = None,
    condition_limit: float = CONDITION_LIMIT,
) -> PhotometricStack:
    """The stack of `calibrate_stack`, without its report."""
    stack, _ = calibrate_stack(capture, drop=drop, minimum=minimum, settings=settings, condition_limit=condition_limit)
    return stack


def calibrate_stack(
    capture: Capture,
    *,
    drop: Sequence[str] = (),
    minimum: int = MINIMUM,
    settings: EstimateSettings | None = None,
    condition_limit: float = CONDITION_LIMIT,
    alignment: Alignment | None = None,
) -> tuple[PhotometricStack, AlphaReport]:
    """Read and develop the full pictures, and find every light's alpha.

    A light's scalar intensity goes into its vector and its alpha; pictures of a light with an intensity a channel are
    divided by it, and the light counts as one of intensity 1. Where the basis vectors are known, unknown lights get
    the vector that their alpha implies.

    Args:
        capture: whose pictures.
        drop: lights to leave out, e.g. to compare with later; none of the basis.
        minimum: pictures that there must be.
        settings: of alpha from the pictures, n_d among them.
        condition_limit: largest condition number of the basis lights.
        alignment: motions to undo, before anything else is made of the pictures.

    Returns:
        The stack: a pixel that is not finite somewhere is 0 throughout, flagged and out of the mask. And where the
        alphas come from and how well vectors and pictures agree.

    Raises:
        LightError: too few pictures, a wrong name in `drop`, coplanar or repeated basis lights, an alpha that neither
            vectors nor pictures give.
        CaptureError: a file that is missing, damaged or of the wrong size, a picture without light or without one
            finite value on the object.
    """
    capture = without(capture, drop)
    if len(capture.names) < minimum:
        found = f"{len(capture.names)} full pictures ({', '.join(capture.names)})"
        raise LightError(f"{capture.folder}: {found}, expected at least {minimum}")
    raw = read_full(capture)
    on_object = read_mask(capture)
    images, saturated = develop_pictures(capture, raw, response_of(capture))
    raw = replace(raw, values=images, saturated=saturated)
    _check_pictures(capture, images, on_object)
    seen = torch.ones_like(on_object)
    if alignment is not None and alignment.moved:
        images, saturated, seen = _still(raw, images, alignment)
        raw = replace(raw, values=images, saturated=saturated)
    valid = seen
    for picture in images:
        valid = valid & torch.isfinite(picture).all(0)
    mask = on_object & valid
    if not bool(mask.any()):
        raise CaptureError(f"{capture.folder}: no pixel of the object is finite in all {len(raw.names)} pictures")
    for picture in images:
        picture.masked_fill_(~valid, 0.0)
    vectors = [light_vector(capture.lights[name]) for name in raw.names]
    report = solve_alpha(
        raw.names, vectors, images, mask & ~raw.saturated, settings=settings, condition_limit=condition_limit
    )
    flags = torch.zeros(on_object.shape, dtype=torch.int32)
    flags = mark(flags, ~on_object, Flag.OUTSIDE_MASK)
    flags = mark(flags, on_object & seen & ~valid, Flag.INVALID_INPUT)
    flags = mark(flags, on_object & ~seen, Flag.MOVED_OUT)
    flags = mark(flags, mask & raw.saturated.any(1).any(0), Flag.SATURATED)
    view = torch.tensor(capture.view, dtype=torch.float32)
    stack = PhotometricStack(
        names=raw.names,
        images=images,
        saturated=raw.saturated,
        mask=mask,
        alpha=report.alpha,
        light_vectors=report.light_vectors,
        view=view / view.norm(),
        flags=flags,
    )
    return stack, report


def _still(raw: RawPictures, images: Tensor, alignment: Alignment) -> tuple[Tensor, Tensor, Tensor]:
    """Pictures with their motions undone, each resampled once; clipped values; and pixels that all of them have."""
    still, clipped = empty(*images.shape, dtype=images.dtype), empty(*images.shape, dtype=torch.bool)
    for i, (name, picture, saturated) in enumerate(zip(raw.names, images, raw.saturated, strict=True)):
        motion = alignment.pictures[name]
        if motion.applied:
            picture, moved, _ = warp(picture, motion.matrix, saturated)  # noqa: PLW2901
            saturated = saturated if moved is None else moved  # noqa: PLW2901
        still[i], clipped[i] = picture, saturated
    return still, clipped, covered(alignment, *images.shape[-2:])


def without(capture: Capture, drop: Sequence[str]) -> Capture:
    """`capture` without the full pictures of the lights in `drop`.

    Raises:
        LightError: a light that has no full picture, or that is of the basis.
    """
    check_names(capture, drop)
    basis = [name for name in drop if name in capture.basis]
    if basis:
        raise LightError(f"{capture.folder}: light {basis[0]} is of the basis and cannot be left out; choose another")
    images = tuple(picture for picture in capture.images if picture.kind != "full" or picture.light not in drop)
    return replace(capture, images=images)


def develop_pictures(
    capture: Capture, raw: RawPictures, response: Response
) -> tuple[Float[Tensor, "lights channels height width"], Bool[Tensor, "lights channels height width"]]:
    """Full pictures in the capture's units, and which of their values are clipped.

    Brackets are merged; flat fields and a coloured light's intensity are divided out; NaN where a value is not finite.

    Raises:
        CaptureError: an unreadable dark or flat picture, or an intensity that does not fit the channels.
    """
    pictures = empty(*raw.values.shape, dtype=raw.values.dtype)
    clipped = empty(*raw.saturated.shape, dtype=torch.bool)
    exposures = zip(raw.names, raw.values, raw.saturated, raw.exposure_s, strict=True)
    for i, (name, values, saturated, exposure_s) in enumerate(exposures):
        picture = _developed(capture, name, values, exposure_s, response)
        if capture.bracketed(name):
            picture, saturated = _merged(capture, name, values, response)  # noqa: PLW2901
        colour = colour_of(capture.lights[name], raw.values.shape[1])
        picture = picture if colour is None else picture / colour
        flat = flat_of(capture, name, response)
        pictures[i] = picture if flat is None else picture / flat
        clipped[i] = saturated
    return pictures, clipped


def _developed(
    capture: Capture, name: str, values: Tensor, exposure_s: float | None, response: Response
) -> Float[Tensor, "channels height width"]:
    """One exposure in the capture's units."""
    dark = read_dark(capture, exposure_s)
    if dark is not None and dark.shape != values.shape:
        raise CaptureError(
            f"{capture.folder}: dark picture of {tuple(dark.shape)}, but {capture.full(name).file} is of "
            f"{tuple(values.shape)} (channels, height, width)"
        )
    return develop(values, response, dark, exposure_ratio(capture, exposure_s))


def _merged(capture: Capture, name: str, like: Tensor, response: Response) -> tuple[Tensor, Tensor]:
    """A light's bracket as one picture."""
    shots = read_bracket(capture, name, like)
    pictures = [_developed(capture, name, values, exposure_s, response) for exposure_s, values, _ in shots]
    # Only integer files have a full scale; of those the camera's shoulder is left out as well.
    limited = any(bool(clipped.any()) for _, _, clipped in shots)
    bad = [clipped | (values > NEARLY) if limited else clipped for _, values, clipped in shots]
    return merge(pictures, bad, [exposure_s for exposure_s, _, _ in shots])


def check_names(capture: Capture, names: Sequence[str]) -> None:
    """Refuse names that have no full picture.

    Raises:
        LightError: one of them, with the nearest name that there is.
    """
    for name in names:
        if name not in capture.names:
            known = ", ".join(capture.names)
            raise LightError(
                f"{capture.folder}: no full picture of light {name}{nearest(name, capture.names)} ({known})"
            )


def _check_pictures(capture: Capture, images: Tensor, on_object: Tensor) -> None:
    """Refuse pictures that say nothing of the object."""
    for name, picture in zip(capture.names, images, strict=True):
        file = capture.folder / capture.full(name).file
        seen = torch.isfinite(picture) & on_object
        if not bool(seen.any()):
            raise CaptureError(f"{file}: not one finite value on the object")
        if not bool((picture[seen] > 0).any()):
            raise CaptureError(f"{file}: nothing on the object is brighter than the dark picture; was the light on?")
