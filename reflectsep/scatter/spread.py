"""Scattering of every pixel from the frames that do not light it, and the little of it that none of them shows.

Frames a slab's width apart tile the object: the sum of every C-th frame, from the first after a pixel's lit interval
on, holds the scattering of all that lies beyond one edge of it, each part once, and so on the other side. Only light
that entered within one step of the pixel, its own stripe, is in none of these frames. So

    s = Q + b (U - V),     Q = sum of g_i I_i over the frames,     b = sum of I_i over the next frames / A

with g_i 1 for every C-th frame (far away 1/C for all, which is the same where nothing changes quickly) and U, V, A sums
over a pixel's neighbours y, of how much of y's light the tiles leave out, of what is nearer than `distance_px`, and of
how much of y's light is in the next frames:

    U = sum phi(|x - y|) e(y) (1 - covered(y)),   V = sum phi e share(|x - y|),   A = sum phi e lit(y)

Everything is linear in the frames, and how a pixel lies within a step is in U and A, not in the result: no stripes. The
spread is a sum of exponentials with scales a factor of two apart,

    phi(r) = sum_m w_m e^(-r/l_m) / (2 pi l_m^2),    w_m >= 0

whose weights are fitted to the frames beside the lit interval over a neighbourhood (`Cells`), where pixels lie in all
places of a step. On a line of light at distance t it is L(t) = 2 t K_1(t/l) / (2 pi l^2), whose integral is tabulated.
Distances are along the surface, by the crude normals; e is how much light a pixel takes in, by the same.

A neighbour's part in a frame is that of its own passage. A camera that samples points has pixels lit wholly or not at
all: then the passage is in whole frames, told by the brightest run of them, not the smooth map of it (`point_sampled`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from reflectsep.room import empty
from reflectsep.scatter.geometry import Surface
from reflectsep.scatter.kernel import SCALES, scales, spread, strip
from reflectsep.scatter.local import gaussian, quantile
from reflectsep.scatter.windows import Profiles
from reflectsep.solve.nonnegative import nonnegative_least_squares

Picture = Float[Tensor, "channels height width"]
Map = Float[Tensor, "height width"]

FITTED = 6
"""Frames on either side that the spread is fitted to."""
NEXT = 1
"""Frames on either side that say how much a pixel scatters: those farther say less of what is hidden."""
SPOILT = 2
"""Frames in a row that may be lost or clipped beside the lit interval."""
INNER, RING, STRIDE = 4, 4, 3
"""Neighbours: every pixel up to INNER away, then blocks of STRIDE by STRIDE up to RING of them."""
MARGIN = 0.1
"""Of a pixel's extent in frames by which a lit interval is taken to be longer: the passage is no surer."""
NARROWEST, WIDEST = 0.05, 1.0
"""Limits of a pixel's extent in frames."""
POOL_STEPS = 4.0
"""Standard deviation of the neighbourhood that shares a spread, in steps of the slab."""
CALM_PX = 1.5
USUAL = 0.1
"""Pixels that differ from their neighbours no more than this part of all do are taken for equal, and averaged."""
MODEL_ERROR = 0.05
RIDGE = 3e-4
MOST = 20.0
"""Of the median pixel's amplitude."""
FIRST_WEIGHTS = (0.1, 0.3, 0.3, 0.2, 0.1)
ROWS_AT_ONCE = 1 << 16
"""Pixels of a strip of rows that is worked on at a time."""
POINT_SAMPLED = 0.2


@dataclass(frozen=True, kw_only=True)
class Slab:
    """The slab as the frames see it."""

    half: float
    """Half the number of frames in which it lights a patch, at least a half."""
    step_px: float
    whole: bool = False
    """Pixels are lit wholly or not at all in a frame."""

    @property
    def unsure(self) -> float:
        """Frames by which the passage may be off: of a slab no wider than its step it is known to a quarter only."""
        return 0.25 if self.half < 0.75 and not self.whole else 0.0

    @property
    def counts(self) -> tuple[int, ...]:
        """Whole frames in which a point may be lit."""
        low, high = max(1, math.floor(self.width + 0.1)), max(1, math.ceil(self.width - 0.1))
        return tuple({low, high})

    @property
    def width(self) -> float:
        """C: frames in which it lights a patch."""
        return 2.0 * self.half


def extent(centre: Map) -> Map:
    """Frames that the slab takes to pass from one end of a pixel to the other."""
    down, across = torch.gradient(centre)
    return (down.square() + across.square()).sqrt().clamp(NARROWEST, WIDEST)


def point_sampled(sweeps: Sequence[tuple[Tensor, Tensor, Tensor, Tensor, float]]) -> bool:
    """Whether pixels are lit wholly or not at all, as where a camera samples points.

    A pixel that the slab's edge would divide is looked for in the passage, and its first and last frame compared: they
    are alike if each lights half of it, and one is dark if it is a point.

    Args:
        sweeps: of each its frames at P pixels (frames, P), their numbers, the passage and the extent of these pixels,
            and half the frames in which a patch is lit.
    """
    found, expected = [], []
    for value, index, centre, wide, half in sweeps:
        count = max(1, round(2 * half))
        first = (centre - count / 2).round()
        away = (centre - first - count / 2).abs()
        row = (first - index[0]).long()
        inside = (row >= 1) & (row + count + 1 < len(value))
        row = row.clamp(1, max(1, len(value) - count - 2))
        run = torch.stack([value.gather(0, (row + i)[None].clamp(max=len(value) - 1))[0] for i in range(-1, count + 2)])
        ends, top = (run[1] - run[-2]).abs(), run[1:-1].amax(0)
        low = torch.minimum(run[1], run[-2]) if count > 1 else 0.5 * (run[0] + run[-1])
        soft = 2 * away / wide
        some = inside & (soft < 0.6) & (top > 0.3 * top.median())
        found.append((ends / (top - low).clamp(min=1e-12))[some])
        expected.append(soft[some])
    ratio, soft = torch.cat(found), torch.cat(expected)
    return len(ratio) >= 64 and float(ratio.median()) > float(soft.median()) + POINT_SAMPLED


class Cells:
    """Normal equations of the spread's weights, summed over squares of pixels as profiles arrive."""

    def __init__(self, shape: Sequence[int], channels: int, slab: Slab) -> None:
        self.side = max(4, round(2 * slab.step_px))
        self.shape = tuple(-(-length // self.side) for length in shape)
        self.width, self.slab, self.scales = shape[1], slab, scales(slab.step_px)
        count = self.shape[0] * self.shape[1]
        self.sums = torch.zeros(channels, SCALES * SCALES + SCALES, count)

    def add(self, at: Tensor, distance: Tensor, value: Tensor, trust: Tensor, noise: float) -> None:
        """Frames beside the lit interval of some pixels.

        Args:
            at: places of P pixels in the flattened picture.
            distance: of the slab's near and far edge along the surface, pixels (2, frames, P).
            value: root frames (frames, channels, P).
            trust: weight of each (frames, P), nothing where a frame is not to be used.
            noise: standard deviation of a root frame.
        """
        row, column = at.div(self.width, rounding_mode="floor"), at.remainder(self.width)
        cell = row.div(self.side, rounding_mode="floor") * self.shape[1] + column.div(self.side, rounding_mode="floor")
        lines = torch.stack([strip(distance[0], s) - strip(distance[1], s) for s in self.scales])  # scale, frame, P
        nominal = torch.tensordot(torch.tensor(FIRST_WEIGHTS), lines, 1)
        for c in range(len(self.sums)):
            own = value[:, c]
            size = 0.05 * 0.5 * own[:NEXT].clamp(min=0).sum(0) + noise / MODEL_ERROR + 1e-9
            weight = trust / (own.clamp(min=0) + size).square()
            amplitude = (weight * nominal * own).sum(0) / (weight * nominal.square()).sum(0).clamp(min=1e-20)
            amplitude = amplitude.clamp(min=1e-6)
            weight = weight * amplitude
            weighted = [line * weight for line in lines]
            normal = torch.zeros(SCALES, SCALES, len(at))
            for i, each in enumerate(weighted):
                for j in range(i + 1):
                    normal[i, j] = normal[j, i] = (each * lines[j]).sum(0) * amplitude
            right = torch.stack([(each * own).sum(0) for each in weighted])
            self.sums[c].index_add_(1, cell, torch.cat([normal.flatten(0, 1), right]))

    def weights(self) -> Float[Tensor, "channels scales rows columns"]:
        """W of every square, from the squares around it."""
        sigma = POOL_STEPS * self.slab.step_px / self.side
        channels = len(self.sums)
        maps = self.sums.flatten(0, 1).unflatten(1, self.shape)
        sums = torch.stack([gaussian(each, sigma) for each in maps]).view(channels, -1, self.sums.shape[2])
        normal = sums[:, : SCALES * SCALES].reshape(channels, SCALES, SCALES, -1).permute(1, 2, 0, 3).flatten(2)
        right = sums[:, SCALES * SCALES :].permute(1, 0, 2).flatten(1)
        trace = torch.diagonal(normal).sum(-1)
        normal = normal + torch.eye(SCALES)[..., None] * (RIDGE * trace + 1e-20)
        solved = nonnegative_least_squares(normal.double(), right.double()).float()
        return solved.view(SCALES, channels, *self.shape).transpose(0, 1)

    def at(self, weights: Tensor, rows: slice) -> Float[Tensor, "channels scales rows width"]:
        """Weights of the pixels of some rows, linear between the squares' middles."""
        for axis, places in ((-2, torch.arange(rows.start, rows.stop)), (-1, torch.arange(self.width))):
            place = ((places + 0.5) / self.side - 0.5).clamp(0, self.shape[axis] - 1)
            low = place.floor().long()
            high = (low + 1).clamp(max=self.shape[axis] - 1)
            share = (place - low).view(-1, 1) if axis == -2 else place - low
            weights = torch.lerp(weights.index_select(axis, low), weights.index_select(axis, high), share)
        return weights


class Spreading:
    """Takes a sweep's profiles and gives the scattering of every pixel."""

    def __init__(
        self, centre: Map, full: Picture, surface: Surface, slab: Slab, *, reach: int, noise: float, distance_px: float
    ) -> None:
        self.slab, self.surface, self.reach, self.noise, self.distance_px = slab, surface, reach, noise, distance_px
        self.centre, self.extent = centre.clone(), extent(centre)
        self.smooth, self.pace = centre, surface.pace(centre).clamp(max=4 * slab.step_px)
        self.cells = Cells(full.shape[1:], len(full), slab)
        self.lit = torch.zeros_like(centre, dtype=torch.bool)
        self.before, self.after = torch.zeros_like(centre), torch.zeros_like(centre)
        self.next, self.window = (empty(*full.shape, dtype=full.dtype).zero_() for _ in range(2))

    def tiles(self, profiles: Profiles) -> Float[Tensor, "channels P"]:
        """C Q - sum of the window's frames of some pixels; the rest is kept for `finish`."""
        root, at, width = profiles.root, profiles.at, self.slab.width
        frame = profiles.offset + self.smooth.flatten()[at]
        sound = profiles.present & ~profiles.saturated.any(1)
        centre = self._passage(profiles, frame)
        margin = self.slab.half + self.slab.unsure + (0.5 + MARGIN) * self.extent.flatten()[at]
        before, after = self._ends(frame, sound, centre, margin)
        self.centre.view(-1)[at] = centre
        self.lit.view(-1)[at] = profiles.lit
        self.before.view(-1)[at], self.after.view(-1)[at] = before, after
        weight = self._weights(frame, after, 1) + self._weights(frame, before, -1)
        self.window.flatten(1)[:, at] = root.sum(0)
        self._take(profiles, frame, sound, centre, before, after)
        return torch.einsum("fcp,fp->cp", root, weight * width - 1.0) * profiles.lit

    def _passage(self, profiles: Profiles, frame: Tensor) -> Tensor:
        """Middle of the lit interval: by the passage, or of the run of whole frames that stands out most."""
        smooth = self.smooth.flatten()[profiles.at]
        if not self.slab.whole:
            return smooth
        grey, counts = profiles.root.mean(1), self.slab.counts
        reach = max(counts) + 2
        middle = (smooth - frame[0]).round().long()
        near = (middle + torch.arange(-reach, reach + 1)[:, None]).clamp(0, len(grey) - 1)
        value = grey.gather(0, near)
        value = value - value.mean(0)
        centres, contrasts = [], []
        for count in counts:
            first = (smooth - frame[0] - (count - 1) / 2).round()
            for move in (-1, 0, 1):
                rows = (first + move - middle + reach).long() + torch.arange(count)[:, None]
                inside = value.gather(0, rows.clamp(0, 2 * reach)).sum(0).clamp(min=0.0)
                # Variance between the frames of the run and the others (Otsu 1979).
                contrasts.append(inside.square() / (count * (1 - count / (2 * reach + 1))))
                centres.append(frame[0] + first + move + (count - 1) / 2)
        found = torch.stack(centres).gather(0, torch.stack(contrasts).argmax(0)[None])[0]
        return torch.where(profiles.saturated.flatten(0, 1).any(0), smooth, found)

    def _ends(self, frame: Tensor, sound: Tensor, centre: Tensor, margin: Tensor) -> tuple[Tensor, Tensor]:
        """Last frame before and first after the lit interval that say something."""
        before, after = (centre - margin).floor(), (centre + margin).ceil()
        for _ in range(SPOILT):
            before = before - (~self._row(frame, sound, before)).float()
            after = after + (~self._row(frame, sound, after)).float()
        return before, after

    @staticmethod
    def _row(frame: Tensor, values: Tensor, index: Tensor) -> Tensor:
        """Values (frames, ..., P) of one frame a pixel."""
        row = (index - frame[0]).round().long().clamp(0, len(values) - 1)
        return values.gather(0, row.view(1, *[1] * (values.ndim - 2), -1).expand(1, *values.shape[1:]))[0]

    def _weights(self, frame: Tensor, start: Tensor, side: int) -> Float[Tensor, "frames P"]:
        """g: tiles from `start` on, frames between by their neighbours where C is no whole number, then 1/C."""
        width = self.slab.width
        away = (frame - start) * side
        count = max(1, int((self.reach - 1) // width))
        nearest = (away / width).round().clamp(0, count - 1)
        tile = (1.0 - (away - nearest * width).abs()).clamp(min=0.0)
        begin = count * width - self.slab.half + 0.5
        return torch.where(away > -0.5, tile + (away - begin + 0.5).clamp(0.0, 1.0) / width, 0.0)

    def _take(
        self, profiles: Profiles, frame: Tensor, sound: Tensor, centre: Tensor, before: Tensor, after: Tensor
    ) -> None:
        """Frames beside the lit interval, for the pixel's amplitude and its neighbourhood's spread."""
        at, half = profiles.at, self.slab.half
        pace = self.pace.flatten()[at]
        steep = ((self.slab.step_px / pace).clamp(max=1.0) * self.surface.facing.flatten()[at]) ** 4
        value, distance, trust = [], [], []
        for i in range(min(self.reach, FITTED)):
            for start, side in ((after, 1), (before, -1)):
                index = start + side * i
                away = (index - centre) * side
                value.append(self._row(frame, profiles.root, index))
                distance.append(torch.stack([(away - half).clamp(min=0.0) * pace, (away + half) * pace]))
                inside = ((index - frame[0]) >= 0) & ((frame[-1] - index) >= 0)
                trust.append(self._row(frame, sound, index) * profiles.lit * inside * steep)
        values = torch.stack(value)
        self.next.flatten(1)[:, at] = values[: 2 * NEXT].sum(0)
        self.cells.add(at, torch.stack(distance, 1), values, torch.stack(trust), self.noise)

    def finish(
        self, tiles: Picture, total: Picture, ceiling: Picture, *, frames: int, dark: float
    ) -> tuple[Picture, Picture]:
        """C times the scattering of every pixel, and how much of it no frame shows.

        Args:
            tiles: what `tiles` gave.
            total: sum of all root frames.
            ceiling: C times the root of the full picture, which no part of it exceeds.
            frames: of the sweep.
            dark: mean of a frame without light.
        """
        weights = self.cells.weights()
        gap, model = (empty(*total.shape, dtype=total.dtype) for _ in range(2))
        lines = max(1, ROWS_AT_ONCE // total.shape[2])
        for top in range(0, total.shape[1], lines):
            rows = slice(top, min(total.shape[1], top + lines))
            own = self.cells.at(weights, rows)
            left_out, beside = self._sums(rows)
            gap[:, rows] = (own * left_out).sum(1)
            model[:, rows] = (own * beside).sum(1)
        for c in range(len(total)):
            gap[c] *= self._amplitude(self.next[c], model[c]) * self.slab.width
        # A channel at a time: of a large picture there is no room for more.
        for c in range(len(total)):
            shown = _undarkened(self.window[c] + tiles[c], 2 * self.reach, dark)
            shown += _undarkened(total[c] - self.window[c], max(1, frames - 2 * self.reach), dark)
            # Of a pixel that is lit part of the picture is its own light.
            most = torch.minimum(shown + gap[c], ceiling[c].clamp(min=0.0))
            model[c] = torch.where(self.lit, most, shown)
        return model, gap

    def _amplitude(self, value: Map, model: Map) -> Map:
        """b, calmed: averaged with its neighbours' where these differ no more than is usual."""
        own = value.clamp(min=0.0) / model.clamp(min=1e-12)
        if not self.lit.any():
            return torch.zeros_like(own)
        own = torch.where(self.lit, own.clamp(max=MOST * float(own[self.lit].median())), 0.0)
        return _calmed(own, model * self.lit, lambda spread_: 1.3 * quantile(spread_[self.lit], USUAL))

    def _sums(self, rows: slice) -> tuple[Tensor, Tensor]:
        """U - V and A of every scale at the pixels of some rows."""
        halo = INNER + STRIDE * RING
        block = _Block(self, rows, halo)
        shape = (SCALES, rows.stop - rows.start, self.centre.shape[1])
        left_out, beside = torch.zeros(shape), torch.zeros(shape)
        near = range(-INNER, INNER + 1)
        for dy in near:
            for dx in near:
                if dy or dx:
                    block.add(dy, dx, 1, left_out, beside)
        ring = range(-RING, RING + 1)
        for dy in ring:
            for dx in ring:
                if max(abs(dy), abs(dx)) > INNER // STRIDE:
                    block.add(STRIDE * dy, STRIDE * dx, STRIDE, left_out, beside)
        beyond = self.cells.scales.new_tensor([_beyond_window(float(s)) for s in self.cells.scales])[:, None, None]
        left_out *= beyond
        beside *= beyond
        block.take_near(left_out)
        return left_out, beside


def _calmed(own: Map, weight: Map, usual: Callable[[Map], Tensor]) -> Map:
    """Each pixel's value, averaged with its neighbours' as far as these spread no more than usual (Lee 1980).

    Args:
        own: values.
        weight: of each.
        usual: from the relative variance about every pixel to the one that noise has.
    """
    mass = gaussian(weight, CALM_PX).clamp(min=1e-20)
    mean = gaussian(weight * own, CALM_PX) / mass
    square = gaussian(weight * own.square(), CALM_PX) / mass
    spread_ = (square / mean.square().clamp(min=1e-20) - 1.0).clamp(min=1e-9)
    return mean + (1.0 - usual(spread_) / spread_).clamp(min=0.0) * (own - mean)


def _undarkened(tail: Map, frames: int, dark: float) -> Map:
    """Sum of frames without the mean of noise that was clipped at black.

    For a signal s under noise of deviation e the mean is e f(s/e), f(x) = density(x) + x distribution(x), whose inverse
    is nearly sqrt(mean^2 - f(0)^2 e^2), and f(0) e is the mean where there is no light.
    """
    if dark <= 0.0:
        return tail
    mean = tail / frames
    return frames * mean.sign() * (mean.square() - dark**2).clamp(min=0.0).sqrt()


def _beyond_window(scale: float) -> float:
    """A line of light at one pixel's distance over its part within the neighbours that are summed."""
    along = torch.arange(-200.0, 201.0)
    value = torch.exp(-(1.0 + along.square()).sqrt() / scale)
    return float(value.sum() / value[along.abs() <= STRIDE * RING + 1].sum())


class _Block:
    """Some rows of a sweep's maps, with those around them."""

    def __init__(self, of: Spreading, rows: slice, halo: int) -> None:
        self.of, self.halo, self.height = of, halo, rows.stop - rows.start
        self.cut: Callable[[Tensor], Tensor] = lambda each: _cut(each, rows, halo)
        surface = of.surface
        self.slope_x, self.slope_y = self.cut(surface.slope_x), self.cut(surface.slope_y)
        self.light = self.cut(of.lit * surface.light)
        self.maps = {
            1: (self.cut(of.centre), self.cut(of.extent), self.light),
            STRIDE: (
                self.cut(of.smooth),
                self.cut(of.extent) * STRIDE,
                STRIDE**2 * avg_pool2d(self.light[None, None], STRIDE, 1, STRIDE // 2)[0, 0],
            ),
        }
        self.before, self.after = of.before[rows], of.after[rows]
        self.near: list[tuple[Tensor, Tensor]] = []

    def moved(self, each: Tensor, dy: int, dx: int) -> Tensor:
        """Values at the neighbours (dy, dx) away."""
        h = self.halo
        return each[h + dy : h + dy + self.height, h + dx : each.shape[1] - h + dx]

    def add(self, dy: int, dx: int, size: int, left_out: Tensor, beside: Tensor) -> None:
        """Add one neighbour's part to the sums of every scale."""
        centre, wide, light = (self.moved(each, dy, dx) for each in self.maps[size])
        half = self.of.slab.half
        rise = 0.5 * dx * (self.moved(self.slope_x, 0, 0) + self.moved(self.slope_x, dy, dx))
        rise += 0.5 * dy * (self.moved(self.slope_y, 0, 0) + self.moved(self.slope_y, dy, dx))
        distance = (rise.square_() + (dx * dx + dy * dy)).sqrt_()
        wide = wide.clamp(min=NARROWEST)
        covered = ((centre - self.after + half) / wide + 0.5).clamp_(0.0, 1.0)
        covered += ((self.before - centre + half) / wide + 0.5).clamp_(0.0, 1.0)
        hidden = (1.0 - covered).clamp_(0.0, 1.0) * light
        shown = torch.zeros_like(hidden)
        for i in range(NEXT):
            shown += ((half - (self.after + i - centre).abs()) / wide + 0.5).clamp_(0.0, 1.0)
            shown += ((half - (self.before - i - centre).abs()) / wide + 0.5).clamp_(0.0, 1.0)
        shown *= light
        for m, scale in enumerate(self.of.cells.scales):
            value = spread(distance, float(scale))
            left_out[m].addcmul_(value, hidden)
            beside[m].addcmul_(value, shown)
        if size == 1 and max(abs(dy), abs(dx)) < self.of.distance_px + 0.5:
            self.near.append((distance, light))

    def take_near(self, left_out: Tensor) -> None:
        """Take off what left nearer than `distance_px` from where it entered: V."""
        for distance, light in self.near:
            lost = (self.of.distance_px + 0.5 - distance).clamp_(0.0, 1.0)
            # Pixels of some extent: what of them is nearer lies in a steeper part of the spread.
            nearer = distance if self.of.slab.whole else distance - 0.25 * lost
            for m, scale in enumerate(self.of.cells.scales):
                left_out[m].addcmul_(spread(nearer, float(scale)), lost * light, value=-1.0)


def _cut(each: Tensor, rows: slice, halo: int) -> Tensor:
    """Rows of a map with `halo` more on all sides, nothing beyond the border."""
    top, bottom = max(0, rows.start - halo), min(len(each), rows.stop + halo)
    sides = (halo, halo, top - rows.start + halo, rows.stop + halo - bottom)
    return pad(each[top:bottom].float(), sides)
