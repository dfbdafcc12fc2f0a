"""Self-contained HTML: text is escaped, figures are inside as PNG, nothing is loaded from anywhere."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from reflectsep.io.files import atomic_write

DPI = 120
UNIT = "capture's units"
"""Of every linear value: what the capture's files hold."""

STYLE = (files("reflectsep.report") / "style.css").read_text(encoding="utf-8")


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of the report; `body` is HTML made by the functions here."""

    key: str
    title: str
    body: str


def text(words: str, style: str = "") -> str:
    """A paragraph."""
    return f"<p{f' class={chr(34)}{style}{chr(34)}' if style else ''}>{html.escape(words)}</p>"


def heading(words: str) -> str:
    """A heading within a section."""
    return f"<h3>{html.escape(words)}</h3>"


def code(words: str) -> str:
    """Text as it is typed."""
    return f"<pre>{html.escape(words)}</pre>"


def warning(words: str, advice: str) -> str:
    """A warning with what to do about it."""
    return f'<div class="warning"><b>{html.escape(words)}</b><br>{html.escape(advice)}</div>'


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table; the head may be empty."""
    top = "<tr>" + "".join(f"<th>{html.escape(word)}</th>" for word in head) + "</tr>" if head else ""
    body = "".join(
        "<tr>"
        + "".join(f"<{kind}>{html.escape(str(cell))}</{kind}>" for kind, cell in _cells(row, bool(head)))
        + "</tr>"
        for row in rows
    )
    return f'<div class="scroll"><table>{top}{body}</table></div>'


def _cells(row: Sequence[object], has_head: bool) -> list[tuple[str, object]]:
    return [("td" if has_head or i else "th", cell) for i, cell in enumerate(row)]


def bars(head: str, of: str, rows: Iterable[tuple[str, float]]) -> str:
    """A table of per cents with a bar behind each number, which a narrow screen shows as well."""
    body = "".join(
        f'<tr><td>{html.escape(words)}</td><td class="bar"><i style="width:{min(max(value, 0.0), 100.0):.4g}%"></i>'
        f"{value:.1f} %</td></tr>"
        for words, value in rows
    )
    top = f"<tr><th>{html.escape(head)}</th><th>{html.escape(of)}</th></tr>"
    return f'<div class="scroll"><table>{top}{body}</table></div>'


def picture(figure: Figure, caption: str, alternative: str = "") -> str:
    """A figure as a PNG inside the page, with its caption."""
    data = io.BytesIO()
    figure.set_dpi(DPI)
    FigureCanvasAgg(figure).print_png(data)
    source = base64.b64encode(data.getvalue()).decode("ascii")
    wide = ' class="wide"' if figure.get_figwidth() > 6 else ""
    alternative = html.escape(alternative or caption, quote=True)
    return (
        f'<figure{wide}><img src="data:image/png;base64,{source}" alt="{alternative}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def write_html(path: Path | str, title: str, lead: str, sections: Sequence[Section]) -> None:
    """Write the report as one file, atomically; `lead` is HTML made by the functions here."""
    links = " ".join(f'<a href="#{section.key}">{html.escape(section.title)}</a>' for section in sections)
    body = "".join(
        f'<section id="{section.key}"><h2>{html.escape(section.title)}</h2>{section.body}</section>'
        for section in sections
    )
    page = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; '
        "style-src 'unsafe-inline'; img-src data:\">"
        f"<title>{html.escape(title)}</title><style>{STYLE}</style></head><body>"
        f"<h1>{html.escape(title)}</h1>{lead}<nav>{links}</nav>{body}</body></html>\n"
    )
    atomic_write(path, lambda temporary: temporary.write_text(page, encoding="utf-8"))
