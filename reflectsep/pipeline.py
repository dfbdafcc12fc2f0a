"""The method, from a capture folder to its components: the order of the stages.

load -> calibrate (stack, alpha) -> scatter (n_d, C, s) -> fit -> separate
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from reflectsep.calibrate.align_options import AlignOptions
from reflectsep.calibrate.alignment import Alignment, align
from reflectsep.calibrate.exposure import developed_stream, response_of
from reflectsep.calibrate.stack import calibrate_stack, develop_pictures, without
from reflectsep.config import CalibrationSettings, FitSettings, ScatterSettings
from reflectsep.data import Capture, PhotometricStack, Scattering
from reflectsep.errors import FitError, LightError, ReflectsepError, SettingsError, SweepError
from reflectsep.fit.options import FitOptions
from reflectsep.fit.reflectance import fit_reflectance
from reflectsep.fit.sample import strewn_squares
from reflectsep.handed import learnt_document, read_handed
from reflectsep.io import calibration as calibration_file
from reflectsep.io.capture import load_capture
from reflectsep.io.files import inside
from reflectsep.io.frames import open_sweep
from reflectsep.io.pictures import read_picture
from reflectsep.io.stack import read_full, read_mask
from reflectsep.progress import Progress, expect, silent
from reflectsep.scatter.measure import measure_scattering
from reflectsep.scatter.options import HeldSweeps, ScatterOptions
from reflectsep.separation import Separation, load, separate
from reflectsep.settings import nearest
from reflectsep.summary import describe
from reflectsep.workload import Counts, reading, solving

__all__ = ["fit", "load", "load_capture"]

PREVIEW_PIXELS = 1 << 22
"""A preview is a quick look: larger pictures are halved."""


def fit(
    capture: Capture,
    *,
    settings: FitSettings | None = None,
    scatter: ScatterSettings | None = None,
    calibration: CalibrationSettings | None = None,
    heldout: Sequence[str] = (),
    alignment: Alignment | None = None,
    progress: Progress = silent,
    **changes: Any,
) -> Separation:
    """Separate a capture: the whole method, from files to components.

    Args:
        capture: from `load_capture`.
        settings: of the fit; the defaults where None.
        scatter: of the sweeps; the defaults where None.
        calibration: of what is corrected first; the defaults where None.
        heldout: lights to leave out, to compare with later.
        alignment: motions that are known; where None they are looked for as `calibration` says.
        progress: called as (stage, done, total).
        **changes: single settings of the fit by name, as in `fit(capture, scattering="none")`.

    Returns:
        The separation; `separation.save(folder)` writes it.

    Raises:
        ReflectsepError: whatever makes the capture unfit, in one line that names the file.
        TypeError: a path in place of a capture.
    """
    if not isinstance(capture, Capture):
        raise TypeError(f"fit takes a capture, got {capture!r:.80}: reflectsep.fit(reflectsep.load_capture(FOLDER))")
    settings, scatter = changed(settings or FitSettings(), changes), scatter or ScatterSettings()
    with naming(capture.folder):
        return separated(
            capture, settings, scatter, calibration or CalibrationSettings(), heldout, progress, alignment=alignment
        )


@contextmanager
def naming(folder: Path) -> Iterator[None]:
    """Errors that name no file, as of the lights or of a whole sweep, name the capture's folder."""
    try:
        yield
    except (LightError, SweepError, FitError) as error:
        if str(folder) in str(error):
            raise
        raise type(error)(f"{folder}: {error}") from error


def separated(
    capture: Capture,
    settings: FitSettings,
    scatter: ScatterSettings,
    calibration: CalibrationSettings,
    heldout: Sequence[str],
    progress: Progress,
    *,
    alignment: Alignment | None = None,
) -> Separation:
    """The stages of `fit`, one after the other."""
    clock = Clock()
    handed = read_handed(settings)
    capture, used = with_calibration(capture, calibration.file)
    capture = without(capture, heldout)
    if handed is not None:
        handed.require_capture(capture, settings, scatter)
    least = 8 if settings.scattering == "unknown" else 6
    aligned = alignment is None and calibration.registration != "none"
    swept = bool(capture.sweeps) and settings.scattering == "measured"
    foreseen, options = counts_before(capture), fit_options(settings)
    if handed is not None:
        options = dataclasses.replace(options, given=handed.learnt)
    ahead = reading(capture, foreseen, aligned=aligned, swept=swept)
    expect(progress, [*ahead, *solving(foreseen, options, swept=swept)])
    if aligned and handed is not None:
        alignment = handed.motions(capture)
    if aligned and alignment is None:
        alignment = alignment_of(capture, calibration, scatter, progress)
        clock.lap("alignment")
    progress("pictures", 0, 1)
    stack, lights = calibrate_stack(capture, minimum=least, alignment=alignment)
    progress("pictures", 1, 1)
    stack = stack if handed is None else handed.applied(stack)
    found = counts_of(stack)
    ahead = [part for part in reading(capture, found, aligned=False, swept=swept) if part.name != "pictures"]
    expect(progress, [*ahead, *solving(found, options, swept=swept)])
    clock.lap("pictures")
    held = handed.sweeps if handed is not None and handed.held else None
    scattering = measure(capture, stack, settings, scatter, progress, alignment, held)
    clock.lap("scattering")
    stack = strewn(stack, settings.share)
    fitted = fit_reflectance(stack, scattering, options, progress=progress)
    clock.lap("fit")
    document = describe(
        capture,
        stack,
        lights,
        scattering,
        fitted,
        timings_s=clock.seconds,
        settings={
            "fit": dataclasses.asdict(settings),
            "scatter": dataclasses.asdict(scatter),
            "calibration": dataclasses.asdict(calibration),
        },
        heldout=heldout,
        alignment=alignment,
    )
    if used is not None:
        document["calibration_file"] = used
    if handed is not None:
        document["globals_from"] = handed.document()
    document |= learnt_document(fitted.learnt, stack, scattering, capture.exposure_s)
    return separate(stack, scattering, fitted, document)


def strewn(stack: PhotometricStack, share: float) -> PhotometricStack:
    """The stack with only a share of its object, in squares that lie evenly over it.

    Whole squares, for what is taken from the neighbourhood; see `strewn_squares`.

    Raises:
        FitError: no pixel of the object is in them.
    """
    if share >= 1.0:
        return stack
    height, width = stack.mask.shape
    mask = stack.mask & strewn_squares((height, width), share)
    if not bool(mask.any()):
        raise FitError(f"fit.share={share:g}: no pixel of the object is in the squares that are to be fitted")
    return dataclasses.replace(stack, mask=mask)


def counts_before(capture: Capture) -> Counts:
    """How large a capture is, by its mask and one picture; what is wrong with them is said where they are used."""
    try:
        mask = read_mask(capture)
        values, _ = read_picture(inside(capture.folder, capture.full(capture.basis[0]).file))
    except (ReflectsepError, OSError):
        return Counts(size=1, pixels=1, lights=len(capture.names), channels=1)
    return Counts(size=mask.numel(), pixels=int(mask.sum()), lights=len(capture.names), channels=len(values))


def counts_of(stack: PhotometricStack) -> Counts:
    """How large a capture is."""
    lights, channels, height, width = stack.images.shape
    return Counts(size=height * width, pixels=int(stack.mask.sum()), lights=lights, channels=channels)


def changed(settings: FitSettings, changes: Mapping[str, Any]) -> FitSettings:
    """`settings` with some of them changed, and checked.

    Raises:
        SettingsError: no such setting, or an impossible value.
    """
    known = [f.name for f in dataclasses.fields(settings)]
    for name in changes:
        if name not in known:
            raise SettingsError(f"{settings.key}{name}: no such setting{nearest(name, known)}")
    return dataclasses.replace(settings, **changes)


def alignment_of(
    capture: Capture, calibration: CalibrationSettings, scatter: ScatterSettings, progress: Progress = silent
) -> Alignment:
    """Motions of a capture's pictures and sweeps; of a region those of the whole.

    A part may show too little of the object, and parts that move each its own way do not fit together.
    """
    region, capture = capture.region, dataclasses.replace(capture, region=None)
    response = response_of(capture)
    raw = read_full(capture)
    pictures, saturated = develop_pictures(capture, raw, response)
    streams = [developed_stream(capture, open_sweep(capture, sweep), response) for sweep in capture.sweeps]
    options = align_options(calibration, scatter.n_d or 1.0)
    found = align(
        capture, raw.names, pictures, saturated, read_mask(capture), streams, options=options, progress=progress
    )
    return found if region is None else found.in_window(region.x, region.y, (region.width, region.height))


def align_options(calibration: CalibrationSettings, n_d: float = 1.0) -> AlignOptions:
    """Settings of the command as the registration takes them."""
    scope = "all" if calibration.registration == "all" else "same_light"
    return AlignOptions(scope=scope, richest=calibration.motion, n_d=n_d)


def measure(
    capture: Capture,
    stack: PhotometricStack,
    settings: FitSettings,
    scatter: ScatterSettings,
    progress: Progress,
    alignment: Alignment | None = None,
    held: HeldSweeps | None = None,
) -> Scattering | None:
    """Scattering from the sweeps; None where the capture has none or the fit wants none."""
    if not capture.sweeps or settings.scattering != "measured":
        return None
    response = response_of(capture)
    streams = []
    for i, sweep in enumerate(capture.sweeps):
        if sweep.light in stack.names:
            stream = developed_stream(capture, open_sweep(capture, sweep), response)
            streams.append(stream if alignment is None else alignment.placed(i, stream))
    options = ScatterOptions(**dataclasses.asdict(scatter), held=held)
    return measure_scattering(stack, streams, options=options, progress=progress)


def fit_options(settings: FitSettings) -> FitOptions:
    """Settings of the command as the stage takes them."""
    chosen = dataclasses.asdict(settings)
    del chosen["globals_from"], chosen["share"]
    return FitOptions(**chosen)


class Clock:
    """Seconds spent in each stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """What has passed since the last lap belongs to `stage`."""
        now = time.perf_counter()
        self.seconds[stage] = round(now - self._last, 3)
        self._last = now


def with_calibration(capture: Capture, file: str | None) -> tuple[Capture, str | None]:
    """The capture with what a calibration file says, and which file that was."""
    path = capture.folder / calibration_file.FILE if file is None else Path(file)
    if file is None and not path.is_file():
        return capture, None
    return calibration_file.calibrated(capture, calibration_file.read_calibration(path)), str(path)
