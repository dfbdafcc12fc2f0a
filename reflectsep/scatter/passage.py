"""When the slab passes each pixel: the first pass over a sweep's frames.

Only sums are kept, so memory does not grow with the number of frames. With q = frame / full picture (channel mean,
clamped at 0), a pixel's passage is the centroid of q^4 over the frames, which the lit frames dominate, and the number
of frames in which it is lit is the participation ratio (sum q^4)^2 / sum q^8. A centroid comes in steps of half a
frame; passage is smooth over the picture, so a local plane through the centroids (Gaussian weights) places it to a
small fraction of a frame, except where depth jumps: there the centroid itself stays.

The sums over the frames are single precision: their rounding moves a centroid by 1e-7 of the frames' number. They are
bound by memory, so that a tile of the picture is worked on for several frames while it is in the cache.
"""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d

from reflectsep.data import FrameStream, Sweep
from reflectsep.errors import SweepError
from reflectsep.io.ahead import one_thread
from reflectsep.progress import Progress
from reflectsep.room import copied, empty
from reflectsep.scatter.frames import Step, name_of, steps
from reflectsep.scatter.local import quantile
from reflectsep.scatter.width import Keeper, Kept

MIN_FRAMES = 5
CACHED = 1 << 14
"""Pixels of a tile."""
TOGETHER, TOGETHER_BYTES = 4, 128 * 2**20
"""Frames worked on at a time, and their bytes at most."""
LEAST_Q, MOST_Q = 1e-4, 1e4
"""Limits of q in the sums, whose eighth powers are floats; what is below counts for nothing in a fourth power."""
SMOOTHING_PX = 2.0
BROAD = 2.0
"""A profile so many times wider than the typical one is no passage of the slab."""
WEAK = 0.3
"""Weight below which a pixel takes its passage from its neighbours."""
JUMP_FRAMES = 1.5
"""A centroid farther than this from the local plane is a jump in depth, not noise."""


@dataclass(frozen=True, kw_only=True)
class Passage:
    """What the first pass over a sweep found."""

    sweep: Sweep
    centre: Float[Tensor, "height width"]
    """Frame, with fraction, in which the middle of the slab passes a pixel."""
    peak: Float[Tensor, "height width"]
    """Largest q of a pixel."""
    lit_frames: Float[Tensor, "height width"]
    """Frames in which a pixel is lit; meaningless where it never is."""
    narrow: Bool[Tensor, "height width"]
    """The profile is as narrow as the slab and peaks where it passes. In a shadow it is broad, or peaks elsewhere."""
    total: Float[Tensor, "channels height width"]
    """Sum of the frames, linear."""
    clipped: Bool[Tensor, "height width"]
    """Saturated in at least one frame."""
    first: int
    last: int
    received: int
    noise: float
    """Standard deviation of a frame's pixel where it is dark, from differences along time."""
    dark: float
    """Mean of the darkest frame: what is left of the black level, or of noise that was clipped at it."""
    sums: Float[Tensor, "exponents samples"]
    """Sums of the frames' roots at the sampled values, one row an exponent (for Eq. 25)."""
    lost_away: Float[Tensor, "height width"]
    """Frames between a pixel's lit interval and the nearest lost frame; infinite where none was lost."""
    kept: Kept
    """Frames of some pixels."""

    def lost_near(self, frames: float = 2.0) -> Bool[Tensor, "height width"]:
        """A frame near its passage was lost: its sum is not that of Eq. 25."""
        return self.lost_away <= frames

    def step_px(self, mask: Bool[Tensor, "height width"]) -> float:
        """Pixels that the slab moves in a frame, over the whole object."""
        inside = _eroded(mask)
        values = self.frames_per_px()[inside if inside.any() else mask]
        return float(1.0 / values.median().clamp(min=1e-3))

    def frames_per_px(self) -> Float[Tensor, "height width"]:
        """By how many frames the slab passes a pixel later than the one before it along its way."""
        return torch.gradient(self.centre, dim=1 if self.sweep.direction == "x" else 0)[0].abs()


def watch(
    stream: FrameStream,
    full: Float[Tensor, "channels height width"],
    mask: Bool[Tensor, "height width"],
    *,
    exponents: Float[Tensor, "exponents"],
    samples: Bool[Tensor, "channels height width"],
    progress: Progress,
) -> Passage:
    """Pass over a sweep once and find when the slab passes each pixel.

    Args:
        stream: frames of one sweep.
        full: the full picture of the same light.
        mask: the object.
        exponents: values of n_d for which the roots are summed.
        samples: values for which they are.
        progress: told after every frame.

    Raises:
        SweepError: fewer than 5 frames, or a frame that cannot be used.
    """
    grey = full.mean(0)
    floor = 0.01 * float(quantile(grey[mask].abs(), 0.99)) if mask.any() else 1.0
    scale = grey.clamp(min=max(floor, 1e-12))
    sums, keeper = _Sums(full, mask, scale, exponents, samples), Keeper(mask, len(stream))
    received = 0
    with one_thread(), closing(steps(stream, full, mask)) as walked:
        for step in walked:
            sums.add(step)
            keeper.add(step)
            received += not step.lost
            progress(f"sweep {stream.sweep.light} {stream.sweep.direction}: passage", step.index + 1, len(stream))
    if received < MIN_FRAMES:
        raise SweepError(f"{name_of(stream.sweep)}: {received} frames, expected at least {MIN_FRAMES}")
    return sums.passage(stream.sweep, received, keeper.kept())


def tiles(mask: Bool[Tensor, "height width"], pixels: int) -> list[tuple[slice, slice]]:
    """Rows and columns of strips of about so many pixels that cover the object, and little else."""
    found = []
    height, width = mask.shape
    lines = max(1, pixels // width)
    for top in range(0, height, lines):
        rows = slice(top, min(height, top + lines))
        columns = mask[rows].any(0).nonzero()[:, 0]
        if len(columns):
            found.append((rows, slice(int(columns[0]), int(columns[-1]) + 1)))
    return found


class _Tile:
    """Running sums of a part of the picture."""

    def __init__(self, place: tuple[slice, slice], maps: tuple[Tensor, ...], total: Tensor) -> None:
        self.place = place
        self.scale, self.q4, self.q8, self.q4t, self.peak = (each[place] for each in maps)
        self.total = total[(slice(None), *place)]

    def add(self, steps_: list[Step], scratch: Tensor) -> None:
        q = scratch[: self.scale.numel()].view(self.scale.shape)
        for step in steps_:
            values = step.values[(slice(None), *self.place)]
            self.total += values
            if step.lost:
                continue
            torch.mul(values[0] if len(values) == 1 else values.sum(0), self.scale, out=q)
            q.clamp_(LEAST_Q, MOST_Q)
            torch.maximum(self.peak, q, out=self.peak)
            q4 = q.square_().square_()
            self.q4 += q4
            self.q4t.add_(q4, alpha=step.index)
            self.q8.addcmul_(q4, q4)


class _Sums:
    """Running sums over the frames; their size is that of a few pictures."""

    def __init__(self, full: Tensor, mask: Tensor, scale: Tensor, exponents: Tensor, samples: Tensor) -> None:
        self.mask = mask
        self.powers, self.where = 1.0 / exponents.to(full), samples.flatten().nonzero()[:, 0]
        self.q4, self.q8, self.q4t, self.peak = (torch.zeros_like(scale) for _ in range(4))
        self.total = empty(*full.shape, dtype=full.dtype).zero_()
        maps = (1.0 / (len(full) * scale), self.q4, self.q8, self.q4t, self.peak)
        self.tiles = [_Tile(place, maps, self.total) for place in tiles(mask, CACHED)]
        self.scratch = torch.empty(max((tile.scale.numel() for tile in self.tiles), default=0), dtype=full.dtype)
        self.together = max(1, min(TOGETHER, TOGETHER_BYTES // (full.numel() * full.element_size())))
        self.waiting: list[Step] = []
        self.clipped = torch.zeros_like(mask)
        self.sums = torch.zeros((len(exponents), len(self.where)), dtype=torch.float64)
        self.lost: list[int] = []
        self.indices: list[int] = []
        self.recent: list[Tensor] = []
        self.noises: list[float] = []
        self.dark = math.inf

    def add(self, step: Step) -> None:
        self.indices.append(step.index)
        if step.lost:
            self.lost.append(step.index)
        self.waiting.append(step)
        if len(self.waiting) == self.together:
            self._add_waiting()
        if step.saturated is not None:
            self.clipped |= step.saturated.any(0)
        chosen = step.values.flatten()[self.where]
        # All roots from one logarithm: a power costs ten times what an exponential does.
        logs = chosen.abs().clamp_min(torch.finfo(chosen.dtype).tiny).log()
        self.sums += (logs * self.powers[:, None]).exp_() * chosen.sign()
        self._take_noise(chosen, step.lost)
        if len(chosen):
            self.dark = min(self.dark, float(chosen.mean()))

    def _add_waiting(self) -> None:
        for tile in self.tiles:
            tile.add(self.waiting, self.scratch)
        self.waiting = []

    def _take_noise(self, values: Tensor, lost: bool) -> None:
        """Second difference along time; its median size over the samples is noise, where most of them are dark."""
        self.recent = [] if lost else [*self.recent[-2:], values]
        if len(self.recent) == 3 and values.numel():
            a, b, c = self.recent
            self.noises.append(float(1.4826 * (a - 2 * b + c).abs().median() / 6**0.5))

    def passage(self, sweep: Sweep, received: int, kept: Kept) -> Passage:
        self._add_waiting()
        mask, peak = self.mask, torch.where(self.mask & (self.peak > LEAST_Q), self.peak, 0.0)
        centroid = self.q4t / self.q4.clamp(min=1e-30)
        lit = self.q4 / self.q8.clamp(min=1e-37) * self.q4
        centre = _smooth(centroid, _trust(lit, peak, mask), mask)
        width = float(lit[mask].median())
        lost_away = torch.full_like(centre, torch.inf)
        for index in self.lost:
            lost_away = torch.minimum(lost_away, (centre - index).abs() - width / 2)
        self.total *= mask
        return Passage(
            sweep=sweep,
            centre=copied(centre),
            peak=copied(peak),
            lit_frames=copied(lit),
            narrow=(lit < BROAD * width) & ((centroid - centre).abs() <= JUMP_FRAMES),
            total=self.total,
            clipped=self.clipped,
            first=self.indices[0],
            last=self.indices[-1],
            received=received,
            noise=float(torch.tensor(self.noises).quantile(0.25)) if self.noises else 0.0,
            dark=self.dark if math.isfinite(self.dark) else 0.0,
            sums=self.sums,
            lost_away=copied(lost_away),
            kept=kept,
        )


def _trust(lit: Tensor, peak: Tensor, mask: Tensor) -> Tensor:
    """Weight of a pixel's centroid: none where its profile is broad, little where it is low, as in a shadow."""
    narrow = mask & (lit < BROAD * lit[mask].median()) & (peak > 0)
    typical = peak[narrow].median() if narrow.any() else peak.max()
    return narrow * (peak / typical.clamp(min=1e-12)).clamp(max=1.0) ** 4


def _smooth(centroid: Tensor, weight: Tensor, mask: Tensor) -> Tensor:
    """Local plane through the centroids; Gaussian weights; wider where few pixels are trusted."""
    result = centroid
    # A little beyond the object too, since slopes are taken at its rim.
    weak = (weight < WEAK) & (max_pool2d(mask[None, None].float(), 3, stride=1, padding=1)[0, 0] > 0)
    for sigma in (SMOOTHING_PX, 4 * SMOOTHING_PX):
        if sigma > SMOOTHING_PX and not weak.any():
            break
        plane, mass = _local_plane(centroid, weight, sigma)
        near = (plane - centroid).abs() <= JUMP_FRAMES
        use = (mass > 0.05) & (weak | (near & (sigma == SMOOTHING_PX)))
        result = torch.where(use, plane, result)
        weak = weak & ~use
    return result


def _local_plane(centroid: Tensor, weight: Tensor, sigma: float) -> tuple[Tensor, Tensor]:
    """At every pixel the plane through the weighted centroids around it, and their weight."""
    height, width = centroid.shape
    radius = min(int(3 * sigma), min(height, width) - 1)
    offset = centroid[weight > 0].mean() if (weight > 0).any() else centroid.mean()
    moved = weight * (centroid - offset)
    plane, mass = torch.empty_like(centroid), torch.empty_like(centroid)
    lines = max(8 * radius, (1 << 18) // width)
    for top in range(0, height, lines):
        bottom = min(height, top + lines)
        halo = slice(max(0, top - radius), min(height, bottom + radius))
        own = slice(top - halo.start, bottom - halo.start)
        plane[top:bottom], mass[top:bottom] = _planes(weight[halo], moved[halo], own, sigma, radius)
    return plane + offset, mass


def _planes(weight: Tensor, moved: Tensor, own: slice, sigma: float, radius: int) -> tuple[Tensor, Tensor]:
    """Height of the local planes at the pixels of the rows `own`, by moments about each pixel itself."""
    away = torch.arange(-radius, radius + 1, dtype=weight.dtype)
    bell = torch.exp(-0.5 * (away / sigma) ** 2)
    bell = bell / bell.sum()
    kernels = torch.stack([bell, bell * away, bell * away**2])[:, None]

    def along_x(picture: Tensor, powers: int) -> Tensor:
        return conv2d(picture[None, None], kernels[:powers, :, None, :], padding=(0, radius))[0]

    def along_y(picture: Tensor, powers: int) -> Tensor:
        return conv2d(picture[None, None], kernels[:powers, :, :, None], padding=(radius, 0))[0][:, own].double()

    w = along_x(weight, 3)
    (m, m_y, m_yy), (m_x, m_xy), (m_xx,) = (along_y(w[i], 3 - i) for i in range(3))
    w = along_x(moved, 2)
    (r, r_y), (r_x,) = (along_y(w[i], 2 - i) for i in range(2))
    # A trace of ridge: where all weight lies on one line the plane is level across it.
    ridge = 1e-5 * sigma**2
    m_xx, m_yy = m_xx + ridge, m_yy + ridge
    determinant = m_xx * m_yy - m_xy**2
    x, y = (m_yy * m_x - m_xy * m_y) / determinant, (m_xx * m_y - m_xy * m_x) / determinant
    height = (r - x * r_x - y * r_y) / (m + 1e-12 - x * m_x - y * m_y)
    return height.to(weight.dtype), m.to(weight.dtype)


def _eroded(mask: Tensor) -> Tensor:
    inner = max_pool2d((~mask)[None, None].float(), 5, stride=1, padding=2)[0, 0] == 0
    return inner & mask


def speed_deviation(
    passage: Passage, full: Float[Tensor, "channels height width"], mask: Bool[Tensor, "height width"]
) -> float:
    """Robust relative spread of the slab's speed over the sweep.

    A patch is lit for longer where the slab is slow, so the sum of the frames over the full picture (Eq. 25) goes as
    one over the speed at a pixel's passage, whatever the shape of the object. Taken over pixels passed together.
    """
    grey, total = full.mean(0), passage.total.mean(0)
    sound = mask & ~passage.clipped & ~passage.lost_near()
    sound &= grey > 0.05 * grey[mask].max()
    frame, ratio = passage.centre[sound].round().long(), (total / grey)[sound]
    within = (frame >= passage.first) & (frame <= passage.last)
    order = frame[within].argsort(stable=True)
    groups = ratio[within][order].split(frame[within].bincount().tolist())
    medians = torch.tensor([float(r.median()) for r in groups if len(r) >= 4])
    if len(medians) < 3:
        return 0.0
    middle = medians.median()
    return float(1.4826 * (medians - middle).abs().median() / middle.abs().clamp(min=1e-6))
