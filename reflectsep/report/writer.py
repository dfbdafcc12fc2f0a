"""The report of a result: one self-contained HTML file that a stranger understands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from reflectsep.data import Capture, PhotometricStack, Vector
from reflectsep.report import html
from reflectsep.report.acquisition import captured, scattering
from reflectsep.report.advice import what_to_do
from reflectsep.report.charts import Panel, grid
from reflectsep.report.figures import HeldOut
from reflectsep.report.findings import components, global_parameters, held_out
from reflectsep.report.html import Section
from reflectsep.report.quality import maps, reproduce
from reflectsep.report.sweeps import SweepView
from reflectsep.report.tone import white_point
from reflectsep.separation import Separation, extensions


@dataclass(frozen=True, kw_only=True)
class Facts:
    """All that a report is made of; what is None was not there to be reported."""

    name: str
    separation: Separation
    command: str
    """That makes this result."""
    capture: Capture | None = None
    stack: PhotometricStack | None = None
    """The capture's pictures, as the fit had them."""
    sweeps: tuple[SweepView, ...] = ()
    baseline: Separation | None = None
    """Lin & Lee's model fitted to the same pictures."""
    heldout: Sequence[HeldOut] = ()
    directions: Mapping[str, Vector] = field(default_factory=dict)
    """Of the held-out lights."""
    notes: tuple[str, ...] = ()
    """What could not be reported, and why."""


def write_report(path: Path | str, facts: Facts) -> None:
    """Write the report of a result.

    Raises:
        ValueError: the object has no pixel.
    """
    separation = facts.separation
    if not bool(separation.mask.any()):
        raise ValueError(f"{facts.name}: no pixel on the object; there is nothing to report")
    sections = [
        captured(separation, facts.capture, facts.directions),
        scattering(separation, facts.sweeps),
        components(separation, facts.baseline),
        global_parameters(separation, facts.stack),
        maps(separation),
        held_out(separation, facts.heldout, facts.baseline is not None),
        reproduce(separation, facts.command),
    ]
    shown: list[Section] = [section for section in sections if section is not None]
    title = f"Reflectance of {separation.document.get('object') or facts.name}"
    html.write_html(path, title, lead(facts), shown)


def lead(facts: Facts) -> str:
    """What one should know first: the picture taken apart, the numbers, the warnings."""
    separation = facts.separation
    document = separation.document
    whole = separation.highlight_free + separation.specular
    white = white_point(whole, separation.mask)
    row = [
        Panel(title="picture", picture=whole[0], white=white, caption=f"white is {white:.3g}"),
        Panel(title="without highlight", picture=separation.highlight_free[0], white=white),
        Panel(title="off-specular (highlight)", picture=separation.specular[0], white=white),
    ]
    scattered = bool(separation.scattering.any())
    if scattered:
        row.append(Panel(title="local diffuse", picture=separation.local_diffuse[0], white=white))
        row.append(Panel(title="scattering", picture=separation.scattering[0], white=white))
    kept = extensions(separation)
    told = str(document.get("alignment", {}).get("told", ""))
    rms = float(document.get("residual", {}).get("rms", float("nan")))
    peak = float(whole[:, :, separation.mask].max())
    height, width = separation.mask.shape
    parts = [
        html.text(str(document.get("model", "")), "dim"),
        html.picture(
            grid([row], mask=separation.mask),
            f"The picture under light {separation.basis[0]}, taken apart. All panels share one exposure; values "
            "are linear "
            "in the capture's units, shown through the sRGB curve."
            + (" Local diffuse light left the object where it entered it, scattering left it elsewhere." * scattered),
        ),
        html.table(
            [],
            [
                ["size", f"{width} x {height} px, {int(separation.mask.sum())} px on the object"],
                ["lights", f"{len(separation.names)} ({', '.join(separation.basis)} are the basis)"],
                ["misfit", f"{rms:.3g} rms in the capture's units, {100 * rms / peak:.2g} % of the brightest value"],
                ["gloss n_s", f"{float(separation.n_s):.2f}"],
                ["n_d", f"{float(separation.n_d):.4f} ({document.get('n_d_source', 'unknown')})"],
                *([["motion", told]] if told else []),
                *([["beyond the paper", kept]] if kept else []),
                ["made", str(document.get("created", ""))],
            ],
        ),
    ]
    warnings = [str(warning) for warning in document.get("warnings", [])]
    parts += [html.warning(warning, what_to_do(warning)) for warning in warnings]
    if not warnings:
        parts.append(html.text("The fit gave no warnings."))
    parts += [html.text(note, "dim") for note in facts.notes]
    return "".join(parts)
