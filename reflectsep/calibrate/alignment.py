"""Drift of a capture: every picture and sweep against the first basis light's full picture.

Same light: the sum of a sweep's n_d-roots is the full picture again (Eq. 25), up to C, so the two are registered as
pictures of the same thing. A sweep that drifts slowly shows each pixel as it lay when the slab passed it, so that the
drift is a part of the motion that goes with the passage (`Motion.velocity`).

Other lights: what does not change with the light is the outline and the structure of the surface. In the logarithm,
shading is a slowly varying summand: log(1 + I / small) = c log(1 + I_1 / small) + polynomial on the object, robustly,
which leaves out attached shadows and highlights. It starts from the outline alone. Where fine structure agrees with
it, the surface has texture, which is more exact and alone tells a rotation. No picture is moved by less than
what stands beyond its uncertainty, and none by less than `LEAST_PX`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn.functional import max_pool2d

from reflectsep.calibrate.motion import MODELS, Model, Motion, displacement, inside, positions, warp
from reflectsep.calibrate.register import FEWEST_PIXELS, RegisterOptions, Registration, register
from reflectsep.data import Capture, Frame, FrameStream, Sweep
from reflectsep.errors import CaptureError
from reflectsep.io.ahead import frames_of, one_thread
from reflectsep.progress import Progress, silent

LEAST_PX = 0.05
"""Motions smaller than this are left alone: resampling would cost more than they do."""
MARGIN_PX = 6
"""Of background round the object that counts, and no less than the motion that is looked for."""
SMALL = 0.15
OUTLINE_SMALL = 0.06
"""Of the picture's bright end: below it values count as dark."""
OUTLINE_BLUR_PX = 1.5
SHADING_FLOOR_PX = 0.15
STRUCTURE_FLOOR_PX = 0.05
"""Systematic errors between pictures under different lights, beside which a motion must stand out: by outline and
shading, and by texture."""
STRUCTURE_PX = 3.0
MOST_PIXELS = 100_000
"""Pictures are halved until they are no larger: across lights a fifth of a pixel is the goal."""
AGREE_PX = 0.35
"""Fine structure that moves apart from outline and shading by more than this is no texture."""
CLIPPED_SHARE = 0.5
CLIPPED_BESIDE = 0.01
DEGREE = 5


@dataclass(frozen=True, kw_only=True)
class AlignOptions:
    """How a capture is aligned."""

    scope: Literal["all", "same_light"] = "all"
    """`same_light`: sweeps against full pictures alone."""
    richest: Model = "homography"
    """The richest model that the evidence may choose."""
    n_d: float = 1.0
    """Exponent of the roots that are summed; 1 in linear light."""

    @property
    def models(self) -> tuple[Model, ...]:
        """Models to choose from."""
        return MODELS[: MODELS.index(self.richest) + 1]


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """Motions of a capture, from the first basis light's full picture."""

    pictures: Mapping[str, Motion] = field(default_factory=dict)
    """By light."""
    sweeps: tuple[Motion, ...] = ()
    """In the capture's order; against the first basis picture, so that a frame is resampled once."""
    against_full: tuple[Motion, ...] = ()
    """The same sweeps against the full picture of their own light: what was measured."""
    warnings: tuple[str, ...] = ()
    size: tuple[int, int] | None = None
    """(width, height) of the pictures."""

    @property
    def moved(self) -> bool:
        """Whether any picture is resampled."""
        return any(m.applied for m in (*self.pictures.values(), *self.sweeps))

    def document(self, capture: Capture) -> dict[str, Any]:
        """As it stands in `separation.json`."""
        return {
            "reference": capture.basis[0],
            "size": None if self.size is None else list(self.size),
            "pictures": {name: motion.document() for name, motion in self.pictures.items()},
            "sweeps": [
                {"light": sweep.light, "direction": sweep.direction, **motion.document()}
                | {"against_full": measured.document()}
                for sweep, motion, measured in zip(capture.sweeps, self.sweeps, self.against_full, strict=True)
            ],
        }


@dataclass(frozen=True, kw_only=True)
class SweepSum:
    """A sweep's frames added up."""

    total: Float[Tensor, "height width"]
    """Sum of the n_d-roots, channel mean."""
    usable: Bool[Tensor, "height width"]
    """Not clipped in any frame, and no frame near its passage was lost."""
    time: Float[Tensor, "height width"]
    """When the slab passed: -1 at the first frame, 1 at the last."""
    clipped: Bool[Tensor, "height width"]
    clipped_frames: Float[Tensor, "height width"]
    """In how many frames."""


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
    grey = _roots(pictures, options.n_d).mean(1)
    good = ~saturated.any(1) & torch.isfinite(grey)
    grey = torch.where(torch.isfinite(grey), grey, 0.0).double()
    motions = {name: Motion(reason="reference" if i == 0 else "not looked for") for i, name in enumerate(names)}
    warnings: list[str] = []
    if options.scope == "all":
        for j in range(1, len(names)):
            motions[names[j]] = across(grey[0], grey[j], mask, options)
            progress("alignment", j, len(names) - 1)
    sweeps, measured = [], []
    for sweep, stream in zip(capture.sweeps, streams, strict=True):
        if sweep.light not in names:
            sweeps.append(Motion(reason="its light has no full picture"))
            measured.append(sweeps[-1])
            continue
        k = list(names).index(sweep.light)
        added = add_frames(stream, options.n_d, progress)
        warnings += _too_long(sweep, added, mask)
        own = _same_light(grey[k], good[k], mask, motions[sweep.light], added, options)
        if own.reason.startswith("clipped"):
            warnings.append(f"sweep of {sweep.light} along {sweep.direction}: not registered, {own.reason}")
        measured.append(own)
        sweeps.append(_composed(own, motions[sweep.light], mask))
    return Alignment(
        pictures=motions,
        sweeps=tuple(sweeps),
        against_full=tuple(measured),
        warnings=tuple(warnings),
        size=(mask.shape[1], mask.shape[0]),
    )


def across(
    reference: Float[Tensor, "height width"],
    picture: Float[Tensor, "height width"],
    mask: Bool[Tensor, "height width"],
    options: AlignOptions | None = None,
) -> Motion:
    """Motion of a picture under another light against the reference.

    Args:
        reference: grey linear picture. Clipped values may be in both: they are bright, and outline and logarithm bear
            it.
        picture: the one that may have moved.
        mask: the object, in the reference.
        options: settings.
    """
    options = options or AlignOptions()
    usable = _grown(mask, MARGIN_PX)
    models: tuple[Model, ...] = options.models[:3]  # up to a rigid motion
    try:
        outline = register(
            _outline(picture, mask),
            _polynomials(mask, 3),
            usable=usable,
            options=RegisterOptions(models=("translation",), blur_px=OUTLINE_BLUR_PX, most_pixels=MOST_PIXELS),
        )
        shaded = partial(
            register,
            _logarithm(picture, mask),
            torch.cat([_logarithm(reference, mask)[None], _polynomials(mask, DEGREE)]),
            usable=usable,
            start=outline.matrix,
        )
        # Beyond a shift, what two lights do to an outline and to shading is more than a camera does.
        measured = shaded(options=RegisterOptions(models=("translation",), most_pixels=MOST_PIXELS))
        structure = _structure(reference, picture, mask, models, measured)
        if structure is not None:
            return _judged(structure, mask)
        tested = RegisterOptions(models=("identity", "translation"), floor_px=SHADING_FLOOR_PX, most_pixels=MOST_PIXELS)
        return _judged(shaded(options=tested), mask)
    except CaptureError as error:
        return Motion(reason=str(error))


def _structure(
    reference: Tensor, picture: Tensor, mask: Tensor, models: tuple[Model, ...], measured: Registration
) -> Registration | None:
    """The motion of the surface's fine structure; None where that structure goes with the light and not the surface.

    On a bumpy object without texture fine structure is shading, which moves by pixels with the light: then it does not
    agree with outline and logarithm.
    """
    inner = ~_grown(~mask, round(STRUCTURE_PX) + 2)
    if int(inner.sum()) < FEWEST_PIXELS:
        return None
    found = register(
        _fine(picture, mask),
        _fine(reference, mask)[None],
        usable=inner,
        options=RegisterOptions(
            models=models,
            blur_px=1.0,
            floor_px=STRUCTURE_FLOOR_PX,
            lenient_turn=False,
            levels=0,
            most_pixels=MOST_PIXELS,
        ),
        start=measured.matrix,
    )
    rows, columns = mask.nonzero(as_tuple=True)
    middle = torch.stack([columns.double().mean(), rows.double().mean(), torch.tensor(1.0, dtype=torch.float64)])
    apart = float((found.matrix @ middle - measured.matrix @ middle)[:2].norm())
    return found if apart <= AGREE_PX else None


def _fine(picture: Tensor, mask: Tensor) -> Tensor:
    """The logarithm without what is coarser than `STRUCTURE_PX`."""
    values = _logarithm(picture, mask)
    size = 2 * round(3 * STRUCTURE_PX) + 1
    size = min(size, 2 * ((min(values.shape) - 1) // 2) + 1)
    blur = (STRUCTURE_PX, STRUCTURE_PX)
    return values - gaussian_blur2d(values[None, None], (size, size), blur, border_type="replicate")[0, 0]


def _same_light(
    full: Tensor, good: Tensor, mask: Tensor, place: Motion, added: SweepSum, options: AlignOptions
) -> Motion:
    on_object = _place_mask(mask, place) if place.applied else mask
    share = float((added.clipped & on_object).sum() / on_object.sum().clamp_min(1))
    if share > CLIPPED_SHARE:
        return Motion(reason=f"clipped in {share:.0%} of the object, so its sum is not the full picture")
    usable = _grown(on_object, MARGIN_PX) & good
    try:
        found = register(
            added.total,
            full[None],
            usable=usable,
            moving_usable=added.usable,
            time=added.time,
            options=RegisterOptions(models=options.models, drift=True),
        )
    except CaptureError as error:
        return Motion(reason=str(error))
    return _judged(found, on_object)


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


def _judged(found: Registration, mask: Tensor) -> Motion:
    """The motion as it is used: not at all where it is below what resampling is worth."""
    still = displacement(found.matrix, mask)
    drift = (found.velocity[0] ** 2 + found.velocity[1] ** 2) ** 0.5
    whole = (still**2 + drift**2 / 3) ** 0.5
    motion = Motion(
        matrix=found.matrix,
        model=found.model + (" and drift" if drift > 0 else ""),
        velocity=found.velocity,
        displacement_px=whole,
        sd_px=found.sd_px,
        trust=found.trust,
        gain=float(found.coefficients[0]),
    )
    if found.model == "identity" and drift == 0:
        return replace(motion, reason="no motion beyond chance")
    if whole < LEAST_PX:
        return replace(motion, reason=f"below {LEAST_PX:g} px")
    agreement = f"unseen pixels agree {100 * found.gain_in_agreement:.0f} % better ({found.significance:.1f} sd)"
    return replace(motion, applied=True, reason=agreement)


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


def add_frames(stream: FrameStream, n_d: float = 1.0, progress: Progress = silent) -> SweepSum:
    """Add a sweep's frames up; one is held at a time.

    Raises:
        CaptureError: no frame in it.
    """
    total = moment = mass = times = None
    count = max(2, len(stream))
    received = set()
    with one_thread(), frames_of(stream) as frames:
        for frame in frames:
            received.add(frame.index)
            root = _roots(frame.values, n_d).mean(0).double()
            if total is None or moment is None or mass is None or times is None:
                total, moment, mass, times = (torch.zeros_like(root) for _ in range(4))
            total += root
            weight = root.clamp_(min=0).square_().square_()  # the frames that light a pixel outweigh all others
            mass += weight
            moment.add_(weight, alpha=frame.index)
            if frame.saturated is not None and frame.saturated.any():
                times += frame.saturated.any(0)
            progress(f"alignment {stream.sweep.light} {stream.sweep.direction}", frame.index + 1, len(stream))
    if total is None or moment is None or mass is None or times is None:
        raise CaptureError(f"sweep of {stream.sweep.light} along {stream.sweep.direction}: no frames")
    passed = moment / mass.clamp_min(1e-300)
    if stream.sweep.kind == "shadow":
        passed = torch.full_like(passed, (count - 1) / 2)  # where it is dark cannot be told from the brightest frames
    clipped = times > 0
    usable = ~clipped
    for index in set(range(count)) - received:
        usable &= (passed - index).abs() > 3
    return SweepSum(
        total=total, usable=usable, time=2 * passed / (count - 1) - 1, clipped=clipped, clipped_frames=times
    )


def covered(alignment: Alignment, height: int, width: int) -> Bool[Tensor, "height width"]:
    """Reference pixels that every picture and every frame has."""
    result = torch.ones((height, width), dtype=torch.bool)
    for motion in (*alignment.pictures.values(), *alignment.sweeps):
        if motion.applied:
            for time in (-1.0, 1.0):
                result &= inside(positions(motion.at(time), height, width))
    return result


@dataclass(frozen=True, kw_only=True)
class AlignedStream:
    """A stream of developed frames, each resampled once into the reference as it is read."""

    stream: FrameStream
    motion: Motion

    @property
    def sweep(self) -> Sweep:
        """What is streamed."""
        return self.stream.sweep

    def __len__(self) -> int:
        return len(self.stream)

    def __iter__(self):
        last = max(1, len(self.stream) - 1)
        with frames_of(self.stream) as frames:
            for frame in frames:
                # Where nothing is clipped, nothing of that is resampled.
                clipped = None if frame.saturated is None or not frame.saturated.any() else frame.saturated
                values, saturated, _ = warp(frame.values, self.motion.at(2 * frame.index / last - 1), clipped)
                yield Frame(index=frame.index, values=values, saturated=saturated)


def aligned_stream(stream: FrameStream, motion: Motion) -> FrameStream:
    """`stream` as the reference sees it; itself where nothing moved."""
    return AlignedStream(stream=stream, motion=motion) if motion.applied else stream


def _roots(values: Tensor, n_d: float) -> Tensor:
    return values if n_d == 1.0 else values.sign() * values.abs() ** (1.0 / n_d)


def _grown(mask: Tensor, pixels: int) -> Tensor:
    return max_pool2d(mask[None, None].float(), 2 * pixels + 1, stride=1, padding=pixels)[0, 0] > 0


def _place_mask(mask: Tensor, place: Motion) -> Tensor:
    """The object where the light's own full picture has it."""
    moved, _, _ = warp(mask[None].double(), torch.linalg.inv(place.matrix))
    return moved[0] > 0.5


def _bright(picture: Tensor, mask: Tensor) -> Tensor:
    values = picture[mask]
    return values.kthvalue(max(1, round(0.9 * values.numel()))).values.clamp_min(1e-12)


def _outline(picture: Tensor, mask: Tensor) -> Tensor:
    """Nearly 1 on whatever is lit, 0 where it is dark."""
    positive = picture.clamp_min(0)
    return positive / (positive + OUTLINE_SMALL * _bright(picture, mask))


def _logarithm(picture: Tensor, mask: Tensor) -> Tensor:
    return torch.log1p(picture.clamp_min(0) / (SMALL * _bright(picture, mask)))


def _polynomials(mask: Tensor, degree: int) -> Tensor:
    """x^i y^k on the object, i + k up to `degree`."""
    height, width = mask.shape
    y, x = torch.meshgrid(
        torch.linspace(-1, 1, height, dtype=torch.float64),
        torch.linspace(-1, 1, width, dtype=torch.float64),
        indexing="ij",
    )
    inside_ = mask.double()
    full = bool(mask.all())  # then the constant is the solver's own
    orders = [(i, k) for i in range(degree + 1) for k in range(degree + 1 - i) if not (full and i == k == 0)]
    return torch.stack([inside_ * x**i * y**k for i, k in orders])
