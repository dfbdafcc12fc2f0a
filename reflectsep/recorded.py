"""A result's capture as it was fitted: for Lin & Lee's model beside it, and to judge both by real pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from reflectsep.calibrate.alignment import Alignment
from reflectsep.calibrate.heldout import HeldOutPictures, Still, held_out_pictures, still_of
from reflectsep.comparison import beside, left_out
from reflectsep.config import CalibrationSettings, FitSettings
from reflectsep.data import Capture
from reflectsep.errors import ResultError, SettingsError
from reflectsep.io.capture import load_capture
from reflectsep.pipeline import align_options, fit, with_calibration
from reflectsep.progress import Progress
from reflectsep.report.figures import HeldOut
from reflectsep.separation import Separation

LIN_LEE: dict[str, Any] = {"scattering": "none", "globals_from": None}
"""Settings of the fit that make it Lin & Lee's model, whose globals are its own."""


def recorded_capture(separation: Separation, result: str) -> Path:
    """Folder of the capture that a result was made from.

    Raises:
        ResultError: the result does not say, or the folder is gone.
    """
    named = separation.document.get("capture")
    if not named or not Path(str(named)).is_dir():
        raise ResultError(f"{result}: its capture {str(named)!r} is not there; give capture=FOLDER to compare with")
    return Path(str(named))


def opened_again(separation: Separation, folder: Path | str) -> Capture:
    """The capture in `folder` with the basis, the list of lights and the region that a result was made with.

    Raises:
        CaptureError, LightError: as `load_capture`.
        ResultError: the result's region is none.
    """
    document = separation.document
    region = document.get("region")
    if region is not None and not (
        isinstance(region, list) and len(region) == 4 and all(type(v) is int for v in region)
    ):
        raise ResultError(f"{folder}: its result has region {region!r:.80}; x, y, width, height were expected")
    return load_capture(folder, basis=separation.basis, lights_file=document.get("lights_file"), region=region)


def recorded_settings(separation: Separation, result: str) -> FitSettings:
    """The fit's settings that a result names.

    Raises:
        ResultError: it names none, or none that can be.
    """
    try:
        return FitSettings(**separation.document["settings"]["fit"])
    except (KeyError, TypeError, SettingsError) as error:
        raise ResultError(f"{result}: separation.json has no usable settings.fit ({error})") from error


def recorded_calibration(separation: Separation) -> CalibrationSettings:
    """The calibration's settings that a result names; nothing corrected where it names none."""
    given = separation.document.get("settings", {}).get("calibration")
    return CalibrationSettings(registration="none") if given is None else CalibrationSettings(**given)


def recorded_alignment(separation: Separation) -> Alignment | None:
    """The motions that a result was corrected by; None where it names none.

    Raises:
        ResultError: they are none that can be.
    """
    found = separation.document.get("alignment")
    try:
        return None if found is None else Alignment.from_document(found)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ResultError(
            f"{separation.document.get('capture')}: its result has no usable alignment ({error})"
        ) from error


def lin_lee_beside(separation: Separation, capture: Capture, settings: FitSettings, progress: Progress) -> Separation:
    """Lin & Lee's model, whose lobe is a power of a cosine, fitted to a result's pictures, moved as these were."""
    return fit(
        capture,
        settings=settings,
        calibration=recorded_calibration(separation),
        heldout=[str(name) for name in separation.document.get("heldout", [])],
        alignment=recorded_alignment(separation),
        progress=progress,
        **LIN_LEE,
    )


def held_out_rows(separation: Separation, baseline: Separation, capture: Capture) -> list[HeldOut]:
    """Lights with a real picture that the fit never saw."""
    if separation.light_vectors is None:
        return []
    capture, pictures, still = real_pictures(separation, capture)
    return left_out(separation, baseline, capture, pictures) + beside(separation, baseline, capture, still)


def real_pictures(separation: Separation, capture: Capture) -> tuple[Capture, HeldOutPictures | None, Still]:
    """The capture with the result's calibration, its held-out pictures, and what these are registered against."""
    calibration = recorded_calibration(separation)
    options = None if calibration.registration == "none" else align_options(calibration)
    capture, _ = with_calibration(capture, calibration.file)
    names = [str(name) for name in separation.document.get("heldout", [])]
    pictures = held_out_pictures(capture, names, options) if names else None
    return capture, pictures, still_of(capture, options)
