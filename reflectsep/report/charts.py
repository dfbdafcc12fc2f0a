"""Figures of the report: every picture with a scale, every axis with a unit, colours for any colour vision."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter
from torch import Tensor

from reflectsep.report.figures import object_slices
from reflectsep.report.sweeps import SweepView
from reflectsep.report.tone import tone
from reflectsep.report.valley import Valley

SEQUENTIAL, DIVERGING, CYCLE = "cividis", "PuOr", ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Perceptually even maps, and the palette of Okabe and Ito (2008)."""
QUANTILE_OF = 2**22
"""Values that a quantile is taken of: torch sorts no more than 16 million."""
PANEL_IN = 2.4
PAGE_IN = 9.0
"""Width of the page that a figure stands in."""


class Chart(Figure):
    """A figure that a notebook shows without pyplot."""

    def _repr_png_(self) -> bytes:
        data = io.BytesIO()
        FigureCanvasAgg(self).print_png(data)
        return data.getvalue()


@dataclass(frozen=True, kw_only=True)
class Panel:
    """A picture of a grid: linear, (channels, height, width), shown with `white`; or a map with a colour bar."""

    title: str
    picture: Tensor | None
    white: float = 1.0
    caption: str = ""
    unit: str = ""
    """Of a map: what its colour bar says. Empty: a picture."""
    limits: tuple[float, float] | None = None
    logarithmic: bool = False
    diverging: bool = False


def grid(rows: Sequence[Sequence[Panel]], heads: Sequence[str] = (), mask: Tensor | None = None) -> Chart:
    """Panels in rows, with a heading left of each row where given; scales are pixels of the whole picture.

    Pictures are cut to the object where its `mask` is given.
    """
    shape = next(panel.picture.shape[-2:] for row in rows for panel in row if panel.picture is not None)
    box = (slice(0, shape[0]), slice(0, shape[1])) if mask is None else object_slices(mask)
    shape = (box[0].stop - box[0].start, box[1].stop - box[1].start)
    columns = max(map(len, rows))
    tall = min(1.5, max(0.4, shape[0] / shape[1]))
    wide = PANEL_IN + 0.35
    # A colour bar takes its room from the picture beside it.
    part = [0.66 if all(panel.unit for panel in row) else 0.86 for row in rows]
    size = (columns * wide + 0.35, sum(wide * tall * p + 0.75 for p in part))
    figure = Chart(figsize=size, layout="compressed")
    letters = max(1.0, size[0] / PAGE_IN)  # a wider figure is made smaller on the page: its letters shall not be
    # "compressed" brings pictures of a fixed shape together; what stands between them keeps its distance.
    figure.get_layout_engine().set(w_pad=0.09, h_pad=0.09)  # type: ignore[union-attr]
    axes = figure.subplots(len(rows), columns, squeeze=False, height_ratios=part)
    for i, row in enumerate(rows):
        for j in range(columns):
            if j < len(row) and row[j].picture is not None:
                _draw(figure, axes[i][j], row[j], letters)
                axes[i][j].set_xlim(box[1].start - 0.5, box[1].stop - 0.5)
                axes[i][j].set_ylim(box[0].stop - 0.5, box[0].start - 0.5)
            else:
                axes[i][j].axis("off")
        if i < len(heads):
            axes[i][0].set_ylabel(heads[i], fontsize=9 * letters, weight="bold")
    return figure


def _draw(figure: Figure, axes: Axes, panel: Panel, letters: float = 1.0) -> None:
    assert panel.picture is not None
    axes.set_title(panel.title, fontsize=9 * letters)
    axes.set_xlabel(f"px{'   ' if panel.caption else ''}{panel.caption}", fontsize=7.5 * letters)
    axes.tick_params(labelsize=6.5 * letters)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(4, integer=True))
    if not panel.unit:
        axes.imshow(tone(panel.picture, white=panel.white), interpolation="nearest")
        return
    values = panel.picture.detach().cpu().double().numpy()
    values = values[0] if values.ndim == 3 else values
    finite = values[np.isfinite(values)]
    low, high = panel.limits or (
        (float(np.quantile(finite, 0.01)), float(np.quantile(finite, 0.99))) if finite.size else (0.0, 1.0)
    )
    if panel.diverging:
        high = max(abs(low), abs(high), 1e-30)
        low = -high
    high = high if high > low else low + max(1e-12, abs(low))
    norm = LogNorm(max(low, high * 1e-6, 1e-30), high) if panel.logarithmic else Normalize(low, high)
    axes.set_facecolor("0.85")
    colours = DIVERGING if panel.diverging else SEQUENTIAL
    shown = np.ma.masked_invalid(values)
    axes.imshow(shown, norm=norm, cmap=colours, interpolation="nearest")
    bar = figure.colorbar(ScalarMappable(norm, colours), ax=axes, fraction=0.05, pad=0.02, extend="both")
    bar.set_label(panel.unit, fontsize=7.5 * letters)
    if panel.logarithmic:
        bar.ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        bar.ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        bar.ax.yaxis.set_minor_formatter(NullFormatter())
    bar.ax.tick_params(labelsize=6.5 * letters, which="both")


def upper_limit(values: Tensor) -> tuple[float, float]:
    """From 0 to what 99 % of the values stay below; of large maps evenly spaced values stand for all."""
    known = values[values.isfinite()]
    known = known[:: 1 + known.numel() // QUANTILE_OF]
    return 0.0, max(1e-12, float(known.double().quantile(0.99)) if known.numel() else 1e-12)


def dome(names: Sequence[str], vectors: Tensor, heldout: Mapping[str, Sequence[float]]) -> Chart:
    """Light directions on the hemisphere as the camera sees it; the basis with its triangle, held-out lights open."""
    figure = Chart(figsize=(4.6, 4.4), layout="constrained")
    axes = figure.subplots()
    for tilt in (15, 30, 45, 60, 90):
        r = math.sin(math.radians(tilt))
        turn = np.linspace(0, 2 * math.pi, 200)
        axes.plot(r * np.cos(turn), r * np.sin(turn), color="0.8", lw=0.8, zorder=0)
        axes.text(0, -r, f"{tilt}°", fontsize=7, color="0.45", ha="center", va="bottom")
    unit = (vectors / vectors.norm(dim=1, keepdim=True).clamp_min(1e-12)).numpy()
    around = np.concatenate([_arc(unit[i], unit[(i + 1) % 3]) for i in range(3)])
    axes.fill(around[:, 0], around[:, 1], color=CYCLE[5], alpha=0.25, lw=0, label="between the basis lights")
    axes.plot(unit[:3, 0], unit[:3, 1], "o", color=CYCLE[0], ms=8, label="basis")
    axes.plot(unit[3:, 0], unit[3:, 1], "s", color=CYCLE[1], ms=6, label="other lights of the fit")
    held = np.array([np.array(v) / np.linalg.norm(v) for v in heldout.values()]).reshape(-1, 3)
    if len(held):
        axes.plot(held[:, 0], held[:, 1], "D", mfc="none", color="k", ms=6, label="held out")
    for name, place in [*zip(names, unit, strict=True), *zip(heldout, held, strict=True)]:
        axes.annotate(name, place[:2], xytext=(5, 4), textcoords="offset points", fontsize=7)
    axes.set(xlim=(-1.08, 1.08), ylim=(-1.08, 1.08), aspect="equal", xlabel="x, to the right", ylabel="y, up")
    axes.tick_params(labelsize=7)
    axes.legend(fontsize=7, loc="upper right", framealpha=0.9)
    return figure


def _arc(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    path = start + np.linspace(0, 1, 30)[:, None] * (end - start)
    return path / np.linalg.norm(path, axis=1, keepdims=True)


def passage(views: Sequence[SweepView]) -> Chart:
    """When the slab passes: against position, with the straight line of a constant speed, and as a map."""
    figure = Chart(figsize=(9.2, 2.8 * len(views)), layout="constrained")
    figure.get_layout_engine().set(h_pad=0.09)  # type: ignore[union-attr]
    axes = figure.subplots(len(views), 2, squeeze=False, width_ratios=(1.7, 1))
    for (line, image), view in zip(axes, views, strict=True):
        row, column = torch.nonzero(view.peak.isfinite(), as_tuple=True)
        position, time = (column if view.direction == "x" else row), view.peak[row, column]
        line.plot(position, time, ".", ms=2, alpha=0.35, color=CYCLE[0], rasterized=True, label="pixels of the object")
        ends = torch.tensor([float(position.min()), float(position.max())])
        line.plot(ends, view.straight[0] + view.straight[1] * ends, color=CYCLE[1], lw=1.5, label="constant speed")
        speed = 1 / float(view.straight[1]) if float(view.straight[1]) else math.inf
        line.set_title(f"Light {view.light} along {view.direction}: {speed:.2f} px a frame", fontsize=9)
        line.set_xlabel(f"position along {view.direction}, px", fontsize=8)
        line.set_ylabel("frame in which it peaks", fontsize=8)
        line.tick_params(labelsize=7)
        line.legend(fontsize=7)
        panel = Panel(title="frame of the peak", picture=view.peak, unit="frame")
        _draw(figure, image, panel)
    return figure


def equation_25(views: Sequence[SweepView], gains: Mapping[tuple[str, str], float], mask: Tensor, n_d: float) -> Chart:
    """Sum of the frames' roots against the full picture's root, with the line of slope C, one plot a sweep."""
    columns = min(3, len(views))
    rows = math.ceil(len(views) / columns)
    figure = Chart(figsize=(3.3 * columns, 3.0 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).flatten()
    for axis in axes[len(views) :]:
        axis.axis("off")
    for axis, view in zip(axes, views, strict=False):
        x, y = view.root_full[:, mask].flatten(), view.root_sum[:, mask].flatten()
        chosen = torch.linspace(0, len(x) - 1, min(len(x), 4000)).long()
        axis.plot(x[chosen], y[chosen], ".", ms=1.5, alpha=0.4, color=CYCLE[0], rasterized=True)
        gain, most = gains[view.light, view.direction], float(x[x.isfinite()].max())
        axis.plot([0, most], [0, gain * most], color=CYCLE[1], lw=1.5, label=f"C = {gain:.4f}")
        axis.set_title(f"{view.light} along {view.direction}, n_d = {n_d:.4g}", fontsize=9)
        axis.set_xlabel("root of the full picture", fontsize=8)
        axis.set_ylabel("sum of the frames' roots", fontsize=8)
        axis.tick_params(labelsize=7)
        axis.legend(fontsize=8)
    return figure


def valley(found: Valley) -> Chart:
    """Contours of the misfit over a and B, and its lowest line."""
    figure = Chart(figsize=(8.6, 3.5), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.15, 1))
    rise = 100 * (found.misfit / found.misfit.min() - 1)
    scales = found.scales.numpy()
    levels = [0, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 10000]
    drawn = left.contourf(
        scales, scales, rise.clamp(0, 9999).numpy(), levels=levels, cmap=SEQUENTIAL, norm=_steps(levels)
    )
    figure.colorbar(drawn, ax=left, label="misfit above its least, %")
    left.plot(scales[rise.argmin(1)], scales, "--", color="w", lw=1.4)
    left.plot(1, 1, "o", mfc="none", mec=CYCLE[1], ms=9, mew=2, label="fitted")
    left.set(xlabel="B, times the fitted one", ylabel="a, times the fitted one")
    left.legend(fontsize=8, loc="lower right")
    right.plot(scales, 100 * (found.along / found.along.min() - 1), "o-", ms=3, lw=1.2, color=CYCLE[0])
    right.axvline(1, color=CYCLE[1], lw=1, ls="--")
    right.set(xlabel="a, times the fitted one", ylabel="misfit with B free, % above the least", ylim=(0, None))
    right.set_title("along the valley, B free at every pixel", fontsize=9)
    return figure


def _steps(levels: Sequence[float]) -> Normalize:
    from matplotlib.colors import BoundaryNorm

    return BoundaryNorm(levels, 256)
