"""What is said of a capture and of a result: the document of `separation.json`, and both in a few lines of text."""

from __future__ import annotations

import dataclasses
import math
import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
import torch

from reflectsep import __version__
from reflectsep.calibrate.alignment import Alignment
from reflectsep.calibrate.alpha import AlphaReport
from reflectsep.calibrate.exposure import missing_darks
from reflectsep.data import Capture, Fit, PhotometricStack, Scattering
from reflectsep.flags import count
from reflectsep.separation import Separation, extensions


def describe(  # noqa: PLR0913  (every stage has its say)
    capture: Capture,
    stack: PhotometricStack,
    lights: AlphaReport,
    scattering: Scattering | None,
    fitted: Fit,
    *,
    timings_s: Mapping[str, float],
    settings: Mapping[str, Mapping[str, Any]],
    heldout: Sequence[str],
    alignment: Alignment | None = None,
) -> dict[str, Any]:
    """What `separation.json` says beside the globals."""
    squares, largest = [], 0.0
    for picture in fitted.residual:
        values = picture[:, stack.mask]
        largest = max(largest, float(values.abs().amax()))
        squares.append(float(values.square().mean()))
    warnings = [*lights.warnings, *missing_darks(capture), *fitted.warnings]
    wanted = settings["fit"]["scattering"]
    model = "Wu & Tang: off-specular, local diffuse and scattering"
    if scattering is None:
        model = "Lin & Lee: off-specular and diffuse, scattering taken as zero"
        if wanted == "unknown":
            model = "Wu & Tang with scattering unknown: not identifiable where no highlight is seen"
        elif wanted == "measured":
            warnings.append("the capture has no sweeps: scattering is taken as zero (the model of Lin & Lee)")
    document: dict[str, Any] = {
        "object": capture.object,
        "capture": str(capture.folder.resolve()),
        **({} if capture.region is None else {"region": capture.region.plain()}),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "model": model,
        "heldout": list(heldout),
        "n_d_source": "assumed" if scattering is None else scattering.n_d_source,
        "covariance": {"order": list(fitted.global_names), "values": fitted.covariance.tolist()},
        "alpha_source": dict(zip(lights.names, lights.source, strict=True)),
        "alpha_agreement": [dataclasses.asdict(a) for a in lights.agreement],
        **refined_alphas(stack, fitted),
        "noise": fitted.noise,
        "cost": fitted.cost,
        "iterations": fitted.iterations,
        "residual": {
            "rms": math.sqrt(sum(squares) / len(squares)),
            "rms_by_light": {n: math.sqrt(square) for n, square in zip(stack.names, squares, strict=True)},
            "largest": largest,
        },
        "settings": {group: dict(values) for group, values in settings.items()},
        "versions": {
            "reflectsep": __version__,
            "torch": torch.__version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
        "timings_s": dict(timings_s),
    }
    if scattering is not None:
        warnings.extend(scattering.warnings)
        document["n_d_sd"] = scattering.n_d_sd
        document["sweeps"] = [dataclasses.asdict(report) for report in scattering.sweeps]
    if alignment is not None:
        document["alignment"] = alignment.document(capture)
        warnings.extend(alignment.warnings)
    kept = extensions(fitted)
    if kept:
        document["extensions"] = kept
    document["warnings"] = warnings
    return document


def refined_alphas(stack: PhotometricStack, fitted: Fit) -> dict[str, Any]:
    """What the fit made of the stated alphas, light by light; empty where it held them."""
    if fitted.alpha is None or fitted.alpha_sd is None:
        return {}
    basis = stack.light_vectors[:3].double() if stack.light_vectors is not None else None
    entries: dict[str, Any] = {}
    for j, name in enumerate(stack.names[3:], start=3):
        stated, refined = stack.alpha[j].double(), fitted.alpha[j].double()
        entries[name] = {"stated": stated.tolist(), "refined": refined.tolist(), "sd": fitted.alpha_sd[j].tolist()}
        if basis is not None:
            a, b = stated @ basis, refined @ basis
            angle = math.degrees(math.atan2(float(torch.linalg.cross(a, b).norm()), float(a @ b)))
            entries[name] |= {"turned_deg": angle, "intensity_percent": 100.0 * (float(b.norm() / a.norm()) - 1.0)}
    return {"alpha_refined": entries}


def capture_summary(capture: Capture) -> str:
    """A capture in a few lines; no picture is read."""
    lines = [f"capture of {capture.object} in {capture.folder}"]
    if capture.size is not None:
        lines.append(f"  size      {capture.size[0]} x {capture.size[1]}")
    known = sum(capture.lights[name].direction is not None for name in capture.names)
    lines.append(f"  pictures  {len(capture.names)} ({known} with a known light direction)")
    lines.append(f"  basis     {', '.join(capture.basis)}")
    lines.append(f"  encoding  {capture.encoding.kind}")
    for sweep in capture.sweeps:
        lost = f", {len(sweep.lost)} lost" if sweep.lost else ""
        several = f" at {len(sweep.exposures)} exposures" if sweep.bracket else ""
        lines.append(
            f"  sweep     {sweep.light} along {sweep.direction}: {sweep.count} frames{several}{lost}, {sweep.kind}"
        )
    if not capture.sweeps:
        lines.append("  sweeps    none: a fit of it is the model of Lin & Lee")
    return "\n".join(lines)


def summary(separation: Separation, *, full: bool = False) -> str:
    """A result in a few lines."""
    document = separation.document
    globals_ = f"n_s {float(separation.n_s):.2f}, n_d {float(separation.n_d):.4f}"
    a = ", ".join(f"{v:.3f}" for v in separation.a.tolist())
    rms = document.get("residual", {}).get("rms", float("nan"))
    lines = [f"{document.get('model', '')}; a = ({a}), {globals_}, residual {rms:.2g} rms"]
    if document.get("alignment", {}).get("told"):
        lines.append(f"  motion    {document['alignment']['told']}")
    lines += [f"  warning: {text}" for text in document.get("warnings", [])]
    if full:
        lines.insert(0, f"result of {document.get('object', '?')} from {document.get('capture', '?')}")
        lines.append(f"  lights    {', '.join(separation.names)}; basis {', '.join(separation.basis)}")
        height, width = separation.mask.shape
        lines.append(f"  size      {width} x {height}, {int(separation.mask.sum())} pixels on the object")
        taken = document.get("globals_from")
        if taken:
            words = "held as they are in" if taken["use"] == "held" else "started from"
            lines.append(f"  globals   {words} {taken['result']}")
        if document.get("region"):
            x, y, w, h = document["region"]
            lines.append(f"  region    {w} x {h} pixels of the capture's pictures, from column {x}, row {y}")
        kept = extensions(separation)
        lines += [f"  beyond    {kept}"] if kept else []
        for name, entry in document.get("alpha_refined", {}).items():
            said = ", ".join(
                f"{value:.4f} +- {sd:.2g}" for value, sd in zip(entry["refined"], entry["sd"], strict=True)
            )
            how = f"; turned by {entry['turned_deg']:.2f} deg, {entry['intensity_percent']:+.2f} % in intensity"
            lines.append(f"  alpha     {name}: {said}{how if 'turned_deg' in entry else ''}")
        for sweep in document.get("sweeps", []):
            gain = f"C {sweep['gain']:.4f} +- {sweep['gain_sd']:.2g}"
            lines.append(f"  sweep     {sweep['light']} along {sweep['direction']}: {gain}")
        lines += [f"  {flag.lower():18s}{number}" for flag, number in count(separation.flags).items() if number]
        lines.append(f"  time      {sum(document.get('timings_s', {}).values()):.1f} s")
    return "\n".join(lines)
