"""Drift of a capture: every picture and sweep against the first basis light's full picture.

Same light: the sum of a sweep's n_d-roots is the full picture again (Eq. 25), up to C, so the two are registered as
pictures of the same thing. A sweep that drifts slowly shows each pixel as it lay when the slab passed it, so that the
drift is a part of the motion that goes with the passage (`Motion.velocity`).

Pictures under other lights: `between_lights`, where nothing moves without proof. No sweep is moved by less than what
stands beyond its uncertainty, and none by less than `align_options.LEAST_PX`. Motions are composed, so that a picture
is resampled once.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.calibrate.align_options import MARGIN_PX, AlignOptions, grown, judged
from reflectsep.calibrate.aligned_stream import after, aligned_stream
from reflectsep.calibrate.between_lights import anchored, between
from reflectsep.calibrate.bracket_motion import bracket_motions
from reflectsep.calibrate.motion import Motion, displacement, inside, positions, shifted, warp
from reflectsep.calibrate.register import RegisterOptions, register
from reflectsep.calibrate.sweep_sum import SweepSum, add_frames, roots_of
from reflectsep.data import Capture, FrameStream, Sweep
from reflectsep.errors import CaptureError
from reflectsep.progress import Progress, silent
from reflectsep.room import empty
from reflectsep.solve.sharing import by_items

CLIPPED_SHARE = 0.5
CLIPPED_BESIDE = 0.01
NOT_LOOKED_FOR = "not looked for"
SIDE_BY_SIDE_PX = 1 << 22
"""Larger pictures are registered one after the other, in the memory of one."""


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """Motions of a capture, from the first basis light's full picture."""

    pictures: Mapping[str, Motion] = field(default_factory=dict)
    """By light."""
    sweeps: tuple[Motion, ...] = ()
    """In the capture's order; against the first basis picture, so that a frame is resampled once."""
    against_full: tuple[Motion, ...] = ()
    """The same sweeps against the full picture of their own light: what was measured."""
    exposures: tuple[tuple[Motion, ...], ...] = ()
    """Of each sweep: its bracket's further exposures against the first; none where it has one exposure."""
    warnings: tuple[str, ...] = ()
    size: tuple[int, int] | None = None
    """(width, height) of the pictures."""

    @property
    def moved(self) -> bool:
        """Whether any picture is resampled."""
        return any(m.applied for m in (*self.pictures.values(), *self.of_frames()))

    def of_frames(self) -> tuple[Motion, ...]:
        """Of every sweep and every exposure, against the first basis picture."""
        return (
            *self.sweeps,
            *(after(m, own) for m, each in zip(self.sweeps, self._exposures(), strict=True) for own in each),
        )

    def _exposures(self) -> tuple[tuple[Motion, ...], ...]:
        return self.exposures or tuple(() for _ in self.sweeps)

    def in_window(self, x: int, y: int, size: tuple[int, int]) -> Alignment:
        """The same motions where pixels are counted from (x, y) of these pictures, in a window of `size`."""
        origin = shifted(float(x), float(y))

        def there(motion: Motion) -> Motion:
            return replace(motion, matrix=shifted(float(-x), float(-y)) @ motion.matrix @ origin)

        return replace(
            self,
            pictures={name: there(motion) for name, motion in self.pictures.items()},
            sweeps=tuple(there(motion) for motion in self.sweeps),
            against_full=tuple(there(motion) for motion in self.against_full),
            exposures=tuple(tuple(there(motion) for motion in each) for each in self.exposures),
            size=size,
        )

    def placed(self, i: int, stream: FrameStream) -> FrameStream:
        """Developed frames of the capture's sweep `i` as the first basis picture has them."""
        return aligned_stream(stream, self.sweeps[i], self._exposures()[i])

    def told(self, capture: Capture) -> str:
        """What was moved and by how much, in a line; and what was looked for and not found."""
        lights = [f"{name} by {m.displacement_px:.2f} px" for name, m in self.pictures.items() if m.applied]
        looked = any(m.reason not in ("reference", NOT_LOOKED_FOR) for m in self.pictures.values())
        unmoved = "no motion between lights proven" if looked else "motion between lights not looked for"
        parts = [f"moved between lights: {', '.join(lights)}" if lights else unmoved]
        if self.against_full:
            sweeps = [
                f"{sweep.light} along {sweep.direction} by {m.displacement_px:.2f} px"
                for sweep, m in zip(capture.sweeps, self.against_full, strict=True)
                if m.applied
            ]
            parts.append(f"sweeps moved: {', '.join(sweeps)}" if sweeps else "no sweep moved")
        return "; ".join(parts)

    def document(self, capture: Capture) -> dict[str, Any]:
        """As it stands in `separation.json`."""
        return {
            "reference": capture.basis[0],
            "size": None if self.size is None else list(self.size),
            "told": self.told(capture),
            "pictures": {name: motion.document() for name, motion in self.pictures.items()},
            "sweeps": [
                {"light": sweep.light, "direction": sweep.direction, **motion.document()}
                | {"against_full": measured.document()}
                | ({"exposures": [own.document() for own in exposures]} if exposures else {})
                for sweep, motion, measured, exposures in zip(
                    capture.sweeps, self.sweeps, self.against_full, self._exposures(), strict=True
                )
            ],
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Alignment:
        """What `document` gave, without its warnings.

        Raises:
            KeyError, TypeError, ValueError: it is none.
        """
        size = document["size"]
        sweeps = [dict(sweep) for sweep in document["sweeps"]]
        return cls(
            pictures={str(name): Motion.from_document(motion) for name, motion in dict(document["pictures"]).items()},
            sweeps=tuple(Motion.from_document(sweep) for sweep in sweeps),
            against_full=tuple(Motion.from_document(sweep["against_full"]) for sweep in sweeps),
            exposures=tuple(tuple(map(Motion.from_document, sweep.get("exposures", ()))) for sweep in sweeps),
            size=None if size is None else (int(size[0]), int(size[1])),
        )


def align(
    capture: Capture,
    names: Sequence[str],
    pictures: Float[Tensor, "lights channels height width"],
    saturated: Bool[Tensor, "lights channels height width"],
    mask: Bool[Tensor, "height width"],
    streams: Sequence[FrameStream],
    *,
    options: AlignOptions | None = None,
    progress: Progress = silent,
) -> Alignment:
    """Find the motion of every full picture and every sweep of a capture.

    Args:
        capture: whose they are.
        names: lights of `pictures`, the first the reference.
        pictures: developed full pictures; NaN where they are not finite.
        saturated: their clipped values.
        mask: the object, in the reference.
        streams: developed frames, one stream a sweep of the capture; each is read once.
        options: settings.
        progress: told after every frame and picture.

    Raises:
        CaptureError: nothing to compare.
    """
    options = options or AlignOptions()
    count, height, width = len(pictures), *mask.shape
    grey, good = empty(count, height, width, dtype=torch.float64), empty(count, height, width, dtype=torch.bool)
    for i, picture in enumerate(pictures):
        own = roots_of(picture, options.n_d).mean(0)
        good[i] = ~saturated[i].any(0) & torch.isfinite(own)
        grey[i] = torch.where(torch.isfinite(own), own, 0.0)
    motions = {name: Motion(reason="reference" if i == 0 else NOT_LOOKED_FOR) for i, name in enumerate(names)}
    if options.scope == "all":
        finished, turn = itertools.count(1), threading.Lock()
        anchor = anchored(grey[0], mask)

        def between_lights(i: int) -> dict[str, Any]:
            found = between(anchor, grey[i + 1], options)
            with turn:
                progress("alignment", next(finished), len(names) - 1)
            return found.plain()

        at_once = torch.get_num_threads() if mask.numel() <= SIDE_BY_SIDE_PX else 1
        found = by_items(len(names) - 1, between_lights, at_once=at_once)
        motions |= {name: Motion.from_plain(values) for name, values in zip(names[1:], found, strict=True)}

    def same_light(i: int) -> tuple[dict[str, Any], list[dict[str, Any]], list[str]]:
        sweep = capture.sweeps[i]
        if sweep.light not in names:
            return Motion(reason="its light has no full picture").plain(), [], []
        k = list(names).index(sweep.light)
        exposures = bracket_motions(streams[i], mask, options)
        added = add_frames(aligned_stream(streams[i], Motion(), exposures), options.n_d, progress)
        own = _same_light(grey[k], good[k], mask, motions[sweep.light], added, options)
        said = _too_long(sweep, added, mask)
        if own.reason.startswith("clipped"):
            said.append(f"sweep of {sweep.light} along {sweep.direction}: not registered, {own.reason}")
        return own.plain(), [motion.plain() for motion in exposures], said

    of_sweeps = by_items(len(capture.sweeps), same_light)
    measured = [Motion.from_plain(own) for own, _, _ in of_sweeps]
    sweeps = [
        _composed(own, motions[sweep.light], mask) if sweep.light in names else own
        for sweep, own in zip(capture.sweeps, measured, strict=True)
    ]
    warnings = [text for _, _, said in of_sweeps for text in said]
    return Alignment(
        pictures=motions,
        sweeps=tuple(sweeps),
        against_full=tuple(measured),
        exposures=tuple(tuple(Motion.from_plain(m) for m in each) for _, each, _ in of_sweeps),
        warnings=tuple(warnings),
        size=(mask.shape[1], mask.shape[0]),
    )


def _same_light(
    full: Tensor, good: Tensor, mask: Tensor, place: Motion, added: SweepSum, options: AlignOptions
) -> Motion:
    on_object = _place_mask(mask, place) if place.applied else mask
    share = float((added.clipped & on_object).sum() / on_object.sum().clamp_min(1))
    if share > CLIPPED_SHARE:
        return Motion(reason=f"clipped in {share:.0%} of the object, so its sum is not the full picture")
    usable = grown(on_object, MARGIN_PX) & good
    try:
        found = register(
            added.total,
            full,
            usable=usable,
            moving_usable=added.usable,
            time=added.time,
            options=RegisterOptions(models=options.models, drift=True),
        )
    except CaptureError as error:
        return Motion(reason=str(error))
    return judged(found, on_object)


def _too_long(sweep: Sweep, added: SweepSum, mask: Tensor) -> list[str]:
    """A warning where frames other than those that light a pixel are clipped: then scattering itself is cut off."""
    lit = added.clipped_frames[mask & added.clipped]
    if lit.numel() == 0:
        return []
    # The faintest of the clipped pixels are clipped while lit alone.
    usual = float(lit.kthvalue(max(1, round(0.05 * lit.numel()))).values)
    share = float((added.clipped_frames[mask] > max(3.0, usual + 1.5)).double().mean())
    if share < CLIPPED_BESIDE:
        return []
    return [
        f"sweep of {sweep.light} along {sweep.direction}: {share:.0%} of the object is clipped in more frames than "
        "light it, so scattering itself is cut off there: expose the frames shorter, or bracket them"
    ]


def _composed(own: Motion, light: Motion, mask: Tensor) -> Motion:
    """A sweep against the reference: against its full picture, after that one's own motion."""
    if not light.applied:
        return own
    first = own.matrix if own.applied else torch.eye(3, dtype=torch.float64)
    matrix = first @ light.matrix
    return replace(
        own,
        matrix=matrix,
        model=f"{own.model} after {light.model}" if own.applied else light.model,
        velocity=own.velocity if own.applied else (0.0, 0.0),
        displacement_px=displacement(matrix, mask),
        sd_px=(own.sd_px**2 + light.sd_px**2) ** 0.5,
        applied=True,
        reason=own.reason if own.applied else f"moves with the full picture of its light ({own.reason})",
    )


def covered(alignment: Alignment, height: int, width: int) -> Bool[Tensor, "height width"]:
    """Reference pixels that every picture and every frame has."""
    result = torch.ones((height, width), dtype=torch.bool)
    for motion in (*alignment.pictures.values(), *alignment.of_frames()):
        if motion.applied:
            for time in (-1.0, 1.0):
                result &= inside(positions(motion.at(time), height, width))
    return result


def _place_mask(mask: Tensor, place: Motion) -> Tensor:
    """The object where the light's own full picture has it."""
    moved, _, _ = warp(mask[None].double(), torch.linalg.inv(place.matrix))
    return moved[0] > 0.5
