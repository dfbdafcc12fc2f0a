"""A tiny body under a slab: light enters a disc, spreads by e^(-r/s), and leaves; nothing of the fit's model in it."""

from dataclasses import dataclass, field

import pytest
import torch
from torch import Tensor

from reflectsep.data import Frame, PhotometricStack, Sweep

SIZE = 24


@dataclass
class Stream:
    """Frames in memory."""

    sweep: Sweep
    frames: list[Tensor]
    lost: frozenset[int] = frozenset()
    clip: float | None = None
    passes: list[int] = field(default_factory=list)

    def __len__(self):
        return len(self.frames)

    def __iter__(self):
        self.passes.append(1)
        for i, values in enumerate(self.frames):
            if i not in self.lost:
                clipped = None if self.clip is None else values >= self.clip
                yield Frame(
                    index=i, values=values if self.clip is None else values.clamp(max=self.clip), saturated=clipped
                )


@dataclass
class Body:
    """A flat translucent disc and the light that enters it."""

    spread_px: float = 2.0
    albedo: float = 0.5
    """Part of the light that scatters; 0: opaque."""
    local: float = 0.4
    width_px: float = 2.6
    step_px: float = 1.0
    shadow: bool = False
    channels: int = 1

    def __post_init__(self):
        y, x = torch.meshgrid(
            torch.arange(SIZE, dtype=torch.float64), torch.arange(SIZE, dtype=torch.float64), indexing="ij"
        )
        c = (SIZE - 1) / 2
        self.x, self.y = x, y
        self.mask = (x - c) ** 2 + (y - c) ** 2 < 9.7**2
        r = torch.hypot(x.flatten()[:, None] - x.flatten(), y.flatten()[:, None] - y.flatten())
        kernel = torch.exp(-r / self.spread_px)
        kernel[~self.mask.flatten()] = 0
        kernel *= self.albedo / (2 * torch.pi * self.spread_px**2)
        self.transport = kernel
        self.r = r

    def entering(self, light):
        """Irradiance of light k: a slope over the disc, and a strip in shadow where asked."""
        slope = [(0.03, 0.0), (-0.02, 0.02), (0.0, -0.03)][light]
        e = (0.8 + slope[0] * (self.x - 12) + slope[1] * (self.y - 12)).clamp(min=0) * self.mask
        if self.shadow:
            e = e * ~((self.x > 7) & (self.x < 17) & (self.y > 12))
        return e

    def picture(self, e):
        scattered = (self.transport @ e.flatten()).view(SIZE, SIZE)
        return ((self.local * e + scattered) * self.mask).float().expand(self.channels, SIZE, SIZE)

    def truth(self, light, beyond_px):
        far = self.transport * (self.r > beyond_px)
        return ((far @ self.entering(light).flatten()).view(SIZE, SIZE) * self.mask).float()

    def frames(self, light, direction="x", start_px=-7.3, until_px=SIZE + 7.0):
        """Slab of any width; a pixel on its edge is lit in part."""
        along = self.x if direction == "x" else self.y
        frames, low = [], start_px
        while low < until_px:
            covered = (
                torch.minimum(along + 0.5, torch.tensor(low + self.width_px)) - (along - 0.5).clamp(min=low)
            ).clamp(min=0)
            frames.append(self.picture(self.entering(light) * covered))
            low += self.step_px
        return frames

    def stack(self, *, extra=(), noise=0.0, seed=0, gamma=1.0):
        """Full pictures of the basis, and of mixes of them."""
        pictures = [self.picture(self.entering(k)) for k in range(3)]
        alpha = torch.cat([torch.eye(3), torch.tensor(extra, dtype=torch.float32).view(-1, 3)])
        images = torch.einsum("jk,kchw->jchw", alpha, torch.stack(pictures)) ** gamma
        g = torch.Generator().manual_seed(seed)
        images = images + noise * images.max() * torch.randn(images.shape, generator=g)
        return PhotometricStack(
            names=tuple(f"L{j + 1}" for j in range(len(alpha))),
            images=images * self.mask,
            saturated=torch.zeros_like(images, dtype=torch.bool),
            mask=self.mask,
            alpha=alpha,
            view=torch.tensor([0.0, 0.0, 1.0]),
            flags=torch.zeros(SIZE, SIZE, dtype=torch.int64),
        )

    def stream(self, light, direction="x", *, gain=1.0, noise=0.0, lost=(), clip=None, gamma=1.0, **kwargs):
        frames = self.frames(light, direction, **kwargs)
        g = torch.Generator().manual_seed(100 + light)
        frames = [gain * f**gamma + noise * torch.randn(f.shape, generator=g) for f in frames]
        sweep = Sweep(
            light=f"L{light + 1}",
            direction=direction,
            count=len(frames),
            frames=f"sweep/L{light + 1}/{{:04d}}.exr",
            exposure_s=0.01,
            lost=frozenset(lost),
        )
        return Stream(sweep=sweep, frames=frames, lost=frozenset(lost), clip=clip)

    def streams(self, **kwargs):
        return [self.stream(k, **kwargs) for k in range(3)]


def relative(estimate, truth, scale=None):
    scale = truth if scale is None else scale
    return float((estimate - truth).norm() / scale.norm())


@pytest.fixture
def body():
    return Body


@pytest.fixture
def error():
    return relative
