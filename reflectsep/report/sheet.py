"""The picture sheet of `check`, and the plot of a capture's motions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from reflectsep.io.files import atomic_write
from reflectsep.report.tone import tone, white_point

DPI = 100
COLUMNS = 6
PANEL_IN = 2.2
CLIPPED = (230, 30, 30)
COLOURS = {"good": "#2e7d32", "doubtful": "#b26a00", "bad": "#c62828"}
"""Of verdicts; the word is always written beside the colour."""


def write_sheet(  # noqa: PLR0913  (one drawing, told whole)
    path: Path | str,
    names: Sequence[str],
    pictures: Float[Tensor, "lights channels height width"],
    saturated: Bool[Tensor, "lights channels height width"],
    mask: Bool[Tensor, "height width"],
    *,
    maps: Mapping[str, Float[Tensor, "height width"]],
    motions: Mapping[str, Any],
    lines: Sequence[tuple[str, str, str]],
    title: str,
) -> None:
    """Write the sheet of a check: every picture with clipped values in red, maps of the sweeps, motions, findings.

    Args:
        path: `.png` to write, atomically.
        names: lights of `pictures`.
        pictures: developed.
        saturated: clipped values.
        mask: the object.
        maps: e.g. when the slab passed, by caption.
        motions: the document of an alignment.
        lines: subject, value and verdict of every finding.
        title: heading.
    """
    rows = -(-(len(names) + len(maps) + 1) // COLUMNS)
    text_in = 0.24 * len(lines) + 0.5
    figure = Figure(figsize=(COLUMNS * PANEL_IN, rows * (PANEL_IN + 0.35) + text_in + 0.5), dpi=DPI)
    height_in = figure.get_figheight()
    figure.text(0.01, 1 - 0.3 / height_in, title, fontsize=13, weight="bold")
    axes = [_axes(figure, index, height_in) for index in range(len(names) + len(maps))]
    axes.append(_axes(figure, len(axes), height_in, left=0.2))  # its scale needs room
    white = white_point([torch.nan_to_num(picture) for picture in pictures], mask)
    for axis, name, picture, clipped in zip(axes, names, pictures, saturated, strict=False):
        pixels = tone(picture, white=white)
        pixels[clipped.any(0).numpy()] = CLIPPED
        axis.imshow(pixels, interpolation="nearest")
        axis.set_title(name, fontsize=9)
    for axis, (caption, values) in zip(axes[len(names) :], maps.items(), strict=False):
        shown = np.where(mask.numpy(), values.double().numpy(), np.nan)
        image = axis.imshow(shown, interpolation="nearest", cmap="viridis")
        axis.set_title(caption, fontsize=9)
        bar = figure.colorbar(image, ax=axis, shrink=0.7)
        bar.ax.tick_params(labelsize=7)
    for axis in axes[:-1]:
        axis.set_xticks([])
        axis.set_yticks([])
    _draw_motions(axes[-1], motions)
    for i, (subject, value, verdict) in enumerate(lines):
        y = (text_in - 0.3 - 0.24 * i) / height_in
        figure.text(0.01, y, verdict, fontsize=9, color=COLOURS[verdict], weight="bold")
        figure.text(0.075, y, f"{subject}: {value}", fontsize=9)
    _write(figure, path)


def motion_plot(motions: Mapping[str, Any]) -> Float[Tensor, "3 height width"]:
    """Plot of the motions of an alignment's document, encoded for a screen, 0 to 1."""
    figure = Figure(figsize=(6, 5), dpi=DPI)
    _draw_motions(figure.add_axes((0.13, 0.12, 0.82, 0.78)), motions)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    return torch.from_numpy(pixels).permute(2, 0, 1).float() / 255.0


def _draw_motions(axis: Axes, motions: Mapping[str, Any]) -> None:
    """Shift of every picture and sweep at the middle of the reference, with its uncertainty and its rotation."""
    shown: list[tuple[str, Mapping[str, Any], str]] = []
    for name, motion in motions.get("pictures", {}).items():
        shown.append((name, motion, "o"))
    for motion in motions.get("sweeps", []):
        shown.append((f"{motion['light']} {motion['direction']}-sweep", motion, "s"))
    reach = 0.1
    for name, motion, marker in shown:
        if not motion["applied"]:
            continue
        x, y = _middle_shift(motion, motions.get("size"))
        axis.errorbar(x, -y, xerr=motion["sd_px"], yerr=motion["sd_px"], marker=marker, markersize=4, capsize=2)
        turned = f" {motion['rotation_deg']:+.2f}°" if abs(motion["rotation_deg"]) > 0.005 else ""
        axis.annotate(name + turned, (x, -y), fontsize=7, xytext=(4, 4), textcoords="offset points")
        vx, vy = motion["velocity_px"]
        if vx or vy:
            axis.annotate("", (x + vx, -y - vy), (x - vx, -y + vy), arrowprops={"arrowstyle": "->", "lw": 0.8})
        reach = max(reach, abs(x) + abs(vx) + motion["sd_px"], abs(y) + abs(vy) + motion["sd_px"])
    still = sum(not motion["applied"] for _, motion, _ in shown)
    axis.plot(0, 0, marker="+", color="black")
    axis.set_xlim(-1.3 * reach, 1.3 * reach)
    axis.set_ylim(-1.3 * reach, 1.3 * reach)
    axis.set_aspect("equal")
    axis.axhline(0, lw=0.4, color="grey")
    axis.axvline(0, lw=0.4, color="grey")
    axis.tick_params(labelsize=7)
    axis.set_title(f"motion, px ({still} of {len(shown)} did not move)", fontsize=9)


def _middle_shift(motion: Mapping[str, Any], size: Sequence[int] | None) -> tuple[float, float]:
    matrix = np.asarray(motion["matrix"])
    x, y = ((size[0] - 1) / 2, (size[1] - 1) / 2) if size else (0.0, 0.0)
    moved = matrix @ np.array([x, y, 1.0])
    return float(moved[0] / moved[2] - x), float(moved[1] / moved[2] - y)


def _axes(figure: Figure, index: int, height_in: float, left: float = 0.0) -> Axes:
    row, column = divmod(index, COLUMNS)
    top_in = 0.75 + row * (PANEL_IN + 0.35)
    inset = 0.1
    return figure.add_axes(
        (
            (column + inset / 2 + left) / COLUMNS,
            1 - (top_in + PANEL_IN * 0.92) / height_in,
            (1 - inset) / COLUMNS,
            PANEL_IN * 0.92 / height_in,
        )
    )


def _write(figure: Figure, path: Path | str) -> None:
    canvas = FigureCanvasAgg(figure)
    atomic_write(path, lambda temporary: canvas.print_png(str(temporary)))
