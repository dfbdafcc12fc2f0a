"""The order of the stages, and the jobs of the command line.

load -> calibrate (stack, alpha) -> scatter (n_d, C, s) -> fit -> separate -> save
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from reflectsep import bench, exporting, presentation, simulation
from reflectsep import calibration as calibration_job
from reflectsep.calibrate.align_options import AlignOptions
from reflectsep.calibrate.alignment import Alignment, align, aligned_stream
from reflectsep.calibrate.exposure import developed_stream, response_of
from reflectsep.calibrate.heldout import HeldOutPictures, Still, held_out_pictures, still_of
from reflectsep.calibrate.stack import calibrate_stack, develop_pictures, without
from reflectsep.checking.check import check_capture
from reflectsep.checking.display import draw, table
from reflectsep.comparison import beside, compare_result, left_out
from reflectsep.config import (
    CalibrateJob,
    CalibrationSettings,
    CaptureAndFitJob,
    CaptureJob,
    CheckJob,
    CompareJob,
    DemoJob,
    ExportJob,
    FitJob,
    FitSettings,
    InfoJob,
    RelightJob,
    ReportJob,
    ScatterSettings,
    SimulateJob,
    ViewJob,
)
from reflectsep.data import Capture, Light, PhotometricStack, Scattering
from reflectsep.errors import FitError, LightError, ReflectsepError, ResultError, SettingsError, SweepError
from reflectsep.estimate import Part
from reflectsep.fit.options import FitOptions
from reflectsep.fit.reflectance import fit_reflectance
from reflectsep.io import calibration as calibration_file
from reflectsep.io.capture import load_capture
from reflectsep.io.files import atomic_write, inside, refuse_existing, refuse_folder
from reflectsep.io.frames import open_sweep
from reflectsep.io.lights import read_lights
from reflectsep.io.pictures import read_picture
from reflectsep.io.stack import read_full, read_mask
from reflectsep.progress import Journal, Progress, Titled, expect, silent, titled
from reflectsep.relight import LightMix, alphas_for, orbit, outside_basis, relight_to_folder
from reflectsep.report.figures import HeldOut
from reflectsep.report.sheet import motion_plot
from reflectsep.report.tone import tone, white_point
from reflectsep.scatter.measure import measure_scattering
from reflectsep.scatter.options import ScatterOptions
from reflectsep.separation import Separation, load, separate
from reflectsep.settings import nearest
from reflectsep.solve.sharing import workers
from reflectsep.summary import capture_summary, describe, summary
from reflectsep.workload import Counts, reading, reporting, solving

__all__ = ["fit", "load", "load_capture"]


def fit(
    capture: Capture,
    *,
    settings: FitSettings | None = None,
    scatter: ScatterSettings | None = None,
    calibration: CalibrationSettings | None = None,
    heldout: Sequence[str] = (),
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
        return separated(capture, settings, scatter, calibration or CalibrationSettings(), heldout, progress)


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
) -> Separation:
    """The stages of `fit`, one after the other."""
    clock = Clock()
    capture, used = with_calibration(capture, calibration.file)
    capture = without(capture, heldout)
    least = 8 if settings.scattering == "unknown" else 6
    aligned, swept = calibration.registration != "none", bool(capture.sweeps) and settings.scattering == "measured"
    foreseen, options = counts_before(capture), fit_options(settings)
    ahead = reading(capture, foreseen, aligned=aligned, swept=swept)
    expect(progress, [*ahead, *solving(foreseen, options, swept=swept)])
    alignment = None
    if calibration.registration != "none":
        alignment = alignment_of(capture, calibration, scatter, progress)
        clock.lap("alignment")
    progress("pictures", 0, 1)
    stack, lights = calibrate_stack(capture, minimum=least, alignment=alignment)
    progress("pictures", 1, 1)
    found = counts_of(stack)
    ahead = [part for part in reading(capture, found, aligned=False, swept=swept) if part.name != "pictures"]
    expect(progress, [*ahead, *solving(found, options, swept=swept)])
    clock.lap("pictures")
    scattering = measure(capture, stack, settings, scatter, progress, alignment)
    clock.lap("scattering")
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
    return separate(stack, scattering, fitted, document)


def counts_before(capture: Capture) -> Counts:
    """How large a capture is, by its mask and one picture; what is wrong with them is said where they are used."""
    try:
        pixels = int(read_mask(capture).sum())
        values, _ = read_picture(inside(capture.folder, capture.full(capture.basis[0]).file))
    except (ReflectsepError, OSError):
        return Counts(size=1, pixels=1, lights=len(capture.names), channels=1)
    return Counts(size=values[0].numel(), pixels=pixels, lights=len(capture.names), channels=len(values))


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
    """Motions of a capture's pictures and sweeps."""
    response = response_of(capture)
    raw = read_full(capture)
    pictures, saturated = develop_pictures(capture, raw, response)
    streams = [developed_stream(capture, open_sweep(capture, sweep), response) for sweep in capture.sweeps]
    options = align_options(calibration, scatter.n_d or 1.0)
    return align(
        capture, raw.names, pictures, saturated, read_mask(capture), streams, options=options, progress=progress
    )


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
) -> Scattering | None:
    """Scattering from the sweeps; None where the capture has none or the fit wants none."""
    if not capture.sweeps or settings.scattering != "measured":
        return None
    response = response_of(capture)
    streams = []
    for i, sweep in enumerate(capture.sweeps):
        if sweep.light in stack.names:
            stream = developed_stream(capture, open_sweep(capture, sweep), response)
            streams.append(stream if alignment is None else aligned_stream(stream, alignment.sweeps[i]))
    options = ScatterOptions(**dataclasses.asdict(scatter))
    return measure_scattering(stack, streams, options=options, progress=progress)


def fit_options(settings: FitSettings) -> FitOptions:
    """Settings of the command as the stage takes them."""
    return FitOptions(**dataclasses.asdict(settings))


LIN_LEE = "Lin & Lee beside"
QUICK_S = 60.0
"""Lin & Lee's model is fitted unasked where it is expected to take no longer."""


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


def previews(separation: Separation) -> dict[str, Tensor]:
    """Pictures for a quick look, encoded for a screen, every component of a light with a stated white point."""
    shown: dict[str, Tensor] = {}
    original = separation.highlight_free + separation.specular
    white = white_point(original, separation.mask)
    for i, name in enumerate(separation.basis):
        parts = {"original": original, "specular": separation.specular, "local_diffuse": separation.local_diffuse}
        parts |= {"scattering": separation.scattering, "highlight_free": separation.highlight_free}
        for part, stack in parts.items():
            pixels = torch.from_numpy(tone(stack[i], white=white)).permute(2, 0, 1)
            shown[f"{name}_{part}"] = pixels.float() / 255.0
    if "alignment" in separation.document:
        shown["alignment"] = motion_plot(separation.document["alignment"])
    return shown


def run_simulate(job: SimulateJob, progress: Progress = silent) -> str:
    """Write a simulated capture."""
    return simulation.write(job, progress)


def run_capture(job: CaptureJob, progress: Progress = silent) -> str:
    """Take the pictures of a session, or go on with it."""
    return bench.capture(job, progress)


def run_capture_and_fit(job: CaptureAndFitJob, progress: Progress = silent) -> str:
    """Take the pictures of a session and separate them."""
    refuse_folder(job.result, job.overwrite)
    taken = bench.capture(
        CaptureJob(object=job.object, rig=job.rig, out=job.out, resume=job.resume, zeroed=job.zeroed), progress
    )
    fitted = run_fit(
        FitJob(
            object=job.object,
            rig=job.rig,
            fit=job.fit,
            scatter=job.scatter,
            capture=job.out,
            out=job.result,
            overwrite=job.overwrite,
        ),
        progress,
    )
    return f"{taken}\n{fitted}"


def run_fit(job: FitJob, progress: Progress = silent) -> str:
    """Separate a capture into a result folder."""
    refuse_folder(job.out, job.overwrite)
    capture = load_capture(
        job.capture, basis=None if job.basis is None else tuple(job.basis), lights_file=job.lights_file
    )
    compared = wants_baseline(job, capture)
    journal = Journal(progress, after=parts_after(job, capture, compared))
    separation = fit(
        capture,
        settings=job.fit,
        scatter=job.scatter,
        calibration=job.calibration,
        heldout=tuple(job.heldout or ()),
        progress=journal,
    )
    if job.lights_file is not None:
        document = {**separation.document, "lights_file": str(Path(job.lights_file).resolve())}
        separation = dataclasses.replace(separation, document=document)
    first = workers().first  # of a shared run one process writes
    if first:
        separation.save(job.out, overwrite=job.overwrite, previews=previews(separation))
    said = f"{job.out}: {summary(separation)}"
    baseline = None
    if compared and bool(separation.s.any()):
        baseline = lin_lee_beside(separation, capture, job.fit, Titled(journal, LIN_LEE))
    if not first:
        return said
    if job.report:
        out = Path(job.out) / "report.html"
        rows = held_out_rows(separation, baseline or separation, capture)
        presentation.report(out, separation, capture, result=job.out, baseline=baseline, heldout=rows, progress=journal)
        said += f"\n  report    {out}"
    log = f"{datetime.now(UTC).isoformat(timespec='seconds')} fit of {job.capture}\n{journal.text()}"
    atomic_write(Path(job.out) / "log.txt", lambda path: path.write_text(log, encoding="utf-8"))
    return said


def wants_baseline(job: FitJob, capture: Capture) -> bool:
    """Whether Lin & Lee's model is to be fitted as well: where that is said, or quick."""
    swept = bool(capture.sweeps) and job.fit.scattering == "measured"
    if not job.report or not swept or job.baseline is not None:
        return job.report and bool(job.baseline)
    return sum(part.expected_s for part in baseline_parts(job, capture)) <= QUICK_S


def baseline_parts(job: FitJob, capture: Capture) -> list[Part]:
    """Parts of the fit of Lin & Lee's model."""
    counts, aligned = counts_before(capture), job.calibration.registration != "none"
    without_s = fit_options(dataclasses.replace(job.fit, scattering="none"))
    return [*reading(capture, counts, aligned=aligned, swept=False), *solving(counts, without_s, swept=False)]


def parts_after(job: FitJob, capture: Capture, compared: bool) -> list[Part]:
    """What follows a fit: Lin & Lee's, and the report."""
    if not job.report:
        return []
    baseline = titled(baseline_parts(job, capture), LIN_LEE) if compared else []
    return [*baseline, *reporting(counts_before(capture), len(capture.sweeps))]


def run_relight(job: RelightJob, progress: Progress = silent) -> str:
    """Write pictures under other lights."""
    refuse_folder(job.out, job.overwrite)
    presentation.require(job)
    separation = load(job.result)
    if job.format != "exr":
        return presentation.screen_pictures(job, separation, mixes(job, separation), progress)
    lights = mixes(job, separation)
    files = relight_to_folder(separation, lights, job.out, overwrite=job.overwrite, progress=progress)
    far = sum(outside_basis(mix.alpha) for mix in lights.values())
    said = f"; {far} of them extrapolated: light outside the basis lights" if far else ""
    return f"{job.out}: {len(files)} picture{'s' if len(files) > 1 else ''}{said}"


def mixes(job: RelightJob, separation: Separation) -> Mapping[str, LightMix]:
    """The lights of a relighting job as mixes of the basis lights."""
    if job.alpha is not None:
        a_1, a_2, a_3 = (job.intensity * value for value in job.alpha)
        return {"relit": LightMix(alpha=(a_1, a_2, a_3))}
    lights: Sequence[Light]
    if job.direction is not None:
        x, y, z = job.direction
        lights = [Light(name="relit", direction=(x, y, z), intensity=(job.intensity,))]
    elif job.orbit is not None:
        lights = orbit(job.orbit, job.elevation_deg, intensity=job.intensity)
    elif job.lights is not None:
        read = read_lights(job.lights).values()
        lights = [dataclasses.replace(v, intensity=tuple(job.intensity * i for i in v.intensity)) for v in read]
    else:
        raise SettingsError("relight: give one of lights, direction, alpha or orbit")
    return alphas_for(lights, separation.light_vectors)


def run_compare(job: CompareJob, progress: Progress = silent) -> str:
    """Draw a result beside Lin & Lee's and, for held-out lights, beside the real pictures."""
    refuse_existing(Path(job.out), job.overwrite)
    separation = load(job.result)
    folder = recorded_capture(separation, job.result) if job.capture is None else Path(job.capture)
    lights_file = separation.document.get("lights_file")
    capture = load_capture(folder, basis=separation.basis, lights_file=lights_file)
    baseline = separation
    if bool(separation.s.any()):  # else it is Lin & Lee's model itself
        baseline = lin_lee_beside(separation, capture, recorded_settings(separation, job.result), progress)
    capture, pictures, still = real_pictures(separation, capture)
    return compare_result(separation, baseline, capture, pictures, Path(job.out), still=still)


def recorded_capture(separation: Separation, result: str) -> Path:
    """Folder of the capture that a result was made from.

    Raises:
        ResultError: the result does not say, or the folder is gone.
    """
    named = separation.document.get("capture")
    if not named or not Path(str(named)).is_dir():
        raise ResultError(f"{result}: its capture {str(named)!r} is not there; give capture=FOLDER to compare with")
    return Path(str(named))


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


def run_report(job: ReportJob, progress: Progress = silent) -> str:
    """Write the report of a result."""
    refuse_existing(Path(job.out), job.overwrite)
    separation = load(job.result)
    capture, baseline, rows = None, None, []
    named = job.capture or str(separation.document.get("capture") or "")
    if job.capture is not None or Path(named, "").is_dir():
        lights_file = separation.document.get("lights_file")
        capture = load_capture(named, basis=separation.basis, lights_file=lights_file)
        # A result without scattering is Lin & Lee's model itself.
        if job.baseline and bool(separation.s.any()):
            journal = Journal(progress, after=reporting(counts_before(capture), len(capture.sweeps)))
            baseline = lin_lee_beside(separation, capture, recorded_settings(separation, job.result), journal)
        rows = held_out_rows(separation, baseline or separation, capture)
    presentation.report(
        Path(job.out),
        separation,
        capture,
        result=job.result,
        baseline=baseline,
        heldout=rows,
        frames=job.frames or (),
        progress=progress,
    )
    return f"{job.out}: open it in a browser, or print it"


def lin_lee_beside(separation: Separation, capture: Capture, settings: FitSettings, progress: Progress) -> Separation:
    """Lin & Lee's model fitted to the same pictures as a result."""
    return fit(
        capture,
        settings=settings,
        calibration=recorded_calibration(separation),
        heldout=[str(name) for name in separation.document.get("heldout", [])],
        progress=progress,
        scattering="none",
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


def run_export(job: ExportJob, progress: Progress = silent) -> str:
    """Write a result as files that other programs open."""
    return exporting.export(job, progress)


def run_view(job: ViewJob, progress: Progress = silent) -> str:
    """Write the relighting page of a result, or of two side by side."""
    return presentation.view(job, progress)


def run_info(job: InfoJob, progress: Progress = silent) -> str:  # noqa: ARG001  (all jobs are called alike)
    """Say what is in a capture or a result."""
    path = Path(job.path)
    if (path / "separation.json").is_file():
        return summary(load(path), full=True)
    return capture_summary(load_capture(path))


class Report(str):
    """Text to print, and the exit code of the command that prints it."""

    __slots__ = ("exit_code",)
    exit_code: int


def run_check(job: CheckJob, progress: Progress = silent) -> Report:
    """Look at a capture before a fit; the exit code is 1 where something is bad."""
    if job.sheet is not None:
        refuse_existing(Path(job.sheet), job.overwrite)
    capture = load_capture(
        job.capture, basis=None if job.basis is None else tuple(job.basis), lights_file=job.lights_file
    )
    capture, _ = with_calibration(capture, None)
    result = check_capture(capture, progress)
    if job.sheet is not None:
        draw(result, job.sheet)
    text = json.dumps(result.document(), indent=1) if job.json else table(result, colour=sys.stdout.isatty())
    report = Report(text)
    report.exit_code = 1 if result.verdict == "bad" else 0
    return report


def run_calibrate(job: CalibrateJob, progress: Progress = silent) -> str:
    """Find lights and response, and write them beside the capture."""
    return calibration_job.calibrate(job, progress)


def with_calibration(capture: Capture, file: str | None) -> tuple[Capture, str | None]:
    """The capture with what a calibration file says, and which file that was."""
    path = capture.folder / calibration_file.FILE if file is None else Path(file)
    if file is None and not path.is_file():
        return capture, None
    return calibration_file.calibrated(capture, calibration_file.read_calibration(path)), str(path)


def run_demo(job: DemoJob, progress: Progress = silent) -> str:
    """Simulate, fit, relight and compare a small object."""
    out = Path(job.out)
    refuse_existing(out, job.overwrite)
    captured, result = str(out / "capture"), str(out / "result")
    again = job.overwrite
    run_simulate(SimulateJob(object=job.object, rig=job.rig, out=captured, overwrite=again), progress)
    said = run_fit(
        FitJob(
            object=job.object,
            rig=job.rig,
            fit=job.fit,
            scatter=job.scatter,
            capture=captured,
            out=result,
            overwrite=again,
        ),
        progress,
    )
    heldout = str(out / "capture" / "heldout.json")
    run_relight(RelightJob(result=result, lights=heldout, out=str(out / "relit"), overwrite=again), progress)
    figure = str(out / "compare.png")
    compared = run_compare(CompareJob(result=result, out=figure, overwrite=again), progress)
    run_view(ViewJob(result=result, overwrite=again), progress)
    pages = f"read {out / 'result' / 'report.html'}; move the light in {out / 'result' / 'view.html'}"
    return f"{said}\n{compared}\nlook at {figure}; relit pictures are in {out / 'relit'}\n{pages}"
