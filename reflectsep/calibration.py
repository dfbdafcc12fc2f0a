"""The calibrate job: lights from balls, strengths, and the response of the camera, written beside the capture."""

from __future__ import annotations

from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from reflectsep.calibrate.alpha import report_alpha
from reflectsep.calibrate.ball import find_ball_circle
from reflectsep.calibrate.bracket import estimate_response, fit_gamma
from reflectsep.calibrate.chrome import (
    Circle,
    chrome_lights,
    compare_lights,
    diffuse_lights,
    disc,
    find_circle,
)
from reflectsep.calibrate.intensity import joint_intensities
from reflectsep.calibrate.stack import calibrate_stack
from reflectsep.config import CalibrateJob
from reflectsep.data import Capture, Light, Vector
from reflectsep.errors import CaptureError, LightError, SettingsError
from reflectsep.io.calibration import FILE, Calibration, write_calibration
from reflectsep.io.capture import load_capture
from reflectsep.io.files import refuse_existing
from reflectsep.io.pictures import read_picture
from reflectsep.io.plain import pictures_by_light
from reflectsep.progress import Progress


def calibrate(job: CalibrateJob, progress: Progress) -> str:
    """Find what the job asks for, write it, and say where sources disagree.

    Raises:
        ReflectsepError: a ball that is not found, a bracket that gives no curve, or nothing to do.
    """
    capture = load_capture(job.capture)
    out = Path(job.out) if job.out else capture.folder / FILE
    refuse_existing(out, job.overwrite)
    lights: dict[str, Light] = dict(capture.lights)
    notes: dict[str, Any] = {"created": datetime.now(UTC).isoformat(timespec="seconds")}
    said: list[str] = []
    if job.chrome is not None:
        progress("chrome ball", 0, 1)
        lights = _chrome(job, capture, notes, said)
        progress("chrome ball", 1, 1)
    if job.intensity != "keep":
        lights = _intensities(job, replace(capture, lights=lights), notes, said)
    response = _response(job, capture, notes, said) if job.response != "keep" else None
    if not said:
        raise SettingsError("calibrate: nothing to do; give chrome=FOLDER, intensity=..., or response=...")
    write_calibration(out, Calibration(lights=lights, response=response, notes=notes))
    return "\n".join([f"{out}: written; a fit of captures in its folder uses it", *said])


def _chrome(job: CalibrateJob, capture: Capture, notes: dict[str, Any], said: list[str]) -> dict[str, Light]:
    assert job.chrome is not None
    names = list(capture.names)
    pictures, mask = _ball(Path(job.chrome), names)
    circle = _circle(job.circle, pictures, mask)
    view = capture.view
    found = chrome_lights(names, pictures, [circle], view)
    lights = {light.light: light.direction for light in found}
    listed = {n: capture.lights[n].direction for n in names if capture.lights[n].direction is not None}
    differences = compare_lights({n: d for n, d in listed.items() if d is not None}, lights)
    notes["chrome"] = {"circle": asdict(circle), "differences": [asdict(d) for d in differences]}
    said.append(
        f"  ball at ({circle.x:.1f}, {circle.y:.1f}), radius {circle.radius:.1f} px, outline within "
        f"{circle.residual_px:.2f} px; a pixel of the highlight is {found[0].position_deg:.1f} degrees"
    )
    for difference in differences:
        said.append(
            f"  light {difference.light}: ball and list {difference.angle_deg:.2f} degrees apart; the ball's is used"
        )
    return {name: replace(light, direction=lights.get(name, light.direction)) for name, light in capture.lights.items()}


def _intensities(job: CalibrateJob, capture: Capture, notes: dict[str, Any], said: list[str]) -> dict[str, Light]:
    names = list(capture.names)
    directions: dict[str, Vector] = {}
    for name in names:
        direction = capture.lights[name].direction
        if direction is None:
            raise LightError(f"{capture.folder}: light {name} has no direction, and its intensity needs one")
        directions[name] = direction
    if job.intensity == "sphere":
        if job.matte is None:
            raise SettingsError("intensity=sphere: give matte=FOLDER, pictures of a matte ball of one colour")
        pictures, mask = _ball(Path(job.matte), names)
        circle = _circle(None, pictures, mask)
        spheres = diffuse_lights(names, pictures, circle, directions)
        unit = spheres[0].intensity
        strengths = {sphere.light: sphere.intensity / unit for sphere in spheres}
        notes["intensity"] = {"matte ball": [asdict(sphere) for sphere in spheres]}
        worst = max(spheres, key=lambda sphere: sphere.error)
        said.append(f"  matte ball: explained to {worst.error:.1%} at worst (light {worst.light})")
    else:
        stack, _ = calibrate_stack(capture, minimum=4)
        unknown = [replace(capture.lights[n], direction=None) for n in stack.names]
        alpha = report_alpha(stack, unknown).alpha  # from the pictures alone
        strengths, residual = joint_intensities(stack.names, directions, alpha)
        notes["intensity"] = {"pictures": {"residual": residual}}
        said.append(f"  strengths jointly from the pictures, equations left with {residual:.1%}")
    changes = []
    for name in names:
        listed = capture.lights[name].intensity
        if len(listed) == 1:
            changes.append(f"{name} {100 * (strengths[name] / listed[0] - 1):+.1f} %")
    said.append("  intensity against the list's: " + ", ".join(changes) + "; these are used")
    return {
        name: replace(light, intensity=(strengths[name],)) if name in strengths else light
        for name, light in capture.lights.items()
    }


def _response(
    job: CalibrateJob, capture: Capture, notes: dict[str, Any], said: list[str]
) -> tuple[tuple[float, float], ...]:
    assert job.response != "keep"
    light = next((name for name in capture.names if capture.bracketed(name)), None)
    if light is None:
        raise CaptureError(
            f"{capture.folder}: no light has several exposures, and a response needs a bracket of 3 or more"
        )
    shots = [p for p in capture.images if p.kind == "full" and p.light == light and p.exposure_s is not None]
    codes, exposures = [], []
    for shot in shots:
        values, _ = read_picture(capture.folder / shot.file)
        codes.append((values * 255).round().clamp(0, 255).to(torch.uint8).permute(1, 2, 0).numpy())
        exposures.append(float(shot.exposure_s or 0.0))
    values, radiances = estimate_response(codes, exposures, job.response)
    gamma, error = fit_gamma(values, radiances)
    notes["response"] = {"method": job.response, "light": light, "exposures_s": exposures, "gamma": gamma}
    said.append(
        f"  response from {len(codes)} exposures of {light} ({job.response}): like gamma {gamma:.3f}, "
        f"within {error:.1%}"
    )
    rows = np.stack([values.numpy(), radiances.numpy()], 1)
    return tuple((float(v), float(r)) for v, r in rows)


def _ball(folder: Path, names: list[str]) -> tuple[Tensor, Tensor | None]:
    """Grey pictures of a ball, one a light, and its mask where there is one."""
    files, mask_file = pictures_by_light(folder, names)
    pictures = []
    for name in names:
        values, _ = read_picture(folder / files[name])
        if pictures and values.shape[1:] != pictures[0].shape:
            raise CaptureError(f"{folder / files[name]}: another size than {files[names[0]]}")
        pictures.append(values.mean(0))
    mask = None if mask_file is None else (read_picture(folder / mask_file)[0] > 0.5).any(0)
    return torch.stack(pictures), mask


def _circle(given: list[float] | None, pictures: Tensor, mask: Tensor | None) -> Circle:
    if given is not None:
        circle = Circle(x=given[0], y=given[1], radius=given[2])
        if not bool(disc(circle, *pictures.shape[1:]).any()):
            raise LightError(f"circle={given}: no pixel of the picture is in it")
        return circle
    return find_ball_circle(pictures) if mask is None else find_circle(mask)
