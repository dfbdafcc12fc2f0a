"""Sections of the report on what was found: components, globals, and lights that the fit never saw."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from reflectsep.data import PhotometricStack
from reflectsep.report import html
from reflectsep.report.charts import Panel, grid, upper_limit, valley
from reflectsep.report.figures import HeldOut
from reflectsep.report.html import UNIT, Section
from reflectsep.report.metrics import psnr, relative_rms
from reflectsep.report.tone import white_point
from reflectsep.report.valley import cost_valley
from reflectsep.separation import Separation


def components(separation: Separation, baseline: Separation | None) -> Section:
    """The paper's Figs. 4 and 6 for every basis light."""
    whole = separation.highlight_free + separation.specular
    white = white_point(whole, separation.mask)
    faint = max(1e-12, white_point(separation.specular, separation.mask))
    local = max(1e-12, white_point(separation.local_diffuse, separation.mask))
    parts, rows = [], []
    scattered = bool(separation.scattering.any())
    body = "local diffuse" if scattered else "diffuse"
    for i in range(3):
        row = [
            Panel(title="picture", picture=whole[i], white=white, caption=_share(separation, whole[i], whole[i])),
            Panel(title="scattering", picture=separation.scattering[i] if scattered else None, white=white,
                  caption=_share(separation, separation.scattering[i], whole[i])),
            Panel(title=body, picture=separation.local_diffuse[i], white=local,
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
        f"scattering and whole diffuse, {local:.3g} for {body}, {faint:.3g} for off-specular. Per cent: share of the "
        "light that comes from the object; the parts are the model's, so what they lack or have too much is its misfit."
    )
    parts.append(html.picture(grid(rows, [f"light {name}" for name in separation.basis], separation.mask), caption))
    if not scattered:
        words = "Scattering is taken as zero: this is Lin & Lee's model itself, and has no other to stand beside it."
        parts.append(html.text(words, "dim"))
    elif baseline is None:
        words = (
            "To see Lin & Lee's components beside these: reflectsep report result=RESULT, or fit with baseline=true."
        )
        parts.append(html.text(words, "dim"))
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
    for k, name in enumerate(("log_a_1", "log_a_2", "log_a_3")):
        if name in sd:
            sds[f"a_{k + 1}"] = abs(float(separation.a[k])) * sd[name]
    found = [
        (f"a_{k + 1}", float(separation.a[k]), f"offset of the lobe under basis light {separation.basis[k]}")
        for k in range(3)
    ]
    found += [
        ("n_s", n_s, "exponent of the lobe: the larger, the glossier"),
        ("n_d", float(separation.n_d), "exponent of the diffuse part"),
        ("f", float(separation.f), "share of scattered light that has forgotten the normal; 1: the paper"),
        ("softness", float(separation.softness), "of a shadow's edge, in units of the cosine; 0: hard"),
        ("fresnel", float(separation.fresnel), "share of Fresnel's losses that the body obeys; 0: the paper"),
    ]
    n_d_sd, source = separation.document.get("n_d_sd"), separation.document.get("n_d_source")
    held = {"n_d": f"± {n_d_sd:.2g}, by the sweeps" if n_d_sd and source == "estimated" else f"{source}"}
    rows = [
        [name, f"{value:.4g}", f"± {sds[name]:.2g}" if name in sds else held.get(name, "not fitted"), what]
        for name, value, what in found
    ]
    parts = [html.table(["global", "value", "standard deviation", "what it is"], rows)]
    taken = separation.document.get("globals_from", {})
    if taken:
        how = (
            "They are held as they are, and their uncertainty with them"
            if taken.get("use") == "held"
            else "The fit started from those"
        )
        parts.append(html.text(f"{how}, of the result {taken.get('result')}."))
    parts.append(html.text("All have no unit but a, which is in the n_s-th root of the capture's units."))
    trade = None if stack is None else cost_valley(separation, stack)
    if trade is not None:
        parts.append(
            html.picture(
                valley(trade),
                f"Misfit over a and B at {trade.pixels} pixels that show the highlight, d refitted at each; pictures "
                "weigh alike and there are no priors, unlike in the fit. The longer the dark valley, the less the "
                "pictures tell a weak lobe from a strong one: along it the split between highlight and diffuse part "
                "changes, and the pictures hardly do. Without priors the lowest point need not be the fitted one; "
                "steps in the line on the right are single pixels that fall into another minimum.",
            )
        )
    else:
        parts.append(html.text("The valley between a and B is not shown: no pixels with a highlight, or no pictures."))
    return Section(key="globals", title="Globals and how sure they are", body="".join(parts))


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
    limit = max(upper_limit(torch.where(mask, d, torch.nan).abs())[1] for d in apart.values())
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
            numbers.append([light.light, light.place, named[model], f"{score:.1f} dB", f"{error:.1f} %"])
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
        + html.table(["light", "where it stands", "model", "PSNR", "RMS error"], numbers),
    )
