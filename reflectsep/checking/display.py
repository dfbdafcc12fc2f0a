"""A check as a table for a terminal, and as a picture sheet."""

from __future__ import annotations

import io
from pathlib import Path

from reflectsep.checking.findings import CheckResult
from reflectsep.report.sheet import write_sheet


def table(result: CheckResult, *, colour: bool, width: int = 110) -> str:
    """The findings as a table for a terminal; verdicts are words, and colours where wanted."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    styles = {"good": "green", "doubtful": "yellow", "bad": "bold red"}
    rows = Table(title=f"{result.capture.object} in {result.capture.folder}", title_justify="left", expand=False)
    for heading in ("", "found", "", "what to do"):
        rows.add_column(heading, overflow="fold")
    for finding in result.findings:
        verdict = Text(finding.verdict, style=styles[finding.verdict])
        rows.add_row(Text(finding.subject), Text(finding.value), verdict, Text(finding.advice))
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=colour, color_system="standard" if colour else None, width=width)
    console.print(rows)
    console.print(Text(f"verdict: {result.verdict}", style=styles[result.verdict]))
    return stream.getvalue().rstrip()


def draw(result: CheckResult, path: Path | str) -> None:
    """Write the picture sheet."""
    maps = {}
    for passage in result.passages:
        name = f"{passage.sweep.light} {passage.sweep.direction}"
        maps[f"{name}: frame of passage"] = passage.centre
        maps[f"{name}: lit frame / full"] = passage.peak
    write_sheet(
        path,
        result.stack.names,
        result.pictures,
        result.saturated,
        result.mask,
        maps=maps,
        motions=result.alignment.document(result.capture),
        lines=[(f.subject, f.value, f.verdict) for f in result.findings],
        title=f"{result.capture.object}: {result.verdict}",
    )
