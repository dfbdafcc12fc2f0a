"""Motion between pictures under different lights, and the proof that it asks for.

What goes with the light and not with the camera (shading, shadows, highlights, outlines that are lit from one side)
looks like motion, over the whole object alike and by pixels. Proof is sought in what stays on the surface alone:

    f_k(S x) = c f_1(x),      f the fine structure of the logarithm (`structure`), S a shift or a rigid motion

S is found as the peak of the correlation, then by robust least squares, which sees a rotation besides. The object is
cut into tiles: they are the independent draws of the standard deviation, and each half of them, split like a
chessboard, must confirm what the other half found. A motion is undone only where `_doubt` has nothing to say.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.calibrate.align_options import AlignOptions
from reflectsep.calibrate.motion import Motion, displacement, inside, positions, sample, shifted
from reflectsep.calibrate.pyramid import MAD_TO_SIGMA, blurred, from_level
from reflectsep.calibrate.structure import RIM_PX, Structure, halved, padded, structure_of
from reflectsep.calibrate.tiles import chessboard, per_tile, tile_index

MOST_PIXELS = 150_000
"""The object's box is halved until it has no more: a tenth of a pixel is still seen there."""
FEWEST_PIXELS = 256
TILES = 6
"""Along each side."""
ITERATIONS, FURTHER = 8, 3
"""Of least squares, from the peak of the correlation and from another fit."""
SETTLED_PX = 0.005
"""A step this small is the last."""
TUKEY = 4.685
NOISE_FLOOR = 0.05
"""Least residual, as a share of the structure's RMS, that is told from agreement."""
REACH, LEAST_REACH_PX = 0.02, 4
"""Of the picture's longer side, and pixels of the level: a camera that moved further was set up anew."""
TURN_DEG = 2.0
AGREE_PX, SIDES_PX = 0.25, 0.8
"""Between the two estimates and between the halves of the tiles; between left and right and top and bottom, which a
turn too small to be told from none pulls apart. On still smooth objects they are pixels apart."""
LIKE = 0.35
"""Correlation of the structures once they are in one place: below it most of them is not the surface's."""
BETTER, BETTER_SD = 0.1, 3.0
"""Gain in correlation of unseen tiles, and in standard errors with one vote a tile."""
DRAWS = 4.0
"""Independent tiles, at least: one shadow's edge in two of them is no proof."""
BEYOND_SD = 5.0
SURE_PX = 0.11
"""Largest standard deviation of a proven motion, of the level's pixels: where tiles pull apart, shading has a part."""
FLOOR_PX = 0.05
TURN_FLOOR_PX = 0.1
"""Systematic errors of a motion between lights, of the level's pixels: of the shift, and of a rotation at the rim."""


@dataclass(frozen=True, kw_only=True)
class Anchor:
    """The picture that others are compared with, prepared once."""

    mask: Bool[Tensor, "height width"]
    """The object, in the whole picture."""
    corner: tuple[int, int]
    """(row, column) of the object's box."""
    inner: Float[Tensor, "rows columns"]
    """1 on the object, in its box at the level."""
    factor: int
    structure: Structure


@dataclass(frozen=True, kw_only=True)
class _Pair:
    """The structure of two pictures and where both count."""

    still: Tensor
    moving: Tensor
    weight: Tensor


@dataclass(frozen=True, kw_only=True)
class _Fit:
    """A motion by least squares."""

    matrix: Tensor
    covariance: Tensor
    """Of the shift along x and y and of the rotation's displacement at the rim, pixels of the level."""
    turn_px: float
    """Rotation, as displacement at the rim."""
    draws: float
    """Number of tiles that would tell as much if all told alike."""

    @property
    def sd_px(self) -> float:
        """RMS standard deviation of the displacement, pixels of the level; a rotation's is that at half the rim."""
        x, y, turn = self.covariance.diagonal().tolist()
        return math.sqrt(x + y + 0.25 * turn + 2 * FLOOR_PX**2)


@dataclass(frozen=True, kw_only=True)
class _System:
    """Normal equations of shift, rotation and gain."""

    normal: Tensor
    force: Tensor
    """Gradient, of every tile (tiles, unknowns)."""
    told: Tensor
    """Squared slopes that count, of every tile."""


def anchored(picture: Float[Tensor, "height width"], mask: Bool[Tensor, "height width"]) -> Anchor:
    """Prepare the picture that others are compared with.

    Args:
        picture: grey linear picture; clipped values may be in it.
        mask: the object in it.
    """
    rows, columns = mask.any(1).nonzero()[:, 0], mask.any(0).nonzero()[:, 0]
    top, left = int(rows[0]), int(columns[0])
    box = mask[top : int(rows[-1]) + 1, left : int(columns[-1]) + 1]
    factor = 1
    while box.numel() > MOST_PIXELS * factor**2 and 2 * factor <= min(box.shape):
        factor *= 2
    inner = (halved(box.float(), factor) > 0.5).double()
    structure = structure_of(picture, (top, left), inner, factor)
    return Anchor(mask=mask, corner=(top, left), inner=inner, factor=factor, structure=structure)


def between(anchor: Anchor, picture: Float[Tensor, "height width"], options: AlignOptions | None = None) -> Motion:
    """Motion of a picture under another light, applied only where it is proven.

    Args:
        anchor: what it is compared with.
        picture: grey linear picture of the same size.
        options: settings; of the models a translation and a rotation at most are looked for.
    """
    options = options or AlignOptions()
    moving = structure_of(picture, anchor.corner, anchor.inner, anchor.factor)
    weight = anchor.structure.weight * moving.weight
    if int(weight.sum()) < FEWEST_PIXELS:
        return Motion(reason="no motion proven: too little of the object is lit in both pictures")
    pair = _Pair(still=anchor.structure.values, moving=moving.values, weight=weight)
    reach = max(LEAST_REACH_PX, math.ceil(REACH * max(picture.shape) / anchor.factor))
    best, model = _fitted(pair, shifted(*_peak(pair, reach)), ITERATIONS), "translation"
    if "rigid" in options.models:
        turned = _fitted(pair, best.matrix, ITERATIONS, turning=True)
        if abs(turned.turn_px) > BEYOND_SD * math.hypot(float(turned.covariance[2, 2]) ** 0.5, TURN_FLOOR_PX):
            best, model = turned, "rigid"
    likeness = _correlation(pair.still, _moved(pair, best.matrix), pair.weight)
    doubt, said = _doubt(pair, best, likeness, reach)
    if doubt:
        return Motion(reason=f"no motion proven: {doubt}", sd_px=best.sd_px * anchor.factor)
    top, left = anchor.corner
    matrix = shifted(left, top) @ from_level(best.matrix, anchor.factor) @ shifted(-left, -top)
    return Motion(
        matrix=matrix,
        model=model,
        displacement_px=anchor.factor
        * displacement(best.matrix, anchor.inner > 0),  # the whole picture's grid is large
        sd_px=best.sd_px * anchor.factor,
        trust=likeness,
        applied=True,
        reason=said,
    )


def _doubt(pair: _Pair, found: _Fit, likeness: float, reach: int) -> tuple[str, str]:
    """What speaks against a motion, empty where nothing does; and then what speaks for it."""
    far = _moved_by(found.matrix, pair)
    if displacement(found.matrix, pair.weight > 0) <= BEYOND_SD * found.sd_px:
        return "nothing beyond its error", ""
    if math.hypot(*far) > reach or abs(_degrees(found.matrix)) > TURN_DEG:
        return "what looks like one is implausibly far", ""
    if found.sd_px > SURE_PX:
        return "places pull apart", ""
    parts = [chessboard(pair.weight, TILES), *_sides(pair.weight)]
    fewest = min(float((pair.weight * half).sum()) for halves in parts for half in halves)
    if found.draws < DRAWS or fewest < FEWEST_PIXELS / 8:
        return "what looks like one rests on too few places", ""
    if likeness < LIKE:
        return "the surface shows no texture", ""
    if math.hypot(*_peak(replace(pair, moving=_moved(pair, found.matrix)), reach)) > AGREE_PX:
        return "two estimates do not agree", ""
    halves = _halves(pair, found, parts[0])
    if math.dist(*(_moved_by(matrix, pair) for matrix in halves)) > AGREE_PX:
        return "parts of the object do not agree", ""
    for sides in parts[1:]:
        if math.dist(*(_moved_by(matrix, pair) for matrix in _halves(pair, found, sides))) > SIDES_PX:
            return "sides of the object do not agree", ""
    before, after, beyond_sd = _on_unseen(pair, halves)
    if after - before < BETTER or beyond_sd < BETTER_SD:
        return "unseen parts do not agree better", ""
    return "", f"proven by fine structure: unseen parts correlate by {after:.2f}, unmoved by {before:.2f}"


def _halves(pair: _Pair, found: _Fit, halves: tuple[Tensor, Tensor]) -> list[Tensor]:
    """Motions of two halves of the object, each for itself."""
    return [_fitted(replace(pair, weight=pair.weight * half), found.matrix, FURTHER).matrix for half in halves]


def _sides(weight: Tensor) -> list[tuple[Tensor, Tensor]]:
    """1 on the left and on the right of the object's middle; on its top and on its bottom."""
    y, x = ((weight > 0).nonzero(as_tuple=True)[axis].double().median() for axis in (0, 1))
    height, width = weight.shape
    left = (torch.arange(width) < x).double().expand(height, width)
    top = (torch.arange(height)[:, None] < y).double().expand(height, width)
    return [(left, 1.0 - left), (top, 1.0 - top)]


def _peak(pair: _Pair, reach: int) -> tuple[float, float]:
    """(x, y) at the highest correlation within `reach`, to a fraction of a pixel by a parabola."""
    window = blurred(pair.weight[None], RIM_PX / 2)[0]
    shape = padded(window.shape)
    still, moving = (torch.fft.rfft2(each * window, shape) for each in (pair.still, pair.moving))
    surface = torch.fft.irfft2(still.conj() * moving, shape)
    reach = min(reach, min(shape) // 2 - 2)
    near = surface.roll((reach + 1, reach + 1), (0, 1))[: 2 * reach + 3, : 2 * reach + 3]
    row, column = divmod(int(near[1:-1, 1:-1].argmax()), 2 * reach + 1)
    top = near[row : row + 3, column : column + 3]
    return column - reach + _vertex(top[1]), row - reach + _vertex(top[:, 1])


def _vertex(three: Tensor) -> float:
    """Where a parabola through values at -1, 0 and 1 has its top; 0 where it has none."""
    before, at, after = three.tolist()
    bend = before - 2 * at + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0


def _fitted(pair: _Pair, start: Tensor, iterations: int, *, turning: bool = False) -> _Fit:
    """Gauss-Newton on shift, rotation where `turning`, and gain, with Tukey's weights."""
    height, width = pair.still.shape
    middle, rim, matrix = ((width - 1) / 2, (height - 1) / 2), max(height, width) / 2, start
    slopes = _slopes(pair.still)
    system = _linearised(pair, slopes, matrix, turning)
    for _ in range(iterations):
        step = -torch.linalg.solve(system.normal, system.force.sum(0))
        step = (step / step[:-1].norm().clamp_min(1.0)).tolist()  # a linearisation holds for a pixel
        turn = math.degrees(step[2] / rim) if turning else 0.0
        matrix = matrix @ shifted(step[0], step[1], turn, middle)
        if max(map(abs, step[:-1])) < SETTLED_PX:
            break
        system = _linearised(pair, slopes, matrix, turning)
    inverse, kept = torch.linalg.inv(system.normal), len(system.normal) - 1
    covariance = torch.zeros(3, 3, dtype=torch.float64)
    covariance[:kept, :kept] = (inverse @ system.force.mT @ system.force @ inverse)[:kept, :kept]
    return _Fit(
        matrix=matrix,
        covariance=covariance,
        turn_px=math.radians(_degrees(matrix)) * rim,
        draws=float(system.told.sum().square() / system.told.square().sum().clamp_min(1e-300)),
    )


def _linearised(pair: _Pair, slopes: Tensor, matrix: Tensor, turning: bool) -> _System:
    height, width = pair.still.shape
    x = torch.arange(width, dtype=torch.float64) - (width - 1) / 2
    y = torch.arange(height, dtype=torch.float64)[:, None] - (height - 1) / 2
    moved = _moved(pair, matrix)
    gain, residual, counts = _left(pair, moved, matrix)
    gx, gy = 0.5 * (_slopes(moved) + gain * slopes)  # of both sides: converges in a handful of steps
    turned = [(gy * x - gx * y) / (max(height, width) / 2)] if turning else []
    columns = torch.stack([gx, gy, *turned, -pair.still]).flatten(1)
    weighed = columns * counts.flatten()
    normal = weighed @ columns.mT
    normal += 1e-9 * normal.diagonal().mean().clamp_min(1e-300) * torch.eye(len(normal), dtype=torch.float64)
    force = torch.zeros(TILES**2, len(normal), dtype=torch.float64)
    force.index_add_(0, tile_index(pair.weight, TILES).flatten(), (weighed * residual.flatten()).mT)
    told, _ = per_tile(gx.square() + gy.square(), counts, TILES)
    return _System(normal=normal, force=force, told=told)


def _moved(pair: _Pair, matrix: Tensor) -> Tensor:
    return sample(pair.moving[None], positions(matrix, pair.still.shape[0], pair.still.shape[1]))[0]


def _left(pair: _Pair, moved: Tensor, matrix: Tensor) -> tuple[float, Tensor, Tensor]:
    """Gain of the moved structure, the residual, and robust weights."""
    valid = pair.weight * inside(positions(matrix, moved.shape[0], moved.shape[1]))
    gain = float((moved * pair.still * valid).sum() / (pair.still.square() * valid).sum().clamp_min(1e-300))
    gain = max(0.1, gain)
    residual = moved - gain * pair.still
    seen = residual[valid > 0]
    sigma = max(NOISE_FLOOR, MAD_TO_SIGMA * float(seen.abs().median()) if seen.numel() else 0.0)
    return gain, residual, valid * (1.0 - (residual / (TUKEY * sigma)).square()).clamp_min(0).square()


def _on_unseen(pair: _Pair, halves: list[Tensor]) -> tuple[float, float, float]:
    """Correlation of tiles as they lie, and at a motion found without them; and the gain in standard errors."""
    dark, light = chessboard(pair.weight, TILES)
    unseen = dark * _moved(pair, halves[1]) + light * _moved(pair, halves[0])
    before, after = _tile_correlations(pair, pair.moving), _tile_correlations(pair, unseen)
    better = (after - before)[per_tile(pair.weight, pair.weight, TILES)[0] > 0]
    error = float(better.std()) * len(better) ** 0.5
    whole = [_correlation(pair.still, each, pair.weight) for each in (pair.moving, unseen)]
    return whole[0], whole[1], float(better.sum()) / max(error, 1e-300)


def _tile_correlations(pair: _Pair, moved: Tensor) -> Tensor:
    products = (pair.still * moved, pair.still.square(), moved.square())
    both, one, other = (per_tile(product, pair.weight, TILES)[0] for product in products)
    return both / (one * other).sqrt().clamp_min(1e-300)


def _correlation(a: Tensor, b: Tensor, weight: Tensor) -> float:
    scale = ((a.square() * weight).sum() * (b.square() * weight).sum()).sqrt()
    return float((a * b * weight).sum() / scale.clamp_min(1e-300))


def _slopes(values: Tensor) -> Tensor:
    """Slopes (2, height, width) along x and y."""
    y, x = torch.gradient(values)
    return torch.stack([x, y])


def _moved_by(matrix: Tensor, pair: _Pair) -> tuple[float, float]:
    """(x, y) by which the middle of the box is moved."""
    height, width = pair.weight.shape
    middle = torch.tensor([(width - 1) / 2, (height - 1) / 2, 1.0], dtype=torch.float64)
    x, y, _ = (matrix @ middle - middle).tolist()
    return x, y


def _degrees(matrix: Tensor) -> float:
    return Motion(matrix=matrix).rotation_deg
