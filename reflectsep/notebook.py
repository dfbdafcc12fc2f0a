"""How a result, a capture and a sweep show themselves in a notebook. Only asked for a plot is matplotlib imported."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from reflectsep.flags import count
from reflectsep.io.pictures import read_picture, write_picture
from reflectsep.io.stack import windowed
from reflectsep.srgb import encoded

if TYPE_CHECKING:
    from reflectsep.data import Capture, FrameStream, Sweep
    from reflectsep.report.charts import Chart
    from reflectsep.separation import Separation

LARGEST_PX = 320
"""Longer side of a picture in a table: larger ones are thinned out."""


def separation_html(separation: Separation) -> str:
    """Components of the first basis light, and what was found, as HTML."""
    white = _white(separation.highlight_free + separation.specular, separation.mask)
    shown = {
        "picture": separation.highlight_free[0] + separation.specular[0],
        "off-specular": separation.specular[0],
        "local diffuse": separation.local_diffuse[0],
        "scattering": separation.scattering[0],
    }
    cells = "".join(f"<td>{_png(p, white)}<br>{html.escape(name)}</td>" for name, p in shown.items())
    height, width = separation.mask.shape
    flagged = ", ".join(f"{name.lower()} {n}" for name, n in count(separation.flags).items() if n)
    rows = {
        "object": separation.document.get("object", ""),
        "model": separation.document.get("model", ""),
        "size": f"{width} x {height} px, {int(separation.mask.sum())} on the object",
        "lights": f"{', '.join(separation.names)}; basis {', '.join(separation.basis)}",
        "globals": f"a {', '.join(f'{v:.3f}' for v in separation.a.tolist())}; n_s {float(separation.n_s):.2f}; "
        f"n_d {float(separation.n_d):.4f}",
        "flags": flagged,
    }
    warnings = [("warning", text) for text in separation.document.get("warnings", [])]
    return f"<table><tr>{cells}</tr></table>" + _table([*rows.items(), *warnings])


def separation_plot(separation: Separation) -> Chart:
    """Components of the three basis lights; pictures share one white, faint components have their own."""
    from reflectsep.report.charts import Panel, grid
    from reflectsep.report.tone import white_point

    whole = separation.highlight_free + separation.specular
    parts = {
        "picture": (whole, white_point(whole, separation.mask)),
        "scattering": (separation.scattering, white_point(whole, separation.mask)),
        "local diffuse": (separation.local_diffuse, white_point(separation.local_diffuse, separation.mask)),
        "off-specular": (separation.specular, white_point(separation.specular, separation.mask)),
    }
    rows = [
        [Panel(title=n, picture=p[i], white=w, caption=f"white is {w:.3g}") for n, (p, w) in parts.items()]
        for i in range(3)
    ]
    return grid(rows, [f"light {name}" for name in separation.basis])


def capture_html(capture: Capture) -> str:
    """Lights and sweeps of a capture as HTML; no picture is read."""
    rows: list[tuple[str, object]] = [("object", capture.object), ("folder", capture.folder)]
    if capture.size is not None:
        rows.append(("size", f"{capture.size[0]} x {capture.size[1]} px"))
    if capture.region is not None:
        rows.append(("region", f"{capture.region} (x, y, width, height)"))
    rows += [("encoding", capture.encoding.kind), ("basis", ", ".join(capture.basis))]
    for name in capture.names:
        direction = capture.lights[name].direction if name in capture.lights else None
        words = "direction unknown" if direction is None else ", ".join(f"{v:.3f}" for v in direction)
        exposure_s = capture.full(name).exposure_s
        rows.append((f"light {name}", words + ("" if exposure_s is None else f"; {exposure_s:g} s")))
    rows += [(f"sweep of {s.light}", sweep_words(s)) for s in capture.sweeps]
    return _table(rows)


def capture_plot(capture: Capture) -> Chart:
    """The full pictures as stored, brightest value white."""
    from reflectsep.report.charts import Panel, grid

    files = {name: capture.folder / capture.full(name).file for name in capture.names}
    pictures = {name: windowed(file, capture.region, read_picture(file)[0])[0] for name, file in files.items()}
    panels = []
    for name, picture in pictures.items():
        white = max(1e-12, float(torch.nan_to_num(picture).max()))
        panels.append(Panel(title=name, picture=picture, white=white, caption=f"white is {white:.3g}"))
    return grid([panels[i : i + 4] for i in range(0, len(panels), 4)])


def sweep_html(sweep: Sweep) -> str:
    """A sweep as HTML."""
    return _table([(f"sweep of {sweep.light}", sweep_words(sweep))])


def sweep_words(sweep: Sweep) -> str:
    """A sweep in a line."""
    lost = f", {len(sweep.lost)} lost" if sweep.lost else ""
    times = [f"{one.exposure_s:g}" for one in sweep.exposures if one.exposure_s is not None]
    exposure = f", {' and '.join(times)} s each" if times else ""
    return f"{sweep.kind} along {sweep.direction}, {sweep.count} frames{lost}{exposure}"


def stream_plot(stream: FrameStream, frames: int = 6) -> Chart:
    """Some frames of a sweep, evenly spread, with one white for all.

    Raises:
        ValueError: no frame was received.
    """
    from reflectsep.report.charts import Panel, grid

    wanted = {round((k + 0.5) * len(stream) / frames - 0.5) for k in range(frames)}
    kept = {frame.index: frame.values for frame in stream if frame.index in wanted}
    if not kept:
        raise ValueError(f"sweep of {stream.sweep.light}: no frame to plot")
    white = max(1e-12, *(float(torch.nan_to_num(values).max()) for values in kept.values()))
    panels = [
        Panel(title=f"frame {i}", picture=v, white=white, caption=f"white is {white:.3g}") for i, v in kept.items()
    ]
    return grid([panels[i : i + 3] for i in range(0, len(panels), 3)])


def _table(rows: Sequence[tuple[str, object]]) -> str:
    cells = (f"<tr><th>{html.escape(name)}</th><td>{html.escape(str(text))}</td></tr>" for name, text in rows)
    return f"<table>{''.join(cells)}</table>"


def _white(pictures: Tensor, mask: Tensor) -> float:
    values = pictures[..., mask]
    values = values[values.isfinite()]
    return max(1e-12, float(values.kthvalue(max(1, int(0.995 * len(values)))).values)) if len(values) else 1.0


def _png(picture: Tensor, white: float) -> str:
    step = max(1, -(-max(picture.shape[-2:]) // LARGEST_PX))
    pixels = encoded(torch.nan_to_num(picture[:, ::step, ::step]).double() / white)
    with TemporaryDirectory() as folder:
        write_picture(Path(folder) / "p.png", pixels)
        data = base64.b64encode((Path(folder) / "p.png").read_bytes()).decode("ascii")
    return f'<img src="data:image/png;base64,{data}" style="min-width:128px;image-rendering:pixelated">'
