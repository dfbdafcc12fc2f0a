"""Pixels that stand for all: squares strewn over the object, put side by side as a picture of their own."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Int
from torch import Tensor

SQUARE_PX = 24
"""Side of a square; the widest neighbourhood reaches 7 pixels."""
GAP_PX = 8
SAMPLE = 5000
"""Pixels that the globals are fitted to: those of more are known no better."""


@dataclass(frozen=True)
class Sample:
    """Some of the fitted pixels, whole squares of them."""

    index: Int[Tensor, "some"]
    """Places among the fitted pixels, in the order of `mask`."""
    mask: Bool[Tensor, "height width"]
    """The squares side by side, too far apart to be neighbours of each other."""


def strewn_squares(shape: tuple[int, int], share: float) -> Bool[Tensor, "height width"]:
    """Squares of `SQUARE_PX` that cover about `share` of a picture evenly.

    Which: those where a plane of two irrational slopes, modulo 1, is below `share` (additive recurrence; Roberts 2018),
    so that neither rows nor columns are preferred.
    """
    rows, columns = (torch.arange(length) // SQUARE_PX for length in shape)
    return (0.7548776662 * rows[:, None].double() + 0.5698402910 * columns.double()) % 1.0 < share


def sample(mask: Bool[Tensor, "height width"], count: int) -> Sample:
    """About `count` pixels of the mask in squares; all of them where there are no more."""
    pixels = int(mask.sum())
    if pixels <= 1.5 * count:
        return Sample(torch.arange(pixels), mask)
    height, width = mask.shape
    number = torch.full(mask.shape, -1, dtype=torch.long)
    number[mask] = torch.arange(pixels)
    chosen = strewn_squares((height, width), count / pixels)
    corners = chosen[::SQUARE_PX, ::SQUARE_PX].nonzero() * SQUARE_PX
    squares = []
    for row, column in corners.tolist():
        square = number[row : row + SQUARE_PX, column : column + SQUARE_PX]
        if bool((square >= 0).any()):
            full = torch.full((SQUARE_PX + GAP_PX, SQUARE_PX + GAP_PX), -1, dtype=torch.long)
            full[: square.shape[0], : square.shape[1]] = square
            squares.append(full)
    if not squares:
        step = -(-pixels // count)
        index = torch.arange(0, pixels, step)
        alone = torch.zeros(1, len(index) * GAP_PX, dtype=torch.bool)
        alone[0, ::GAP_PX] = True
        return Sample(index, alone)
    across = max(1, int(len(squares) ** 0.5))
    while len(squares) % across:
        squares.append(torch.full_like(squares[0], -1))
    canvas = torch.cat([torch.cat(squares[i : i + across], 1) for i in range(0, len(squares), across)])
    return Sample(canvas[canvas >= 0], canvas >= 0)
