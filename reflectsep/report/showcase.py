"""The figure of `demo`: one picture taken apart beside the simulator's truth, and one light that no fit saw, relit.

Three rows of five panels on a dark page. First a photograph and what it is the sum of, and the photograph without its
highlights; below each component the truth. Then a photograph under another light, the two models' pictures under it,
and how far each is off. All pictures share one exposure and the sRGB curve; gains are written where there are any.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from reflectsep.data import Vector
from reflectsep.io.pictures import write_picture
from reflectsep.report.figures import HeldOut, object_slices
from reflectsep.report.metrics import psnr, relative_rms
from reflectsep.report.tone import tone, white_point

DPI = 100
WIDTH_PX = 1600
MARGIN_PX, GAP_PX = 28, 21
TITLE_PX, CAPTION_PX = 34, 30
"""Above and below every panel."""
PAGE, INK, FAINT, ACCENT = "#111317", "#f2f0ea", "#a5a8ae", "#f0b35a"
GAINS = (8, 4, 2, 1)


@dataclass(frozen=True, kw_only=True)
class Apart:
    """A photograph and its components by one model, or as they are in truth; linear, (channels, height, width)."""

    photograph: Float[Tensor, "channels height width"]
    specular: Float[Tensor, "channels height width"]
    local_diffuse: Float[Tensor, "channels height width"]
    scattering: Float[Tensor, "channels height width"]
    highlight_free: Float[Tensor, "channels height width"]


@dataclass(frozen=True, kw_only=True)
class _Panel:
    """What is drawn at one place of the grid."""

    title: str = ""
    caption: str = ""
    picture: Float[Tensor, "channels height width"] | None = None
    gain: int = 1
    sign: str = ""
    """Written in the gap before it."""
    light: Vector | None = None
    """Drawn as a dot in a ring: where the light stands, seen from the camera."""


def write_figure(path: Path | str, figure: Figure) -> None:
    """Draw a figure into a `.png` of three channels, atomically."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    # Nobody sees the last bit, which is an eighth of the file: it is the pictures' noise.
    pixels = np.asarray(canvas.buffer_rgba())[..., :3] & np.uint8(0xFE)
    write_picture(path, torch.from_numpy(pixels).permute(2, 0, 1))


def showcase_figure(
    ours: Apart,
    truth: Apart,
    baseline: Apart,
    relit: HeldOut,
    *,
    mask: Bool[Tensor, "height width"],
    directions: Sequence[Vector],
    words: str = "",
) -> Figure:
    """The figure, not yet drawn.

    Args:
        ours: One photograph by our model.
        truth: The same, as it is.
        baseline: The same by Lin & Lee's model, for the numbers.
        relit: A light that no fit saw: its photograph, and it relit.
        mask: The object: everything else is shown as the page, and numbers are over it.
        directions: Of the first photograph's light and of the second's.
        words: What was done, for the first line.

    Raises:
        ValueError: pictures of different shapes, an empty mask, or a value on the object that is not finite.
    """
    white = white_point([truth.photograph, relit.real], mask, share=0.99)
    gains = {
        part: _gain([getattr(ours, part), getattr(truth, part)], mask, white)
        for part in ("specular", "local_diffuse", "scattering")
    }
    first = _components(ours, gains)
    first[0] = replace(first[0], title="photograph", light=directions[0])
    below = [replace(panel, title="", sign="") for panel in _components(truth, gains)[1:]]
    below = [
        replace(panel, caption=_errors(part, ours, truth, baseline, mask))
        for panel, part in zip(below, ("specular", "local_diffuse", "scattering", "highlight_free"), strict=True)
    ]
    counts = mask if relit.counts is None else mask & relit.counts
    errors = [(picture - relit.real).abs() for picture in (relit.ours, relit.baseline)]
    gain = _gain([torch.maximum(*errors)], mask, white, share=0.99)

    def score(picture: Tensor) -> str:
        return f"{psnr(picture, relit.real, counts):.1f} dB"

    plain = f"  (least squares {score(relit.others['Lambert'])})" if "Lambert" in relit.others else ""
    last = [
        _Panel(title="photograph, light held out", picture=relit.real, light=directions[1]),
        _Panel(title="relit, reflectsep", picture=relit.ours, caption=f"{score(relit.ours)} from the photograph"),
        _Panel(title="relit, Lin & Lee", picture=relit.baseline, caption=f"{score(relit.baseline)}{plain}"),
        *(
            _Panel(title=f"error, {name}", picture=error, gain=gain, caption=f"shown ×{gain}" if gain > 1 else "")
            for name, error in zip(("reflectsep", "Lin & Lee"), errors, strict=True)
        ),
    ]
    page = _Page(mask)
    for row, panels in enumerate((first, [_Panel(), *below], last)):
        for column, panel in enumerate(panels):
            page.draw(row, column, panel, white)
    page.note(1, "the truth,\nknown from the\nsimulation", words)
    return page.figure


def _components(apart: Apart, gains: dict[str, int]) -> list[_Panel]:
    """A photograph, what it is the sum of, and the same without its highlights."""
    return [
        _Panel(picture=apart.photograph),
        _Panel(title="off-specular", sign="=", picture=apart.specular, gain=gains["specular"]),
        _Panel(title="local diffuse", sign="+", picture=apart.local_diffuse, gain=gains["local_diffuse"]),
        _Panel(title="scattering", sign="+", picture=apart.scattering, gain=gains["scattering"]),
        _Panel(title="highlights removed", picture=apart.highlight_free),
    ]


def _errors(part: str, ours: Apart, truth: Apart, baseline: Apart, mask: Tensor) -> str:
    """Caption of a true component: how far the fitted ones are off it."""
    real = getattr(truth, part)
    said = f"reflectsep off by {100 * relative_rms(getattr(ours, part), real, mask):.0f} %"
    if part in ("specular", "highlight_free"):  # Lin & Lee know no other
        said += f", Lin & Lee {100 * relative_rms(getattr(baseline, part), real, mask):.0f} %"
    return said


def _gain(pictures: Sequence[Tensor], mask: Tensor, white: float, share: float = 0.995) -> int:
    """The largest gain that leaves all but the brightest values of all of them below white."""
    bright = max(white_point([picture], mask, share=share) for picture in pictures)
    return max(gain for gain in GAINS if gain == 1 or gain * bright <= white)


class _Page:
    """A dark page with a grid of panels, laid out in pixels."""

    def __init__(self, mask: Tensor) -> None:
        self.mask = mask
        self.crop = object_slices(mask)
        high, wide = (part.stop - part.start for part in self.crop)
        self.panel_w = (WIDTH_PX - 2 * MARGIN_PX - 4 * GAP_PX) / 5
        self.panel_h = self.panel_w * high / wide
        # The first row has no captions and the second, which belongs to it, no titles.
        self.tops = [MARGIN_PX / 2 + TITLE_PX]
        self.tops.append(self.tops[0] + self.panel_h + GAP_PX)
        self.tops.append(self.tops[1] + self.panel_h + CAPTION_PX + GAP_PX + TITLE_PX)
        self.height = self.tops[2] + self.panel_h + CAPTION_PX + MARGIN_PX / 2
        self.figure = Figure(figsize=(WIDTH_PX / DPI, self.height / DPI), dpi=DPI, facecolor=PAGE)

    def draw(self, row: int, column: int, panel: _Panel, white: float) -> None:
        """One panel, its title above and its caption below."""
        if panel.picture is None:
            return
        left, top = self._corner(row, column)
        axes = self._axes(left, top)
        pixels = tone(torch.where(self.mask, panel.picture, 0.0), white=white / panel.gain)
        page = np.array([int(PAGE[at : at + 2], 16) for at in (1, 3, 5)], dtype=np.uint8)
        pixels[~self.mask.numpy()] = page
        axes.imshow(pixels[self.crop], interpolation="lanczos", aspect="auto")
        middle = left + self.panel_w / 2
        shown = f"  ×{panel.gain}" if panel.gain > 1 and not panel.caption else ""
        self._write(middle, top - 12, panel.title + shown, size=15, color=INK)
        self._write(middle, top + self.panel_h + 12, panel.caption, size=12.5, color=ACCENT)
        if panel.sign:
            self._write(left - GAP_PX / 2, top + self.panel_h / 2, panel.sign, size=22, color=INK)
        if panel.light is not None:
            _draw_light(axes, panel.light, (self.crop[0].stop - self.crop[0].start) / self.panel_h)

    def note(self, row: int, text: str, words: str) -> None:
        """Words in place of a row's first panel."""
        left, top = self._corner(row, 0)
        self.figure.text(
            (left + self.panel_w - 12) / WIDTH_PX, 1 - (top + self.panel_h / 2) / self.height, text,
            fontsize=15, color=INK, ha="right", va="center", linespacing=1.4,
        )  # fmt: skip
        self.figure.text(
            (left + self.panel_w - 12) / WIDTH_PX, 1 - (top + self.panel_h / 2 + 90) / self.height, words,
            fontsize=11, color=FAINT, ha="right", va="center", linespacing=1.4,
        )  # fmt: skip

    def _corner(self, row: int, column: int) -> tuple[float, float]:
        """Left and top of a panel, pixels from the page's."""
        return MARGIN_PX + column * (self.panel_w + GAP_PX), self.tops[row]

    def _axes(self, left: float, top: float) -> Axes:
        bottom = self.height - top - self.panel_h
        place = (left / WIDTH_PX, bottom / self.height, self.panel_w / WIDTH_PX, self.panel_h / self.height)
        axes = self.figure.add_axes(place)
        axes.set_axis_off()
        return axes

    def _write(self, x: float, y: float, text: str, *, size: float, color: str) -> None:
        """Text about a point, pixels from the page's left and top."""
        self.figure.text(x / WIDTH_PX, 1 - y / self.height, text, fontsize=size, color=color, ha="center", va="center")


def _draw_light(axes: Axes, towards: Vector, per_px: float) -> None:
    """A ring with a dot where the light stands on the half sphere above the object, in the lower left corner."""
    height = axes.get_ylim()[0]
    radius = 17 * per_px
    x, y = radius * 1.4, height - radius * 1.4
    turn = np.linspace(0, 2 * math.pi, 61)
    axes.plot(x + radius * np.cos(turn), y + radius * np.sin(turn), color=FAINT, linewidth=1.2)
    length = math.hypot(*towards)
    axes.plot([x + radius * towards[0] / length], [y - radius * towards[1] / length], "o", color=ACCENT, markersize=6)
