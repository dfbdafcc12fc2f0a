"""Sections of the report on the capture: lights, exposures, sweeps, and how the scattering was measured."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch

from reflectsep.data import Capture, Vector
from reflectsep.report import html
from reflectsep.report.charts import Panel, dome, equation_25, grid, passage
from reflectsep.report.html import UNIT, Section
from reflectsep.report.sweeps import SweepView
from reflectsep.separation import Separation


def captured(separation: Separation, capture: Capture | None, heldout: Mapping[str, Vector]) -> Section:
    """What was captured: lights, exposures, sweeps."""
    parts = []
    vectors = separation.light_vectors
    if vectors is None:
        parts.append(html.text("The directions of the lights are unknown; each is a mix of the three basis lights."))
    else:
        parts.append(
            html.picture(
                dome(separation.names, vectors, heldout),
                "Directions of the lights on the hemisphere, seen from the camera; circles are angles off the view. "
                "Lights between the basis lights (shaded) are interpolated when relighting, others extrapolated.",
            )
        )
    head = ["light", "angle off the view", "intensity", "alpha (mix of the basis)", "exposure"]
    rows = []
    for i, name in enumerate(separation.names):
        angle, strength = "unknown", "1 (taken)"
        if vectors is not None:
            v = vectors[i].double()
            cosine = float(v @ separation.view.double() / v.norm().clamp_min(1e-12) / separation.view.double().norm())
            angle, strength = f"{math.degrees(math.acos(min(1.0, max(-1.0, cosine)))):.1f}°", f"{float(v.norm()):.4g}"
        mix = ", ".join(f"{value:.3f}" for value in separation.alpha[i].tolist())
        rows.append([name + (" (basis)" if i < 3 else ""), angle, strength, mix, _exposure(capture, name)])
    parts.append(html.table(head, rows))
    if capture is not None:
        sweeps = [
            [
                f"{sweep.light} along {sweep.direction}",
                sweep.kind,
                f"{sweep.count} frames" + (f", {len(sweep.lost)} lost" if sweep.lost else ""),
                "not recorded"
                if sweep.exposure_s is None
                else ", ".join(f"{one.exposure_s:g} s" for one in sweep.exposures),
                "yes" if sweep.dark else "no",
            ]
            for sweep in capture.sweeps
        ]
        parts.append(html.heading("Sweeps"))
        head = ["sweep", "kind", "frames", "exposure", "dark picture"]
        parts.append(html.table(head, sweeps) if sweeps else html.text("None: scattering cannot be measured."))
    agreement = separation.document.get("alpha_agreement", [])
    if agreement:
        parts.append(html.heading("Do the given directions and the pictures agree?"))
        rows = [
            [a["light"], f"{a['angle_deg']:.2f} ± {a['angle_sd_deg']:.2f}°", f"{a['magnitude_percent']:+.2f} %"]
            for a in agreement
        ]
        parts.append(html.table(["light", "angle between both", "difference of intensity"], rows))
    return Section(key="capture", title="What was captured", body="".join(parts))


def _exposure(capture: Capture | None, name: str) -> str:
    if capture is None:
        return "unknown"
    try:
        exposure_s = capture.full(name).exposure_s
    except KeyError:
        return "unknown"
    return "not recorded" if exposure_s is None else f"{exposure_s:g} s"


def scattering(separation: Separation, views: Sequence[SweepView]) -> Section | None:
    """How the scattering was measured: n_d and C, the slab's passage, lit bands and holes."""
    reports = separation.document.get("sweeps", [])
    if not reports:
        return None
    source = separation.document.get("n_d_source")
    sd = separation.document.get("n_d_sd", 0.0)
    parts = [
        html.text(
            f"n_d = {float(separation.n_d):.4f} ({source}, standard deviation {sd:.2g}). Light adds in radiance, "
            "so 1 is "
            "what a linear camera gives. C is the number of frames in which a patch is lit, times the exposure ratio."
        )
    ]
    head = ["sweep", "C", "frames that light a patch", "deviation from constant speed", "object reached"]
    rows = [
        [
            f"{r['light']} along {r['direction']}",
            f"{r['gain']:.4f} ± {r['gain_sd']:.2g}",
            f"{r['lit_frames']:.2f}",
            f"{100 * r['speed_deviation']:.2f} %",
            f"{100 * r['coverage']:.1f} %",
        ]
        for r in reports
    ]
    parts.append(html.table(head, rows))
    if views:
        gains = {(r["light"], r["direction"]): r["gain"] for r in reports}
        parts.append(
            html.picture(
                equation_25(views, gains, separation.mask, float(separation.n_d)),
                "Eq. 25 at every pixel of the object: the frames of a sweep add up to the full picture. Points off the "
                "line are pixels that the sweep did not light fully, drift between exposures, or clipping.",
            )
        )
        parts.append(
            html.picture(
                passage(views),
                "When the slab passes: the frame in which a pixel is brightest. Under a light along the view the "
                "points of a flat object lie on the line; under a tilted light the object's height spreads and bends "
                "the cloud. Sudden steps are a stage that did not run evenly. The deviation in the table above says "
                "how even the speed was, whatever the object's shape: where the slab is slow a patch is lit longer.",
            )
        )
        filling = separation.document.get("settings", {}).get("scatter", {}).get("hole_filling", "another")
        parts.append(_frames(views, str(filling)))
    return Section(key="scattering", title="Scattering from the sweeps", body="".join(parts))


def _frames(views: Sequence[SweepView], filling: str) -> str:
    view = views[0]
    rows, heads = [], []
    for frame in view.frames:
        white = 1.05 * max(1e-12, float(frame.values.max()))
        calm = 1.05 * max(1e-12, float(frame.filled.max()))
        band = torch.where(frame.band, torch.nan, frame.values.mean(0))
        rows.append(
            [
                Panel(title="frame", picture=frame.values, white=white, caption=f"white is {white:.3g}"),
                Panel(title="lit band taken out", picture=band, unit=UNIT, limits=(0.0, calm)),
                Panel(title="hole filled", picture=frame.filled.mean(0), unit=UNIT, limits=(0.0, calm)),
            ]
        )
        heads.append(f"frame {frame.index}")
    return html.picture(
        grid(rows, heads, view.peak.isfinite()),
        f"Frames of the sweep of light {view.light} along {view.direction}: as captured; without the band "
        "that the "
        "slab lights itself (grey); and with the hole filled by the maximum of its surroundings, as in the "
        "paper's Fig. 2. "
        + (
            "The result's holes are filled so, too."
            if filling == "maximum"
            else f"The result itself was made with scatter.hole_filling={filling} instead."
        ),
    )
