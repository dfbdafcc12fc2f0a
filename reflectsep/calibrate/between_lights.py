"""Motion between pictures under different lights, and the proof that it asks for.

What goes with the light and not with the camera (shading, shadows, highlights, outlines that are lit from one side)
looks like motion, over the whole object alike and by pixels. What stays on the surface is fine structure of the
logarithm: albedo is a summand there, whatever the light.

    f = whitened (G_fine - G_coarse) * log(I / bright + SMALL),      f_k(S x) = c f_1(x)

Whitened, every frequency has one vote, as in phase correlation: otherwise the contrast of shaded relief outvotes print.
S is found as the peak of the correlation, then by robust least squares, which sees a rotation besides. The object is cut
into tiles: they are the independent draws of the standard deviation, and each half of them, split like a chessboard,
must confirm what the other half found. A motion is undone only where `_doubt` has nothing to say.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from reflectsep.calibrate.align_options import AlignOptions
from reflectsep.calibrate.motion import Motion, displacement, inside, positions, sample, shifted
from reflectsep.calibrate.pyramid import MAD_TO_SIGMA, blurred, from_level
from reflectsep.calibrate.tiles import chessboard, per_tile, tile_index

MOST_PIXELS = 150_000
"""The object's box is halved until it has no more: a tenth of a pixel is still seen there."""
SMALL = 0.05
"""Of the picture's bright end: darker values are noise in the logarithm."""
DARK = 0.1
"""Of the bright end: what is darker over more than `STROKE_PX` to all sides is shadow or background, not print."""
STROKE_PX = 3
FINE_PX, COARSE_PX = 0.8, 2.0
RIM_PX = 5
"""Within so many pixels of the object's rim and of a shadow nothing counts: such edges go with the light."""
FEWEST_PIXELS = 256
TILES = 6
"""Along each side."""
ITERATIONS, FURTHER = 8, 3
"""Of least squares, from the peak of the correlation and from another fit."""
TUKEY = 4.685
NOISE_FLOOR = 0.05
"""Least residual, as a share of the structure's RMS, that is told from agreement."""
REACH, LEAST_REACH_PX = 0.02, 4
"""Of the picture's longer side, and pixels of the level: a camera that moved further was set up anew."""
TURN_DEG = 2.0
AGREE_PX = 0.25
"""Between the two estimates, and between the halves of the object; on still captures they are pixels apart
(table in README.md)."""
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
class Structure:
    """What of a picture is compared, in the object's box at the level."""

    values: Float[Tensor, "rows columns"]
    """Whitened fine structure of the logarithm, of RMS 1 where it counts."""
    weight: Float[Tensor, "rows columns"]
    """1 where it counts: away from the object's rim, from shadows and from whatever else is dark."""


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
    inner = (_halved(box.float(), factor) > 0.5).double()
    structure = _structure(picture, (top, left), inner, factor)
    return Anchor(mask=mask, corner=(top, left), inner=inner, factor=factor, structure=structure)


def between(anchor: Anchor, picture: Float[Tensor, "height width"], options: AlignOptions | None = None) -> Motion:
    """Motion of a picture under another light, applied only where it is proven.

    Args:
        anchor: what it is compared with.
        picture: grey linear picture of the same size.
        options: settings; of the models a translation and a rotation at most are looked for.
    """
    options = options or AlignOptions()
    moving = _structure(picture, anchor.corner, anchor.inner, anchor.factor)
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
        displacement_px=displacement(matrix, anchor.mask),
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
    if found.draws < DRAWS:
        return "what looks like one rests on too few places", ""
    if likeness < LIKE:
        return "the surface shows no texture", ""
    if math.hypot(*_peak(replace(pair, moving=_moved(pair, found.matrix)), reach)) > AGREE_PX:
        return "two estimates do not agree", ""
    halves = [
        _fitted(replace(pair, weight=pair.weight * half), found.matrix, FURTHER).matrix
        for half in chessboard(pair.weight, TILES)
    ]
    if math.dist(*(_moved_by(matrix, pair) for matrix in halves)) > AGREE_PX:
        return "parts of the object do not agree", ""
    before, after, beyond_sd = _on_unseen(pair, halves)
    if after - before < BETTER or beyond_sd < BETTER_SD:
        return "unseen parts do not agree better", ""
    return "", f"proven by fine structure: unseen parts correlate by {after:.2f}, unmoved by {before:.2f}"


def _structure(picture: Tensor, corner: tuple[int, int], inner: Tensor, factor: int) -> Structure:
    """Fine structure of a picture's logarithm inside the object, and where it is the surface's."""
    (top, left), (rows, columns) = corner, (length * factor for length in inner.shape)
    values = _halved(picture[top : top + rows, left : left + columns], factor).double().clamp_min(0)
    on_object = values[inner > 0]
    bright = on_object.kthvalue(max(1, round(0.9 * on_object.numel()))).values.clamp_min(1e-12)
    lit = inner * _shrunk((_grown(values, STROKE_PX) > DARK * bright).double(), STROKE_PX)
    logarithm = torch.log(values / bright + SMALL) * lit
    # Blurs count lit pixels alone, so that outlines and shadows leave no edge.
    fine, coarse = (blurred(torch.stack([logarithm, lit]), width) for width in (FINE_PX, COARSE_PX))
    structure = (fine[0] / fine[1].clamp_min(1e-3) - coarse[0] / coarse[1].clamp_min(1e-3)) * lit
    weight = torch.zeros_like(lit)
    weight[RIM_PX:-RIM_PX, RIM_PX:-RIM_PX] = _shrunk(lit, RIM_PX)[RIM_PX:-RIM_PX, RIM_PX:-RIM_PX]
    whitened = _whitened(structure * blurred(_shrunk(lit, STROKE_PX)[None], COARSE_PX)[0])
    rms = (whitened.square() * weight).sum() / weight.sum().clamp_min(1.0)
    return Structure(values=whitened / rms.sqrt().clamp_min(1e-300), weight=weight)


def _whitened(values: Tensor) -> Tensor:
    """All frequencies of a map at one amplitude, up to those that its grid carries well."""
    spectrum = torch.fft.rfft2(values, _fast(values.shape))
    size = spectrum.abs()
    y, x = torch.fft.fftfreq(size.shape[0]).double()[:, None], torch.fft.rfftfreq(2 * size.shape[1] - 2).double()
    low = torch.exp(-2 * (math.pi * FINE_PX) ** 2 * (x.square() + y.square()))
    white = spectrum * low / (size + 0.05 * size.mean() + 1e-300)
    return torch.fft.irfft2(white, _fast(values.shape))[: values.shape[0], : values.shape[1]]


def _fast(shape: torch.Size) -> list[int]:
    """Even lengths with small factors that leave a margin, for a transform that does not meet its other end."""
    return [64 * math.ceil((length + 4 * RIM_PX) / 64) for length in shape]


def _peak(pair: _Pair, reach: int) -> tuple[float, float]:
    """(x, y) at the highest correlation within `reach`, to a fraction of a pixel by a parabola."""
    window = blurred(pair.weight[None], RIM_PX / 2)[0]
    shape = _fast(window.shape)
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
    middle = ((width - 1) / 2, (height - 1) / 2)
    x = torch.arange(width, dtype=torch.float64) - middle[0]
    y = torch.arange(height, dtype=torch.float64)[:, None] - middle[1]
    rim, own, matrix = max(height, width) / 2, _slopes(pair.still), start
    for _ in range(iterations):
        moved = _moved(pair, matrix)
        gain, residual, counts = _left(pair, moved, matrix)
        gx, gy = 0.5 * (_slopes(moved) + gain * own)  # of both sides: converges in a handful of steps
        columns = torch.stack([gx, gy, *([(gy * x - gx * y) / rim] if turning else []), -pair.still]).flatten(1)
        system, error = columns * counts.flatten(), residual.flatten()
        normal = system @ columns.mT
        normal += 1e-9 * normal.diagonal().mean().clamp_min(1e-300) * torch.eye(len(normal), dtype=torch.float64)
        step = -torch.linalg.solve(normal, system @ error)
        step = (step / step[:-1].norm().clamp_min(1.0)).tolist()  # a linearisation holds for a pixel
        turn = math.degrees(step[2] / rim) if turning else 0.0
        matrix = matrix @ shifted(step[0], step[1], turn, middle)
        if max(map(abs, step[:-1])) < 0.005:
            break
    force = torch.zeros(TILES**2, len(normal), dtype=torch.float64)
    force.index_add_(0, tile_index(pair.weight, TILES).flatten(), (system * error).mT)
    inverse, kept = torch.linalg.inv(normal), len(normal) - 1
    covariance = torch.zeros(3, 3, dtype=torch.float64)
    covariance[:kept, :kept] = (inverse @ force.mT @ force @ inverse)[:kept, :kept]
    told, _ = per_tile(gx.square() + gy.square(), counts, TILES)
    return _Fit(
        matrix=matrix,
        covariance=covariance,
        turn_px=math.radians(_degrees(matrix)) * rim,
        draws=float(told.sum().square() / told.square().sum().clamp_min(1e-300)),
    )


def _moved(pair: _Pair, matrix: Tensor) -> Tensor:
    return sample(pair.moving[None], positions(matrix, *pair.still.shape))[0]


def _left(pair: _Pair, moved: Tensor, matrix: Tensor) -> tuple[float, Tensor, Tensor]:
    """Gain of the moved structure, the residual, and robust weights."""
    valid = pair.weight * inside(positions(matrix, *moved.shape))
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


def _halved(values: Tensor, factor: int) -> Tensor:
    return avg_pool2d(values[None], factor)[0] if factor > 1 else values


def _grown(values: Tensor, pixels: int) -> Tensor:
    """The largest value within so many pixels along both axes."""
    return max_pool2d(values[None], 2 * pixels + 1, stride=1, padding=pixels)[0]


def _shrunk(values: Tensor, pixels: int) -> Tensor:
    """The least value within so many pixels along both axes."""
    return -_grown(-values, pixels)
