"""The jobs that show a result: the report, the relighting page, pictures and films for a screen."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from reflectsep.calibrate.exposure import developed_stream, response_of
from reflectsep.calibrate.stack import calibrate_stack, without
from reflectsep.config import CalibrationSettings, FitSettings, RelightJob, ScatterSettings, ViewJob
from reflectsep.data import Capture, PhotometricStack, Vector
from reflectsep.errors import ReflectsepError, SettingsError
from reflectsep.io.files import atomic_folder, refuse_existing
from reflectsep.io.film import SUFFIX, require_film, write_film
from reflectsep.io.frames import open_sweep
from reflectsep.io.lights import read_lights
from reflectsep.io.pictures import write_picture
from reflectsep.progress import Progress
from reflectsep.relight import LightMix, relit_pictures, write_marker
from reflectsep.report.figures import HeldOut
from reflectsep.report.sweeps import SweepView, view_sweep
from reflectsep.report.tone import tone, tone_16, white_point
from reflectsep.report.writer import Facts, write_report
from reflectsep.separation import Separation, load
from reflectsep.settings import shown as spelt
from reflectsep.viewer.page import Shown, write_page


def view(job: ViewJob, progress: Progress) -> str:
    """Write the relighting page of a job; returns lines that say what was written and how exact it is.

    Raises:
        ResultError: a result that is missing or damaged, or a page that is there and may not be replaced.
        SettingsError: a result compared with itself.
    """
    out = Path(job.out)
    refuse_existing(out, job.overwrite)
    folders = [Path(job.result)] + ([] if job.other is None else [Path(job.other)])
    if len(folders) == 2 and folders[0].resolve() == folders[1].resolve():
        raise SettingsError(f"other={job.other}: is the result itself; give another one to compare with")
    separations = [load(folder) for folder in folders]
    names = [folder.resolve().name for folder in folders]
    if len(names) == 1:
        names = [str(separations[0].document.get("object") or names[0])]
    results = [shown(separation, name) for separation, name in zip(separations, names, strict=True)]
    exact = write_page(
        out, results, max_pixels=round(1e6 * job.max_megapixels), measured=job.measured, progress=progress
    )
    lines = [f"{out}: {out.stat().st_size / 1e6:.1f} MB; open it in a browser, it needs nothing else"]
    for result, found in zip(results, exact, strict=True):
        lines.append(
            f"  {result.name}: basis lights {found.psnr_db:.1f} dB from the result, "
            f"{100 * found.within_one:.2f} % of the values within one of 255 steps"
        )
    return "\n".join(lines)


def shown(separation: Separation, name: str) -> Shown:
    """A result as it goes into a page: its white is that of its basis pictures."""
    white = white_point(separation.highlight_free + separation.specular, separation.mask)
    return Shown(name=name, separation=separation, white=white)


def report(
    out: Path,
    separation: Separation,
    capture: Capture | None,
    *,
    result: str,
    baseline: Separation | None = None,
    heldout: Sequence[HeldOut] = (),
    frames: Sequence[int] = (),
    progress: Progress,
) -> None:
    """Write the report of a result; what its capture no longer tells is left out, and the report says why.

    Raises:
        ReflectsepError: `frames` are asked for by number and cannot be shown.
    """
    stack: PhotometricStack | None = None
    views: tuple[SweepView, ...] = ()
    notes: list[str] = []
    progress("report", 0, 3)
    if capture is None:
        notes.append("The capture is not there: its pictures, sweeps and exposures are not in this report.")
    else:
        try:
            kept = without(capture, [str(name) for name in separation.document.get("heldout", [])])
            stack, _ = calibrate_stack(kept, minimum=len(kept.names))
            progress("report", 1, 3)
            views = sweep_views(kept, stack, separation, frames)
        except ReflectsepError as error:
            if frames:  # asked for by number: not to be left out
                raise
            notes.append(f"Of the capture not all could be read again: {error}")
    progress("report", 2, 3)
    facts = Facts(
        name=Path(result).resolve().name,
        separation=separation,
        command=command(separation, result),
        capture=capture,
        stack=stack,
        sweeps=views,
        baseline=baseline,
        heldout=heldout,
        directions=directions(capture, [light.light for light in heldout]),
        notes=tuple(notes),
    )
    write_report(out, facts)
    progress("report", 3, 3)


def directions(capture: Capture | None, names: Sequence[str]) -> dict[str, Vector]:
    """Directions of held-out lights: of the capture itself, or of the list beside it."""
    if capture is None:
        return {}
    lights = dict(capture.lights)
    listed = capture.folder / "heldout.json"
    if listed.is_file():
        lights |= read_lights(listed)
    return {name: found for name in names if name in lights and (found := lights[name].direction) is not None}


def sweep_views(
    capture: Capture, stack: PhotometricStack, separation: Separation, frames: Sequence[int] = ()
) -> tuple[SweepView, ...]:
    """Every sweep that the result was made from, as the report shows it; of the first the `frames` are shown."""
    lit = {(s["light"], s["direction"]): s["lit_frames"] for s in separation.document.get("sweeps", [])}
    response = response_of(capture)
    views = []
    for sweep in capture.sweeps:
        if (sweep.light, sweep.direction) in lit and sweep.light in stack.names:
            stream = developed_stream(capture, open_sweep(capture, sweep), response)
            lit_frames = float(lit[sweep.light, sweep.direction])
            chosen = () if views else frames
            views.append(view_sweep(stack, stream, n_d=float(separation.n_d), lit_frames=lit_frames, frames=chosen))
    return tuple(views)


def command(separation: Separation, result: str) -> str:
    """The command that makes a result again, with every setting that is not the default."""
    document = separation.document
    words = ["reflectsep", "fit", f"capture={document.get('capture', 'FOLDER')}", f"out={result}"]
    words.append(f"basis={spelt(list(separation.basis))}")
    if document.get("heldout"):
        words.append(f"heldout={spelt(list(document['heldout']))}")
    if document.get("lights_file"):
        words.append(f"lights_file={document['lights_file']}")
    defaults = (("fit", FitSettings()), ("scatter", ScatterSettings()), ("calibration", CalibrationSettings()))
    for group, default in defaults:
        usual = dataclasses.asdict(default)
        for name, value in document.get("settings", {}).get(group, {}).items():
            if name in usual and value != usual[name]:
                words.append(f"{group}.{name}={spelt(value)}")
    return shlex.join(words)


def require(job: RelightJob) -> None:
    """Refuse, before any work is done for it, a film that cannot be written here.

    Raises:
        MissingExtraError: PyAV is needed and not installed.
    """
    if job.format not in ("exr", "png"):
        require_film(Path(job.out), job.format)


def screen_pictures(job: RelightJob, separation: Separation, mixes: Mapping[str, LightMix], progress: Progress) -> str:
    """Write relit pictures for a screen: a PNG each, or one film; returns a line that says so.

    All share one white, that of the basis pictures, so that lights can be compared and a film does not flicker.

    Raises:
        LightError: a relit picture that is not finite.
        ResultError: the folder exists and may not be replaced.
    """
    white = white_point(separation.highlight_free + separation.specular, separation.mask) / 2.0**job.exposure_ev
    curve = tone_16 if job.format == "ffv1" else tone

    def frames() -> Iterator[tuple[str, np.ndarray]]:
        for done, (name, picture) in enumerate(relit_pictures(separation, mixes), start=1):
            yield name, curve(picture, white=white)
            progress("relight", done, len(mixes))

    with atomic_folder(job.out, job.overwrite) as folder:
        if job.format in ("exr", "png"):
            for name, pixels in frames():
                write_picture(folder / f"{name}.png", torch.from_numpy(pixels).permute(2, 0, 1))
            said = f"{job.out}: {len(mixes)} picture{'s' if len(mixes) > 1 else ''}"
        else:
            film = f"film{SUFFIX[job.format]}"
            count = write_film(folder / film, (pixels for _, pixels in frames()), kind=job.format, fps=job.fps)
            said = f"{Path(job.out) / film}: {count} frames, {count / job.fps:.1f} s"
        write_marker(folder, mixes)
    return f"{said}; white is {white:.4g} in the capture's units"
