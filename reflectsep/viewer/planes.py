"""What the page draws from: the parameters of a result as a pyramid of planes, stored as half floats in tiles.

A pixel is relit from d, s and w = a + B mean_c d (Eqs. 18, 20 and 21), so that the page needs neither a nor B for a
picture; B goes along to be read out. w is stored rather than B because the lobe takes the difference of a and B d to
a high power: rounding B would be seen, rounding w is not. A coarser level is the mean of 2 x 2 pixels of the object.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from reflectsep.flags import Flag
from reflectsep.model import diffuse, length, lobe_of, mixed
from reflectsep.separation import Separation

TILE = 512
"""Pixels along a tile's side, without its apron."""
APRON = 1
"""Pixels that a tile shares with the next one, to interpolate across its edge."""
SMALLEST = 256
"""A level no longer than this is the last of its pyramid."""
FLAG_BITS = 10
"""A half float holds whole numbers up to 2048: flags are stored in two parts of this many bits."""
MATERIAL_BIT = 6
"""Of the upper part: from here to the mask's bit it holds the material."""
HALF_MAX = 60000.0


@dataclass(frozen=True, kw_only=True)
class Level:
    """Parameters of a picture at one resolution, in the capture's units for lights of unit intensity."""

    factor: int
    """Pixels of the result along a pixel of this level."""
    d: Float[Tensor, "3 channels height width"]
    s: Float[Tensor, "3 channels height width"]
    w: Float[Tensor, "3 height width"]
    """The lobe's argument under every basis light, a + B m."""
    B: Float[Tensor, "height width"]
    flags: Int[Tensor, "height width"]
    mask: Bool[Tensor, "height width"]
    material: Int[Tensor, "height width"]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.mask.shape[1], self.mask.shape[0]


def full_level(separation: Separation) -> Level:
    """The parameters of a result at its own resolution."""
    return Level(
        factor=1,
        d=separation.d,
        s=separation.s,
        w=separation.lobe_vector,
        B=separation.B,
        flags=separation.flags.to(torch.int64),
        mask=separation.mask,
        material=separation.material,
    )


def pyramid(level: Level, max_pixels: int) -> list[Level]:
    """Levels from the finest of at most `max_pixels` pixels down to one no longer than `SMALLEST`, the finest first."""
    while level.mask.numel() > max_pixels and max(level.size) > 1:
        level = halved(level)
    levels = [level]
    while max(levels[-1].size) > SMALLEST:
        levels.append(halved(levels[-1]))
    return levels


def halved(level: Level) -> Level:
    """The level of half the resolution: means over the object's pixels in every 2 x 2, all of their flags."""
    weight = level.mask[None].float()
    share = halved_picture(weight)

    def mean(values: Tensor) -> Tensor:
        flat = values.reshape(-1, *values.shape[-2:])
        small = halved_picture(flat * weight) / share.clamp_min(1e-6)
        return small.reshape(*values.shape[:-2], *small.shape[-2:])

    seen = pad(torch.where(level.mask, level.flags, 0), _odd(level.flags))
    flags = seen[::2, ::2] | seen[1::2, ::2] | seen[::2, 1::2] | seen[1::2, 1::2]
    mask = share[0] >= 0.5
    return Level(
        factor=2 * level.factor,
        d=mean(level.d) * mask,
        s=mean(level.s) * mask,
        w=mean(level.w) * mask,
        B=mean(level.B[None])[0] * mask,
        flags=torch.where(mask, flags, int(Flag.OUTSIDE_MASK)),
        mask=mask,
        material=torch.where(mask, pad(level.material, _odd(level.material))[::2, ::2], 0),
    )


def halved_picture(picture: Float[Tensor, "maps height width"]) -> Float[Tensor, "maps half_height half_width"]:
    """Means of 2 x 2 pixels; an odd last row or column counts as half of nothing."""
    return avg_pool2d(pad(picture, _odd(picture)), 2)


def _odd(picture: Tensor) -> tuple[int, int, int, int]:
    return (0, picture.shape[-1] % 2, 0, picture.shape[-2] % 2)


def stored(level: Level, scale: tuple[float, float]) -> Float[np.ndarray, "planes height width"]:
    """Planes of a level in float16, four a texture layer: per channel d and s, then w; each with one plane beside.

    Args:
        level: what to store.
        scale: what d and s, and what B are divided by, so that halves hold them well.

    Returns:
        `4 (2 channels + 1)` planes: for every channel (d_1, d_2, d_3, B), for every channel (s_1, s_2, s_3, low flags),
        then (w_1, w_2, w_3, high flags and the mask as their highest bit).
    """
    roots, lobes = scale
    low = (level.flags & (1 << FLAG_BITS) - 1).float()
    high = (level.flags >> FLAG_BITS).float() + (1 << FLAG_BITS) * level.mask.float()
    high = high + (1 << MATERIAL_BIT) * level.material.float()
    channels = level.d.shape[1]

    def layer(k: int) -> Tensor:
        if k < channels:
            return torch.cat([level.d[:, k] / roots, level.B[None] / lobes])
        return torch.cat([level.s[:, k - channels] / roots, low[None]] if k < 2 * channels else [level.w, high[None]])

    planes = np.empty((4 * (2 * channels + 1), *level.mask.shape), np.float16)
    for k in range(2 * channels + 1):  # one layer at a time: at 24 megapixels all of them in 32 bits are 3 GB
        planes[4 * k : 4 * k + 4] = layer(k).clamp(-HALF_MAX, HALF_MAX).numpy()
    return planes


def as_drawn(level: Level, scale: tuple[float, float]) -> Level:
    """`level` as the page has it: rounded to half floats."""
    planes = torch.from_numpy(stored(level, scale).astype(np.float32)).reshape(-1, 4, *level.mask.shape)
    channels = level.d.shape[1]
    return Level(
        factor=level.factor,
        d=planes[:channels, :3].transpose(0, 1) * scale[0],
        s=planes[channels:-1, :3].transpose(0, 1) * scale[0],
        w=planes[-1, :3],
        B=planes[0, 3] * scale[1],
        flags=level.flags,
        mask=level.mask,
        material=level.material,
    )


def relit(separation: Separation, level: Level, alpha: Float[Tensor, "3"]) -> Float[Tensor, "channels height width"]:
    """The picture that a level gives under one light: Eqs. 20 and 21 with w = a + B m."""
    unit, intensity = separation.unit_mix(alpha[None].to(level.d))
    shared, whole = replace(separation, material=level.material).globals, level.d + level.s
    body = diffuse(mixed(unit, whole), length(shared.M, whole), shared)
    shine = lobe_of(level.w, shared, unit, replace(separation, material=level.material).ceiling)
    return (body + shine[:, None])[0] * intensity * level.mask


def root_scale(separation: Separation) -> tuple[float, float]:
    """What d and s, and what B are divided by in storage: a typical size of each on the object."""
    mask = separation.mask

    def typical(values: Tensor) -> float:
        size = values[..., mask].abs()
        size = float(size.mean()) if size.numel() else 0.0
        return size if math.isfinite(size) and size > 0 else 1.0

    return typical(separation.d + separation.s), typical(separation.B)


def tiles_of(width: int, height: int) -> list[tuple[int, int]]:
    """(column, row) of every tile, row by row."""
    return [(i, j) for j in range(math.ceil(height / TILE)) for i in range(math.ceil(width / TILE))]


def tile(planes: np.ndarray, at: tuple[int, int]) -> np.ndarray:
    """The part of `planes` (planes, height, width) that a tile holds, its apron included."""
    x, y = at[0] * TILE, at[1] * TILE
    return planes[:, y : y + TILE + APRON, x : x + TILE + APRON]


def packed(planes: np.ndarray) -> bytes:
    """Planes as zlib data: differences along rows, then all first bytes, all second bytes.

    The differences of neighbours' codes are small and the bytes of one rank are alike, which is what zlib needs.
    """
    codes = np.ascontiguousarray(planes).view(np.uint16 if planes.dtype.itemsize == 2 else np.uint8)
    steps = codes.copy()
    steps[..., 1:] = codes[..., 1:] - codes[..., :-1]  # unsigned: wraps round, and so does the way back
    raw = steps.reshape(-1).view(np.uint8).reshape(-1, codes.dtype.itemsize)
    return zlib.compress(np.ascontiguousarray(raw.T).tobytes(), 6)
