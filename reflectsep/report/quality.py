"""Sections of the report on how far it can be trusted, and how it is made again."""

from __future__ import annotations

import textwrap

import torch

from reflectsep.flags import WORDS, Flag
from reflectsep.report import html
from reflectsep.report.charts import Panel, grid, upper_limit
from reflectsep.report.html import UNIT, Section
from reflectsep.separation import Separation
from reflectsep.settings import shown


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
    B_sd = inside(100 * (separation.B_sd / separation.B.clamp_min(1e-9)))
    rows = [
        [
            Panel(title="misfit of all lights", picture=residual, unit=f"rms, {UNIT}", limits=upper_limit(residual)),
            Panel(title="uncertainty of d", picture=d_sd, unit="sd, % of d + s", logarithmic=True),
            Panel(title="uncertainty of B", picture=B_sd, unit="sd, % of B", logarithmic=True),
            Panel(
                title="B, strength of the lobe",
                picture=inside(separation.B),
                unit="1 / root of the capture's unit",
            ),
        ]
    ]
    limit = max(upper_limit(s.abs())[1] for s in signed)
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
        html.picture(grid(rows, mask=mask),
                     "Per pixel, over all lights and channels. Grey: not on the object, or not determined."),
        html.heading("Picture minus model, light by light"),
        html.picture(grid(light_rows, mask=mask),
                     "Orange and purple are pictures that are darker and brighter than the model."
                     " What has structure here is not in the model: cast shadows, inter-reflection, drift."),
        html.heading("Flags"),
        flag_shares(separation),
    ]  # fmt: skip
    chosen = [f for f in Flag if f is not Flag.OUTSIDE_MASK and bool((separation.flags[mask] & int(f)).any())]
    flag_rows = [
        [
            Panel(title=textwrap.fill(WORDS[str(flag.name)].split(":")[0], 28),
                  picture=inside(((separation.flags & int(flag)) != 0).float()),
                  unit="0: no, 1: yes", limits=(0.0, 1.0))
            for flag in chosen[start : start + 4]
        ]
        for start in range(0, len(chosen), 4)
    ]  # fmt: skip
    if flag_rows:
        parts.append(html.picture(grid(flag_rows, mask=mask), "Where they are."))
    return Section(key="maps", title="Residual, uncertainty, flags", body="".join(parts))


def flag_shares(separation: Separation) -> str:
    """Share of the object's pixels that carry each flag, as a table with bars; flags that none carries in one line."""
    on_object = separation.flags[separation.mask]
    named = [flag for flag in Flag if flag is not Flag.OUTSIDE_MASK]
    share = {flag: 100 * float(((on_object & int(flag)) != 0).double().mean()) for flag in named}
    bars = [(WORDS[str(flag.name)], value) for flag, value in share.items() if value > 0]
    none = [WORDS[str(flag.name)] for flag, value in share.items() if value == 0]
    table = html.bars("flag", "of the object's pixels", bars) if bars else ""
    return table + html.text(f"On no pixel: {'; '.join(none)}." if none else "", "dim")


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
        parts.append(html.table([f"{group}.", ""], [[name, shown(value)] for name, value in values.items()]))
    named = {
        "capture": document.get("capture", ""),
        "left out of the fit": ", ".join(document.get("heldout", [])) or "no light",
    }
    parts += [html.heading("Data"), html.table([], [[k, v] for k, v in named.items()])]
    return Section(key="reproduce", title="How to make this again", body="".join(parts))
