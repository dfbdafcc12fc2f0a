"""When the slab passes each pixel: the first pass over a sweep's frames.

Only sums are kept, so memory does not grow with the number of frames. With q = frame / full picture (channel mean,
clamped at 0), a pixel's passage is the centroid of q^4 over the frames, which the lit frames dominate, and the number
of frames in which it is lit is the participation ratio (sum q^4)^2 / sum q^8. A centroid comes in steps of half a
frame; passage is smooth over the picture, so a local plane through the centroids (Gaussian weights) places it to a
small fraction of a frame, except where depth jumps: there the centroid itself stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from kornia.filters import gaussian_blur2d
from torch import Tensor

from reflectsep.data import FrameStream, Sweep
from reflectsep.errors import SweepError
from reflectsep.progress import Progress
from reflectsep.scatter.frames import Step, name_of, steps
from reflectsep.scatter.width import Keeper, Kept

MIN_FRAMES = 5
CACHED = 1 << 15
"""Pixels at a time."""
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
        slope = torch.gradient(self.centre, dim=1 if self.sweep.direction == "x" else 0)[0]
        inside = _eroded(mask)
        values = slope[inside if inside.any() else mask].abs()
        return float(1.0 / values.median().clamp(min=1e-3))


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
    floor = 0.01 * float(grey[mask].abs().quantile(0.99)) if mask.any() else 1.0
    scale = grey.clamp(min=max(floor, 1e-12))
    sums, keeper = _Sums(full, scale, exponents, samples), Keeper(mask)
    received = 0
    for step in steps(stream, full, mask):
        sums.add(step)
        keeper.add(step)
        received += not step.lost
        progress(f"sweep {stream.sweep.light} {stream.sweep.direction}: passage", step.index + 1, len(stream))
    if received < MIN_FRAMES:
        raise SweepError(f"{name_of(stream.sweep)}: {received} frames, expected at least {MIN_FRAMES}")
    return sums.passage(stream.sweep, mask, received, keeper.kept())


class _Sums:
    """Running sums over the frames; their size is that of a few pictures."""

    def __init__(self, full: Tensor, scale: Tensor, exponents: Tensor, samples: Tensor) -> None:
        self.scale, self.exponents, self.where = scale, exponents, samples.flatten().nonzero()[:, 0]
        zero = torch.zeros_like(scale, dtype=torch.float64)
        self.q4, self.q8, self.q4t, self.peak = zero, zero.clone(), zero.clone(), torch.zeros_like(scale)
        self.total = torch.zeros_like(full)
        self.clipped = torch.zeros_like(scale, dtype=torch.bool)
        self.sums = torch.zeros((len(exponents), len(self.where)), dtype=torch.float64)
        self.lost: list[int] = []
        self.indices: list[int] = []
        self.recent: list[Tensor] = []
        self.noises: list[float] = []

    def add(self, step: Step) -> None:
        self.indices.append(step.index)
        if step.lost:
            self.lost.append(step.index)
        else:
            self._watch(step)
        self.total += step.values
        self.clipped |= step.saturated.any(0)
        chosen = step.values.flatten()[self.where].double()
        # All roots from one logarithm: a power costs ten times what an exponential does.
        logs = chosen.abs().clamp_min(torch.finfo(chosen.dtype).tiny).log()
        self.sums += (logs / self.exponents[:, None]).exp_() * chosen.sign()
        self._take_noise(chosen, step.lost)

    def _watch(self, step: Step) -> None:
        """Sums of q^4 and its like, some lines at a time: what stays in the cache is several times as fast."""
        values, lines = step.values, max(1, CACHED // self.scale.shape[1])
        for start in range(0, len(self.scale), lines):
            cut = slice(start, start + lines)
            grey = values[0, cut] if len(values) == 1 else values[:, cut].mean(0)
            q = (grey / self.scale[cut]).clamp_(min=0.0)
            torch.maximum(self.peak[cut], q, out=self.peak[cut])
            q4 = q.double().square_().square_()
            self.q4[cut] += q4
            self.q8[cut].addcmul_(q4, q4)
            self.q4t[cut].add_(q4, alpha=step.index)

    def _take_noise(self, values: Tensor, lost: bool) -> None:
        """Second difference along time; its median size over the samples is noise, where most of them are dark."""
        self.recent = [] if lost else [*self.recent[-2:], values]
        if len(self.recent) == 3 and values.numel():
            a, b, c = self.recent
            self.noises.append(float(1.4826 * (a - 2 * b + c).abs().median() / 6**0.5))

    def passage(self, sweep: Sweep, mask: Tensor, received: int, kept: Kept) -> Passage:
        centroid = (self.q4t / self.q4.clamp(min=1e-30)).to(self.scale.dtype)
        lit = (self.q4**2 / self.q8.clamp(min=1e-60)).to(self.scale.dtype)
        centre = _smooth(centroid, _trust(lit, self.peak, mask))
        width = float(lit[mask].median())
        lost_away = torch.full_like(centre, torch.inf)
        for index in self.lost:
            lost_away = torch.minimum(lost_away, (centre - index).abs() - width / 2)
        return Passage(
            sweep=sweep,
            centre=centre,
            peak=self.peak,
            lit_frames=lit,
            narrow=(lit < BROAD * width) & ((centroid - centre).abs() <= JUMP_FRAMES),
            total=self.total,
            clipped=self.clipped,
            first=self.indices[0],
            last=self.indices[-1],
            received=received,
            noise=float(torch.tensor(self.noises).quantile(0.25)) if self.noises else 0.0,
            sums=self.sums,
            lost_away=lost_away,
            kept=kept,
        )


def _trust(lit: Tensor, peak: Tensor, mask: Tensor) -> Tensor:
    """Weight of a pixel's centroid: none where its profile is broad, little where it is low, as in a shadow."""
    narrow = mask & (lit < BROAD * lit[mask].median()) & (peak > 0)
    typical = peak[narrow].median() if narrow.any() else peak.max()
    return narrow * (peak / typical.clamp(min=1e-12)).clamp(max=1.0) ** 4


def _smooth(centroid: Tensor, weight: Tensor) -> Tensor:
    """Local plane through the centroids; Gaussian weights; wider where few pixels are trusted."""
    height, width = centroid.shape
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    result = centroid
    weak = weight < WEAK
    for sigma in (SMOOTHING_PX, 4 * SMOOTHING_PX):
        plane, mass = _local_plane(centroid, weight, x.to(centroid), y.to(centroid), sigma)
        near = (plane - centroid).abs() <= JUMP_FRAMES
        use = (mass > 0.05) & (weak | (near & (sigma == SMOOTHING_PX)))
        result = torch.where(use, plane, result)
        weak = weak & ~use
    return result


def _local_plane(centroid: Tensor, weight: Tensor, x: Tensor, y: Tensor, sigma: float) -> tuple[Tensor, Tensor]:
    radius = min(int(3 * sigma), min(centroid.shape) - 1)
    size = 2 * radius + 1

    def blur(image: Tensor) -> Tensor:
        return gaussian_blur2d(image.double()[None, None], (size, size), (sigma, sigma), border_type="constant")[0, 0]

    offset = centroid[weight > 0].mean() if (weight > 0).any() else centroid.mean()
    columns = [torch.ones_like(x), x - x.mean(), y - y.mean()]
    normal = torch.stack([torch.stack([blur(weight * a * b) for b in columns], -1) for a in columns], -2)
    right = torch.stack([blur(weight * a * (centroid - offset)) for a in columns], -1)
    # A trace of ridge: where all weight lies on one line the plane is level across it.
    ridge = 1e-6 * torch.eye(3, dtype=torch.float64)
    ridge[0, 0] = 1e-12
    coefficients = torch.linalg.solve(normal + ridge, right)
    plane = (coefficients * torch.stack(columns, -1)).sum(-1) + offset
    return plane.to(centroid.dtype), normal[..., 0, 0]


def _eroded(mask: Tensor) -> Tensor:
    inner = torch.nn.functional.max_pool2d((~mask)[None, None].float(), 5, stride=1, padding=2)[0, 0] == 0
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
    frame = passage.centre.round().long()
    ratios = [(total / grey)[sound & (frame == i)] for i in range(passage.first, passage.last + 1)]
    medians = torch.tensor([float(r.median()) for r in ratios if len(r) >= 4])
    if len(medians) < 3:
        return 0.0
    middle = medians.median()
    return float(1.4826 * (medians - middle).abs().median() / middle.abs().clamp(min=1e-6))
