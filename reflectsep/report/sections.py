"""The sections of the report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch

from reflectsep.data import Capture, PhotometricStack, Vector
from reflectsep.flags import WORDS, Flag
from reflectsep.report import html
from reflectsep.report.charts import Panel, dome, equation_25, flag_bars, grid, passage, valley
from reflectsep.report.figures import HeldOut
from reflectsep.report.html import Section
from reflectsep.report.metrics import psnr, relative_rms
from reflectsep.report.sweeps import SweepView
from reflectsep.report.tone import white_point
from reflectsep.report.valley import cost_valley
from reflectsep.separation import Separation

UNIT = "capture's units"


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
                "not recorded" if sweep.exposure_s is None else f"{sweep.exposure_s:g} s",
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
                "When the slab passes. Steps or bends of the whole cloud are a stage that did not run evenly; a spread "
                "about the line is the object's height under a tilted light.",
            )
        )
        parts.append(_frames(views))
    return Section(key="scattering", title="Scattering from the sweeps", body="".join(parts))


def _frames(views: Sequence[SweepView]) -> str:
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
        f"Three frames of the sweep of light {view.light} along {view.direction}: as captured; without the band "
        "that the "
        "slab lights itself (grey); and with the hole filled by the maximum of its surroundings, as in the "
        "paper's Fig. 2. "
        "For the result holes are filled as scatter.hole_filling says.",
    )


def components(separation: Separation, baseline: Separation | None) -> Section:
    """The paper's Figs. 4 and 6 for every basis light."""
    whole = separation.highlight_free + separation.specular
    white = white_point(whole, separation.mask)
    faint = max(1e-12, white_point(separation.specular, separation.mask))
    local = max(1e-12, white_point(separation.local_diffuse, separation.mask))
    parts, rows = [], []
    scattered = bool(separation.scattering.any())
    for i in range(3):
        row = [
            Panel(title="picture", picture=whole[i], white=white, caption=_share(separation, whole[i], whole[i])),
            Panel(title="scattering", picture=separation.scattering[i] if scattered else None, white=white,
                  caption=_share(separation, separation.scattering[i], whole[i])),
            Panel(title="local diffuse", picture=separation.local_diffuse[i], white=local,
                  caption=_share(separation, separation.local_diffuse[i], whole[i])),
            Panel(title="off-specular", picture=separation.specular[i], white=faint,
                  caption=_share(separation, separation.specular[i], whole[i])),
        ]  # fmt: skip
        if baseline is not None:
            row += [
                Panel(title="diffuse, Lin & Lee", picture=baseline.diffuse[i], white=white,
                      caption=_share(separation, baseline.diffuse[i], whole[i])),
                Panel(title="off-specular, Lin & Lee", picture=baseline.specular[i], white=faint,
                      caption=_share(separation, baseline.specular[i], whole[i])),
            ]  # fmt: skip
        rows.append([panel for panel in row if panel.picture is not None])
    caption = (
        f"Components of every basis light, linear values through the sRGB curve. White is {white:.3g} for pictures, "
        f"scattering and whole diffuse, {local:.3g} for local diffuse, {faint:.3g} for off-specular. Per cent: "
        "share of "
        "the light that comes from the object."
    )
    parts.append(html.picture(grid(rows, [f"light {name}" for name in separation.basis], separation.mask), caption))
    if baseline is None:
        advice = "Lin & Lee's components stand beside these in the report that `reflectsep report` writes."
        parts.append(html.text(advice, "dim"))
    return Section(key="components", title="Components", body="".join(parts))


def _share(separation: Separation, part: torch.Tensor, whole: torch.Tensor) -> str:
    total = float(whole[:, separation.mask].double().sum())
    return f"{100 * float(part[:, separation.mask].double().sum()) / total:.1f} %" if total > 0 else ""


def global_parameters(separation: Separation, stack: PhotometricStack | None) -> Section:
    """Globals with their uncertainties, and the valley between a and B."""
    covariance = separation.document.get("covariance", {})
    order = list(covariance.get("order", []))
    values = torch.tensor(covariance.get("values", []), dtype=torch.float64).reshape(len(order), len(order))
    sd = {name: math.sqrt(max(0.0, float(values[i, i]))) for i, name in enumerate(order)}
    n_s = float(separation.n_s)
    sds = {**sd, "n_s": n_s * sd["log_n_s"]} if "log_n_s" in sd else sd
    found = [
        (f"a_{k + 1}", float(separation.a[k]), f"offset of the lobe under basis light {separation.basis[k]}")
        for k in range(3)
    ]
    found += [
        ("n_s", n_s, "exponent of the lobe: the larger, the glossier"),
        ("n_d", float(separation.n_d), "exponent of the diffuse part"),
        ("softness", float(separation.softness), "width of the shadow's edge, of the mean scattering root"),
        ("haze", float(separation.haze), "height of the lobe's haze; 0: none"),
    ]
    rows = [
        [name, f"{value:.4g}", f"± {sds[name]:.2g}" if name in sds else "held", what] for name, value, what in found
    ]
    parts = [html.table(["global", "value", "standard deviation", "what it is"], rows)]
    parts.append(html.text("All have no unit but a, which is in the n_s-th root of the capture's units."))
    trade = None if stack is None else cost_valley(separation, stack)
    if trade is not None:
        parts.append(
            html.picture(
                valley(trade),
                f"Misfit over a and B at {trade.pixels} pixels that show the highlight, d refitted at each; pictures "
                "weigh alike and there are no priors, unlike in the fit. The longer the dark valley, the less the "
                "pictures tell a weak lobe from a strong one: along it the split between highlight and diffuse part "
                "changes, and the pictures hardly do.",
            )
        )
    else:
        parts.append(html.text("The valley between a and B is not shown: no pixels with a highlight, or no pictures."))
    return Section(key="globals", title="Globals and how sure they are", body="".join(parts))


def maps(separation: Separation) -> Section:
    """Maps of residual, uncertainty and flags."""
    mask = separation.mask
    nothing = torch.tensor(torch.nan)

    def inside(values: torch.Tensor) -> torch.Tensor:
        return torch.where(mask & values.isfinite(), values, nothing)

    residual = inside(separation.residual.square().mean((0, 1)).sqrt())
    signed = [inside(separation.residual[i].mean(0)) for i in range(len(separation.names))]
    root = (separation.d + separation.s).abs().mean((0, 1)).clamp_min(1e-9)
    d_sd = inside(100 * separation.d_sd.square().mean((0, 1)).sqrt() / root)
    B_sd = inside(100 * (separation.B_sd / separation.B.clamp_min(1e-9)).mean(0))
    rows = [
        [
            Panel(title="misfit of all lights", picture=residual, unit=f"rms, {UNIT}", limits=_to(residual)),
            Panel(title="uncertainty of d", picture=d_sd, unit="sd, % of d + s", logarithmic=True),
            Panel(title="uncertainty of B", picture=B_sd, unit="sd, % of B", logarithmic=True),
            Panel(
                title="B, strength of the lobe",
                picture=inside(separation.B.mean(0)),
                unit="1 / root of the capture's unit",
            ),
        ]
    ]
    limit = max(_to(s.abs())[1] for s in signed)
    light_rows = [
        [
            Panel(
                title=f"light {separation.names[i]}",
                picture=signed[i],
                unit=UNIT,
                limits=(-limit, limit),
                diverging=True,
            )
            for i in range(start, min(start + 4, len(signed)))
        ]
        for start in range(0, min(len(signed), 24), 4)
    ]
    parts = [
        html.picture(grid(rows, mask=mask), "Per pixel, over all lights and channels. Grey: not on the object."),
        html.heading("Picture minus model, light by light"),
        html.picture(grid(light_rows, mask=mask),
                     "Orange and purple are pictures that are darker and brighter than the model."
                     " What has structure here is not in the model: cast shadows, inter-reflection, drift."),
        html.heading("Flags"),
        html.picture(flag_bars(separation.flags, mask, WORDS), "Pixels of the object that carry each flag."),
    ]  # fmt: skip
    chosen = [f for f in Flag if f is not Flag.OUTSIDE_MASK and bool((separation.flags[mask] & int(f)).any())]
    flag_rows = [
        [
            Panel(title=WORDS[str(flag.name)].split(":")[0][:42],
                  picture=inside(((separation.flags & int(flag)) != 0).float()),
                  unit="0: no, 1: yes", limits=(0.0, 1.0))
            for flag in chosen[start : start + 4]
        ]
        for start in range(0, len(chosen), 4)
    ]  # fmt: skip
    if flag_rows:
        parts.append(html.picture(grid(flag_rows, mask=mask), "Where they are."))
    return Section(key="maps", title="Residual, uncertainty, flags", body="".join(parts))


def _to(values: torch.Tensor) -> tuple[float, float]:
    """From 0 to what 99 % of the values stay below."""
    known = values[values.isfinite()]
    return 0.0, max(1e-12, float(known.double().quantile(0.99)) if 0 < known.numel() < 2**24 else 1e-12)


def held_out(separation: Separation, lights: Sequence[HeldOut], baseline: bool) -> Section:
    """The paper's Figs. 5 and 7: pictures that the fit never saw."""
    title = "Lights that the fit never saw"
    if not lights:
        advice = (
            "No picture was held out, so nothing here tells how well the result relights. Fit again with "
            "heldout=[NAME] "
            "to leave a light out and see it predicted."
        )
        return Section(key="heldout", title=title, body=html.text(advice))
    mask = separation.mask
    white = white_point([light.real for light in lights], mask)
    models = ("ours", "baseline") if baseline else ("ours",)
    named = {"ours": "relit", "baseline": "relit by Lin & Lee"}
    apart = {(k, m): (light.real - getattr(light, m)).mean(0) for k, light in enumerate(lights) for m in models}
    limit = max(_to(torch.where(mask, d, torch.nan).abs())[1] for d in apart.values())
    rows, numbers = [], []
    for k, light in enumerate(lights):
        counts = mask if light.counts is None else mask & light.counts
        row = [Panel(title="real", picture=light.real * mask, white=white)]
        for model in models:
            picture = getattr(light, model)
            score, error = psnr(picture, light.real, counts), 100 * relative_rms(picture, light.real, counts)
            row.append(
                Panel(title=named[model], picture=picture * mask, white=white, caption=f"{score:.1f} dB, {error:.1f} %")
            )
            difference = torch.where(mask, apart[k, model], torch.nan)
            row.append(
                Panel(
                    title=f"real - {named[model]}",
                    picture=difference,
                    unit=UNIT,
                    limits=(-limit, limit),
                    diverging=True,
                )
            )
            numbers.append([light.light, named[model], f"{score:.1f} dB", f"{error:.1f} %"])
        rows.append(row)
    return Section(
        key="heldout",
        title=title,
        body=html.picture(
            grid(rows, [f"light {light.light}" for light in lights], mask),
            f"Real pictures, relit ones and their difference; white is {white:.3g}. dB: peak signal to noise "
            "ratio against "
            "the real picture's peak; %: RMS error of the real picture's RMS.",
        )
        + html.table(["light", "model", "PSNR", "RMS error"], numbers),
    )


def reproduce(separation: Separation, command: str) -> Section:
    """The command, timings, versions, settings."""
    document = separation.document
    parts = [html.heading("Command"), html.code(command)]
    timings = document.get("timings_s", {})
    rows = [[stage, f"{seconds:.1f} s"] for stage, seconds in timings.items()]
    parts += [html.heading("Time taken"), html.table([], [*rows, ["in all", f"{sum(timings.values()):.1f} s"]])]
    parts += [html.heading("Versions"), html.table([], [[k, v] for k, v in document.get("versions", {}).items()])]
    parts.append(html.heading("Settings"))
    for group, values in document.get("settings", {}).items():
        parts.append(html.table([f"{group}.", ""], [[name, value] for name, value in values.items()]))
    named = {
        "capture": document.get("capture", ""),
        "left out of the fit": ", ".join(document.get("heldout", [])) or "no light",
    }
    parts += [html.heading("Data"), html.table([], [[k, v] for k, v in named.items()])]
    return Section(key="reproduce", title="How to make this again", body="".join(parts))
