"""The export job: a result as files for RTI viewers and renderers, each with its distance from `relight`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from reflectsep.config import ExportJob
from reflectsep.export.harmonics import evaluated, fit_terms, quantised
from reflectsep.export.lights import Distance, distance
from reflectsep.export.textures import Textures, note, rendered, textures_of
from reflectsep.io.files import atomic_folder, refuse_folder, write_json
from reflectsep.io.pictures import read_picture, write_picture
from reflectsep.io.rti import write_ptm, write_relight
from reflectsep.progress import Progress
from reflectsep.report.tone import white_point
from reflectsep.separation import Separation, load
from reflectsep.srgb import encoded

MARKER = "relit.json"
"""In every folder that is written: what it is, and the sign that it may be replaced."""


def export(job: ExportJob, progress: Progress) -> str:
    """Write the export of a job; returns a line that says what it is and how far from `relight`.

    Raises:
        ResultError: the folder exists and may not be replaced; the result is missing or damaged.
        LightError: the directions of the result's lights are unknown.
    """
    refuse_folder(job.out, job.overwrite)
    separation = load(job.result)
    white = white_point(separation.highlight_free + separation.specular, separation.mask)
    with atomic_folder(job.out, job.overwrite) as folder:
        if job.format == "textures":
            apart = _textures(job, folder, separation, white)
        else:
            apart = _harmonics(job, folder, separation, white, progress)
        record = {"format": "reflectsep-relit/1", "export": job.format, "white": white, "tilt_deg": job.tilt_deg}
        db = {key: value if np.isfinite(value) else None for key, value in vars(apart).items()}
        write_json(folder / MARKER, {**record, "lights": {}, "distance_db": db})
    return (
        f"{job.out}: {job.format}; {apart.inside_db:.1f} dB from relight between the basis lights, "
        f"{apart.all_db:.1f} dB up to {job.tilt_deg:g} degrees off the view"
    )


def _harmonics(job: ExportJob, folder: Path, separation: Separation, white: float, progress: Progress) -> Distance:
    family = "hsh" if job.format == "relight_hsh" else "ptm"
    coefficients = fit_terms(separation, family, white=white, tilt_deg=job.tilt_deg, progress=progress)
    codes, scales, biases = quantised(coefficients)
    if job.format == "ptm":
        name = Path(job.result).resolve().name
        write_ptm(folder / f"{name}.ptm", codes.numpy(), scales=scales, biases=biases)
    else:
        write_relight(folder, codes.numpy(), family=family, scales=scales, biases=biases)
        # What the compression left of the codes is what a viewer sees.
        planes = [read_picture(folder / f"plane_{k}.jpg")[0] for k in range(len(codes))]
        codes = 255 * torch.stack(planes)[:, : codes.shape[1]].double()
    stored = torch.stack([(c.double() / 255 - b) * s for c, s, b in zip(codes, scales, biases, strict=True)])

    def model(direction: Tensor) -> Tensor:
        return evaluated(stored, family, direction)

    return distance(separation, model, white=white, tilt_deg=job.tilt_deg)


def _textures(job: ExportJob, folder: Path, separation: Separation, white: float) -> Distance:
    found: list[Textures] = []

    def model(direction: Tensor) -> Tensor:
        # Made at the first call: `distance` has made sure by then that the lights are known.
        if not found:
            found.append(textures_of(separation, white=white))
        return rendered(found[0], direction)

    apart = distance(separation, model, white=white, tilt_deg=job.tilt_deg)
    made = found[0]
    for name, picture, curve in (
        ("base_colour", made.base_colour, True),
        ("specular", made.specular, False),
        ("scattering_colour", made.scattering_colour, False),
    ):
        write_picture(folder / f"{name}.exr", picture.float())
        write_picture(folder / f"{name}.png", encoded(picture) if curve else picture.clamp(0.0, 1.0))
    write_picture(folder / "normal.png", 0.5 * made.normal + 0.5, bits=16)
    text = note(made, white, apart.inside_db, apart.all_db)
    (folder / "README.txt").write_text(text, encoding="utf-8")
    return apart
