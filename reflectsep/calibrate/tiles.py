"""Tiles of a picture: the independent draws of a registration's evidence, and its halves."""

from __future__ import annotations

import torch
from torch import Tensor


def per_tile(values: Tensor, weight: Tensor, tiles: int) -> tuple[Tensor, Tensor]:
    """Weighted sums of a picture over every tile, and the tiles' weights."""
    tile = tile_index(weight, tiles).flatten()
    sums = torch.zeros(tiles * tiles, dtype=torch.float64)
    counts = sums.clone()
    sums.index_add_(0, tile, (values * weight).flatten())
    counts.index_add_(0, tile, weight.flatten())
    return sums, counts


def tile_index(like: Tensor, tiles: int) -> Tensor:
    """Index of every pixel's tile; tiles share out the box of the pixels that count."""
    height, width = like.shape
    rows = (like > 0).any(1).nonzero()[:, 0]
    columns = (like > 0).any(0).nonzero()[:, 0]
    if len(rows) == 0:
        return torch.zeros(height, width, dtype=torch.long)  # no pixel counts, in whatever tile
    top, bottom = int(rows[0]), int(rows[-1]) + 1
    left, right = int(columns[0]), int(columns[-1]) + 1
    y = ((torch.arange(height) - top).clamp(0, bottom - top - 1) * tiles) // (bottom - top)
    x = ((torch.arange(width) - left).clamp(0, right - left - 1) * tiles) // (right - left)
    return y[:, None] * tiles + x[None, :]


def chessboard(weight: Tensor, tiles: int) -> tuple[Tensor, Tensor]:
    """1 on the dark tiles, and 1 on the light ones: two halves of a picture."""
    index = tile_index(weight, tiles)
    dark = ((index // tiles + index % tiles) % 2).double()
    return dark, 1.0 - dark
