"""The jobs of the command line, each a function of its settings that gives what is to be printed."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import torch
from torch import Tensor

from reflectsep import bench, exporting, presentation, simulation
from reflectsep import calibration as calibration_job
from reflectsep.checking.check import check_capture
from reflectsep.checking.display import draw, table
from reflectsep.comparison import compare_result, show_result
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
    InfoJob,
    RelightJob,
    ReportJob,
    SimulateJob,
    ViewJob,
)
from reflectsep.data import Capture, Light
from reflectsep.errors import SettingsError
from reflectsep.estimate import Part
from reflectsep.io.capture import load_capture
from reflectsep.io.files import atomic_write, refuse_existing, refuse_folder
from reflectsep.io.lights import read_lights
from reflectsep.pipeline import counts_before, fit, fit_options, with_calibration
from reflectsep.progress import Journal, Progress, Titled, silent, titled
from reflectsep.recorded import (
    LIN_LEE,
    held_out_rows,
    lin_lee_beside,
    opened_again,
    real_pictures,
    recorded_capture,
    recorded_settings,
)
from reflectsep.relight import LightMix, alphas_for, orbit, outside_basis, relight_to_folder
from reflectsep.report.sheet import motion_plot
from reflectsep.report.tone import tone, white_point
from reflectsep.room import room_beside
from reflectsep.separation import Separation, load
from reflectsep.solve.sharing import workers
from reflectsep.summary import capture_summary, summary
from reflectsep.workload import reading, reporting, solving

PREVIEW_PIXELS = 1 << 22
"""A preview is a quick look: larger pictures are halved."""
BESIDE = "Lin & Lee beside"
QUICK_S = 60.0
"""Lin & Lee's model is fitted unasked where it is expected to take no longer."""


def previews(separation: Separation) -> dict[str, Tensor]:
    """Pictures for a quick look, encoded for a screen, every component of a light with a stated white point."""
    shown: dict[str, Tensor] = {}
    parts = ("specular", "local_diffuse", "scattering", "highlight_free")
    small = {part: reduced(getattr(separation, part), PREVIEW_PIXELS) for part in parts}
    mask = reduced(separation.mask[None, None], PREVIEW_PIXELS)[0, 0] > 0.5
    small = {"original": small["highlight_free"] + small["specular"], **small}
    white = white_point(small["original"], mask)
    for i, name in enumerate(separation.basis):
        for part, stack in small.items():
            pixels = torch.from_numpy(tone(stack[i], white=white)).permute(2, 0, 1)
            shown[f"{name}_{part}"] = pixels.float() / 255.0
    if "alignment" in separation.document:
        shown["alignment"] = motion_plot(separation.document["alignment"])
    return shown


def reduced(pictures: Tensor, most: int) -> Tensor:
    """Pictures (lights, channels, height, width) halved until they have `most` pixels or fewer, means of 2 x 2."""
    parts = [picture.float() for picture in pictures]
    while parts[0][0].numel() > most:
        parts = [torch.nn.functional.avg_pool2d(part, 2, ceil_mode=True) for part in parts]
    return torch.stack(parts)


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
    with room_beside(job.out):
        return _fit_to_folder(job, progress)


def _fit_to_folder(job: FitJob, progress: Progress) -> str:
    capture = load_capture(
        job.capture,
        basis=None if job.basis is None else tuple(job.basis),
        lights_file=job.lights_file,
        region=job.region,
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
        baseline = lin_lee_beside(separation, capture, job.fit, Titled(journal, BESIDE))
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
    counts = counts_before(capture)
    without_s = fit_options(dataclasses.replace(job.fit, **LIN_LEE))
    return [*reading(capture, counts, aligned=False, swept=False), *solving(counts, without_s, swept=False)]


def parts_after(job: FitJob, capture: Capture, compared: bool) -> list[Part]:
    """What follows a fit: Lin & Lee's, and the report."""
    if not job.report:
        return []
    baseline = titled(baseline_parts(job, capture), BESIDE) if compared else []
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
    capture = opened_again(separation, folder)
    baseline = separation
    if bool(separation.s.any()):  # else it is Lin & Lee's model itself
        baseline = lin_lee_beside(separation, capture, recorded_settings(separation, job.result), progress)
    capture, pictures, still = real_pictures(separation, capture)
    return compare_result(separation, baseline, capture, pictures, Path(job.out), still=still)


def run_report(job: ReportJob, progress: Progress = silent) -> str:
    """Write the report of a result."""
    refuse_existing(Path(job.out), job.overwrite)
    separation = load(job.result)
    capture, baseline, rows = None, None, []
    named = job.capture or str(separation.document.get("capture") or "")
    if job.capture is not None or Path(named, "").is_dir():
        capture = opened_again(separation, named)
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


def run_demo(job: DemoJob, progress: Progress = silent) -> str:
    """Simulate an object, separate it, relight it, and show it beside the truth and Lin & Lee's."""
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
            # A camera that is known to stand still is not looked at for drift.
            calibration=CalibrationSettings(registration="all" if simulation.rig_of(job.rig).drift.any else "none"),
            capture=captured,
            out=result,
            overwrite=again,
            report=False,
        ),
        progress,
    )
    heldout = str(out / "capture" / "heldout.json")
    run_relight(RelightJob(result=result, lights=heldout, out=str(out / "relit"), overwrite=again), progress)
    figure = str(out / "compare.png")
    separation = load(result)
    capture = opened_again(separation, captured)
    baseline = lin_lee_beside(separation, capture, job.fit, progress)
    capture, _, still = real_pictures(separation, capture)
    compared = show_result(separation, baseline, capture, Path(figure), still=still)
    run_view(ViewJob(result=result, overwrite=again), progress)
    page = f"move the light in {out / 'result' / 'view.html'}; reflectsep report result={result} explains the fit"
    return f"{said}\n{compared}\nlook at {figure}; relit pictures are in {out / 'relit'}\n{page}"
