"""The figure of `compare`: the paper's rows, ours beside the baseline, with the numbers.

One row for each chosen basis light (Figs. 4 and 6): original, scattering, local diffuse, specular, and the baseline's
diffuse and specular. One row for each held-out light (Figs. 5 and 7): the real picture, ours and its difference, the
baseline's and its difference. Every picture goes through one tone curve with one white; components that are faint have
a gain, shared by ours and the baseline's and written under them. All differences share one scale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from torch import Tensor

from reflectsep.io.files import atomic_write
from reflectsep.report.metrics import psnr, relative_rms
from reflectsep.report.tone import tone, white_point

DIVERGING = "PuOr"
"""Orange where the synthetic picture is too bright, purple where too dark; told apart with any colour vision."""
COLUMNS = 6
GAINS = (1, 2, 4, 8, 16, 32, 64)
DPI = 100
PANEL_IN = 2.3
GAP_IN = 0.14
MARGIN_IN = 0.3
HEAD_IN = 0.85
CAPTION_IN = 0.62
ROW_HEAD_IN = 0.5


@dataclass(frozen=True, kw_only=True)
class ComparisonRow:
    """What is known of one basis light. Pictures are linear, (channels, height, width)."""

    light: str
    original: Float[Tensor, "channels height width"]
    scattering: Float[Tensor, "channels height width"]
    local_diffuse: Float[Tensor, "channels height width"]
    specular: Float[Tensor, "channels height width"]
    baseline_diffuse: Float[Tensor, "channels height width"]
    baseline_specular: Float[Tensor, "channels height width"]
    true_scattering: Float[Tensor, "channels height width"] | None = None
    true_diffuse: Float[Tensor, "channels height width"] | None = None
    """All that is not specular, as the baseline's diffuse should be."""
    true_specular: Float[Tensor, "channels height width"] | None = None


@dataclass(frozen=True, kw_only=True)
class HeldOut:
    """A light that the fits never saw. Pictures are linear, (channels, height, width)."""

    light: str
    real: Float[Tensor, "channels height width"]
    ours: Float[Tensor, "channels height width"]
    baseline: Float[Tensor, "channels height width"]
    counts: Bool[Tensor, "height width"] | None = None
    """Pixels of the object that the numbers are over; leave clipped ones out. All of the object where None."""
    others: Mapping[str, Float[Tensor, "channels height width"]] = field(default_factory=dict)
    """The same light by other methods, by name."""
    note: str = ""
    """What was done to the real picture."""
    place: str = ""
    """Where the light stands, in words."""


def write_comparison(
    path: Path | str,
    rows: Sequence[ComparisonRow],
    held_out: Sequence[HeldOut],
    *,
    mask: Bool[Tensor, "height width"],
    title: str = "",
    baseline: str = "Lin & Lee",
) -> None:
    """Write `comparison_figure` as one PNG, atomically.

    Raises:
        ValueError: as `comparison_figure`.
    """
    figure = comparison_figure(rows, held_out, mask=mask, title=title, baseline=baseline)
    canvas = FigureCanvasAgg(figure)
    atomic_write(path, lambda temporary: canvas.print_png(str(temporary)))


def comparison_figure(
    rows: Sequence[ComparisonRow],
    held_out: Sequence[HeldOut],
    *,
    mask: Bool[Tensor, "height width"],
    title: str = "",
    baseline: str = "Lin & Lee",
) -> Figure:
    """The figure, not yet drawn.

    Args:
        rows: one a basis light to show.
        held_out: one a light to compare the relit pictures of.
        mask: the object; numbers are over it, and the pictures are cut to it.
        title: above everything.
        baseline: name of what ours is compared with; empty where ours has no scattering and is Lin & Lee's model
            itself: then nothing stands beside it.

    Raises:
        ValueError: nothing to show, an empty mask, or values on the object that are not finite.
    """
    if not rows and not held_out:
        raise ValueError("no rows to show; expected at least one basis light or held-out light")
    if not bool(mask.any()):
        raise ValueError("empty mask; expected at least one pixel of the object")
    mask = mask.cpu()
    for row in (*rows, *held_out):
        _check(row, mask)
    crop = object_slices(mask)
    white = white_point([*(row.original for row in rows), *(light.real for light in held_out)], mask)
    page = _Page(len(rows) + len(held_out), crop)
    page.head(
        title,
        f"sRGB curve, one exposure: white is {white:.3g} in the capture's units (times the gain, where one is given)",
    )
    gains = _gains(rows, mask, white)
    for index, row in enumerate(rows):
        _draw_components(page, index, row, mask, white, gains, baseline)
    limit = _difference_limit(held_out, mask)
    for index, light in enumerate(held_out, start=len(rows)):
        _draw_held_out(page, index, light, mask, white, limit, baseline)
    return page.figure


class _Page:
    """A grid of panels of one size, laid out in inches, so that pixels land on pixels whatever the number of rows."""

    def __init__(self, count: int, crop: tuple[slice, slice]) -> None:
        height, width = crop[0].stop - crop[0].start, crop[1].stop - crop[1].start
        self.crop = crop
        # Tall objects would make rows that do not fit a screen: bound the height, keep the shape.
        self.panel_w = min(PANEL_IN, 3.0 * width / height)
        self.panel_h = self.panel_w * height / width
        self.step = max(self.panel_w, 1.95) + GAP_IN
        self.row_h = ROW_HEAD_IN + self.panel_h + CAPTION_IN
        self.width = 2 * MARGIN_IN + COLUMNS * self.step - GAP_IN
        self.height = HEAD_IN + count * self.row_h + MARGIN_IN / 2
        self.figure = Figure(figsize=(self.width, self.height), dpi=DPI, facecolor="white")

    def head(self, title: str, note: str) -> None:
        """Title and what holds for all panels."""
        left = MARGIN_IN / self.width
        self.figure.text(left, 1 - 0.30 / self.height, title or "Comparison", fontsize=14, weight="bold", va="center")
        self.figure.text(left, 1 - 0.60 / self.height, note, fontsize=9.5, color="0.3", va="center")

    def row_head(self, row: int, text: str) -> None:
        """Heading of a row, with a rule above."""
        top = self.height - HEAD_IN - row * self.row_h
        self.figure.text(
            MARGIN_IN / self.width, (top - 0.13) / self.height, text, fontsize=11, weight="bold", va="center"
        )

    def axes(self, row: int, column: int, width_in: float | None = None) -> Axes:
        """Empty axes at a place of the grid."""
        left = MARGIN_IN + column * self.step
        bottom = self.height - HEAD_IN - row * self.row_h - ROW_HEAD_IN - self.panel_h
        width = self.panel_w if width_in is None else width_in
        return self.figure.add_axes(
            (left / self.width, bottom / self.height, width / self.width, self.panel_h / self.height)
        )

    def panel(self, row: int, column: int, pixels: np.ndarray, title: str, caption: str) -> None:
        """An 8-bit picture with a title above and lines of numbers below."""
        axes = self.axes(row, column)
        # Small pictures are enlarged without smoothing: what is seen is what was measured.
        enlarged = pixels.shape[0] < self.panel_h * DPI
        axes.imshow(pixels[self.crop], interpolation="nearest" if enlarged else "antialiased", aspect="auto")
        axes.set_xticks([])
        axes.set_yticks([])
        for spine in axes.spines.values():
            spine.set_color("0.75")
        axes.set_title(title, fontsize=9.5, pad=4)
        axes.set_xlabel(caption, fontsize=9, labelpad=4)


def _draw_components(
    page: _Page, index: int, row: ComparisonRow, mask: Tensor, white: float, gains: dict[str, int], baseline: str
) -> None:
    """The row of Figs. 4 and 6."""
    page.row_head(index, f"Basis light {row.light}")
    panels = (
        ("(a) original", row.original, "original", None),
        ("(b) scattering", row.scattering, "scattering", row.true_scattering),
        ("(c) local diffuse", row.local_diffuse, "local_diffuse", None),
        ("(d) specular", row.specular, "specular", row.true_specular),
        (f"(e) diffuse, {baseline}", row.baseline_diffuse, "diffuse", row.true_diffuse),
        (f"(f) specular, {baseline}", row.baseline_specular, "specular", row.true_specular),
    )
    if not baseline:
        panels = (panels[0], ("(b) diffuse", *panels[2][1:]), ("(c) specular", *panels[3][1:]))
    whole = row.original[:, mask].double().sum()
    for column, (title, picture, kind, truth) in enumerate(panels):
        gain = gains.get(kind, 1)
        share = 100.0 * float(picture[:, mask].double().sum() / whole) if float(whole) > 0 else 0.0
        lines = [f"shown ×{gain}" if gain > 1 else ""]
        if column > 0:
            lines[0] = f"{share:.0f} % of the light" + (f", shown ×{gain}" if gain > 1 else "")
        if truth is not None:
            lines.append(f"error {100 * relative_rms(picture, truth, mask):.0f} % of the true one")
        page.panel(index, column, tone(picture, white=white / gain), title, "\n".join(lines))


def _draw_held_out(
    page: _Page, index: int, light: HeldOut, mask: Tensor, white: float, limit: float, baseline: str
) -> None:
    """The row of Figs. 5 and 7, with the scale of the differences at its end."""
    page.row_head(index, f"Held-out light {light.light}" + (f", {light.place}" if light.place else ""))
    counts = mask if light.counts is None else mask & light.counts.cpu()
    norm = Normalize(-100 * limit / white, 100 * limit / white)
    colours = ScalarMappable(norm=norm, cmap=DIVERGING)
    page.panel(index, 0, tone(light.real, white=white), "(a) real", "")
    both = ((1, "ours", light.ours), (3, baseline, light.baseline))
    for column, name, picture in both if baseline else ((1, "", light.ours),):
        error = 100 * relative_rms(picture, light.real, counts)
        numbers = f"PSNR {psnr(picture, light.real, counts):.1f} dB\nRMS error {error:.1f} % of real"
        page.panel(
            index, column, tone(picture, white=white), f"({'abcd'[column]}) synthetic{name and f', {name}'}", numbers
        )
        difference = torch.where(mask, (light.real - picture).mean(0).cpu(), 0.0) * (100 / white)
        pixels = colours.to_rgba(difference.double().numpy(), bytes=True)[..., :3]
        worst = float(difference.abs().max())
        page.panel(
            index,
            column + 1,
            pixels,
            f"({'abcde'[column + 1]}) real − {name or 'synthetic'}",
            f"largest {worst:.1f} % of white",
        )
    bar = page.figure.colorbar(colours, cax=page.axes(index, 5 if baseline else 3, 0.16), extend="both")
    bar.set_label("real − synthetic, % of white", fontsize=9)
    bar.ax.tick_params(labelsize=9)


def _check(row: ComparisonRow | HeldOut, mask: Tensor) -> None:
    """Refuse pictures of different shapes, and values on the object that are not finite."""
    shapes = set()
    for entry in fields(row):
        picture = getattr(row, entry.name)
        if not isinstance(picture, Tensor) or picture.dtype == torch.bool:
            continue
        shapes.add(tuple(picture.shape))
        if picture.shape[-2:] != mask.shape:
            found, expected = tuple(picture.shape), tuple(mask.shape)
            raise ValueError(f"light {row.light}: {entry.name} of shape {found}, but the mask is {expected}")
        if not bool(torch.isfinite(picture[..., mask]).all()):
            raise ValueError(f"light {row.light}: {entry.name} has values on the object that are not finite")
    if len(shapes) != 1:
        raise ValueError(f"light {row.light}: pictures of shapes {sorted(shapes)}; expected one shape")


def object_slices(mask: Tensor) -> tuple[slice, slice]:
    """The object's bounding box with a margin of 4 %."""
    edges = []
    for size, seen in zip(mask.shape, (mask.any(1), mask.any(0)), strict=True):
        place = torch.nonzero(seen)[:, 0]
        first, last = int(place[0]), int(place[-1]) + 1
        margin = max(1, round(0.04 * (last - first)))
        edges.append(slice(max(0, first - margin), min(size, last + margin)))
    return edges[0], edges[1]


def _gains(rows: Sequence[ComparisonRow], mask: Tensor, white: float) -> dict[str, int]:
    """Gain of each kind of component: the largest power of two that leaves all but its brightest values below white."""
    kinds = {
        "scattering": [row.scattering for row in rows],
        "local_diffuse": [row.local_diffuse for row in rows],
        "specular": [picture for row in rows for picture in (row.specular, row.baseline_specular)],
    }
    gains = {}
    for kind, pictures in kinds.items():
        values = [picture[:, mask] for picture in pictures]
        # A component that is all but nothing stays dark: a gain would show its rounding.
        if not values or max(float(value.max()) for value in values) < 1e-3 * white:
            continue
        bright = max(white_point([picture], mask) for picture in pictures)
        gains[kind] = max(gain for gain in GAINS if gain == 1 or gain * bright <= white)
    return gains


def _difference_limit(held_out: Sequence[HeldOut], mask: Tensor) -> float:
    """Scale of all differences: what 99 % of the values of all of them stay below."""
    sizes = [
        (light.real - picture).mean(0, keepdim=True).abs()
        for light in held_out
        for picture in (light.ours, light.baseline)
    ]
    return white_point(sizes, mask, share=0.99) if sizes else 1.0
