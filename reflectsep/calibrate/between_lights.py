"""Motion between pictures under different lights, and the proof that it asks for.

What moves with the light and not with the camera (shading, shadows, highlights) looks like motion, coherently and by
pixels. What stays on the surface is fine structure of the logarithm: albedo is a summand there, whatever the light.

    f = (G_fine - G_coarse) * log(I / bright + SMALL),      f_k(S x) = c f_1(x)

Two estimates of S: phase correlation over the whole object, where every frequency has one vote, and robust least squares
on the same map, which weighs by contrast and alone sees a rotation. Pseudo-motion differs between the two, and between
one part of the object and the next. So the object is cut into tiles; they are the independent draws of the standard
deviation, and each half of them, split like a chessboard, is to confirm what was found on the other.

A motion is undone only where all of `_doubt` is answered. Where there is doubt nothing moves.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from reflectsep.calibrate.align_options import LEAST_PX, AlignOptions
from reflectsep.calibrate.motion import Motion, displacement, inside, positions, sample, shifted
from reflectsep.calibrate.pyramid import MAD_TO_SIGMA, blurred, from_level
from reflectsep.calibrate.tiles import chessboard, per_tile, tile_index

MOST_PIXELS = 150_000
"""The object's box is halved until it has no more: a tenth of a pixel is still seen there."""
SMALL = 0.05
"""Of the picture's bright end: darker values are noise in the logarithm."""
FINE_PX, COARSE_PX = 0.8, 2.0
RIM_PX = 5
"""Of the object's rim that does not count: a picture that lies elsewhere has background there."""
DARK = 0.1
"""Of the bright end: what is darker over more than `STROKE_PX` to all sides is shadow or background."""
STROKE_PX = 3
FEWEST_PIXELS = 256
TILES = 6
"""Along each side."""
ITERATIONS = 8
TUKEY = 4.685
NOISE_FLOOR = 0.01
"""Least residual of the logarithm."""
REACH = 0.02
"""Of the picture's longer side, and 4 pixels at least: a camera that moved further was set up anew."""
TURN_DEG = 2.0
AGREE_PX = 0.3
"""Between the two estimates, and between the halves of the object."""
LIKE = 0.35
"""Correlation of the fine structure once it is in its place: below it most of it is not the surface's."""
BETTER = 0.1
"""Of the misfit of unseen tiles that a motion must take away."""
UNSEEN_SD = 4.0
"""Standard errors, by tiles, of that gain."""
DRAWS = 4.0
"""Independent tiles, at least: one shadow's edge in two of them is no proof."""
BEYOND_SD = 5.0
FLOOR_PX = 0.05
TURN_FLOOR_PX = 0.1
"""Systematic errors of a motion between lights, of the level's pixels: of the shift, and of a rotation at the rim."""


@dataclass(frozen=True, kw_only=True)
class Anchor:
    """The picture that others are compared with, prepared once."""

    mask: Bool[Tensor, "height width"]
    """The object, in the whole picture."""
    corner: tuple[int, int]
    """(row, column) of the box that is compared."""
    inner: Bool[Tensor, "rows columns"]
    """The object in that box, at its level."""
    factor: int
    still: _Structure


@dataclass(frozen=True, kw_only=True)
class _Structure:
    """What of a picture is compared."""

    values: Float[Tensor, "rows columns"]
    """Fine structure of the logarithm."""
    weight: Float[Tensor, "rows columns"]
    """1 where it counts: away from the object's rim, from shadows and from whatever else is dark."""


@dataclass(frozen=True, kw_only=True)
class _Pair:
    """Two pictures' structure and where both count."""

    still: Tensor
    moving: Tensor
    weight: Tensor


@dataclass(frozen=True, kw_only=True)
class _Fit:
    """Least squares of one motion."""

    matrix: Tensor
    covariance: Tensor
    """Of shift along x and y, and of the rotation's displacement at the rim."""
    turn: float
    """Rotation, pixels at the rim."""
    sigma: float
    likeness: float
    draws: float


def anchored(picture: Float[Tensor, "height width"], mask: Bool[Tensor, "height width"]) -> Anchor:
    """Prepare the picture that others are compared with.

    Args:
        picture: grey linear picture; clipped values may be in it.
        mask: the object in it.
    """
    rows, columns = mask.any(1).nonzero()[:, 0], mask.any(0).nonzero()[:, 0]
    if rows.numel() == 0:
        rows, columns = torch.arange(mask.shape[0]), torch.arange(mask.shape[1])
    top, left = int(rows[0]), int(columns[0])
    box = mask[top : int(rows[-1]) + 1, left : int(columns[-1]) + 1]
    factor = 1
    while box.numel() > MOST_PIXELS * factor**2:
        factor *= 2
    inner = _halved(box.double(), factor) > 0.5
    return Anchor(
        mask=mask, corner=(top, left), inner=inner, factor=factor, still=_structure(picture, (top, left), inner, factor)
    )


def between(anchor: Anchor, picture: Float[Tensor, "height width"], options: AlignOptions | None = None) -> Motion:
    """Motion of a picture under another light, applied only where it is proven.

    Args:
        anchor: what it is compared with.
        picture: grey linear picture of the same size.
        options: settings; of the models a translation and a rotation at most are looked for.
    """
    options = options or AlignOptions()
    moving = _structure(picture, anchor.corner, anchor.inner, anchor.factor)
    pair = _Pair(still=anchor.still.values, moving=moving.values, weight=anchor.still.weight * moving.weight)
    if int((pair.weight > 0).sum()) < FEWEST_PIXELS:
        return Motion(reason="no motion proven: too little of the object is lit in both pictures")
    reach = max(4, math.ceil(REACH * max(picture.shape) / anchor.factor))
    shift = _phase_shift(pair, min(reach, min(pair.still.shape) // 4))
    best, model = _fitted(pair, shifted(*shift), turning=False), "translation"
    if "rigid" in options.models:
        turned = _fitted(pair, best.matrix, turning=True)
        if abs(turned.turn) > BEYOND_SD * math.sqrt(float(turned.covariance[2, 2]) + TURN_FLOOR_PX**2):
            best, model = turned, "rigid"
    doubt, gained = _doubt(pair, best, reach)
    if os.environ.get("DBG"): print(shift, _moved_by(best.matrix,pair), best.likeness, best.draws, gained, _sd(best), doubt)
    matrix = _in_picture(best.matrix, anchor)
    motion = Motion(
        matrix=matrix,
        model=model,
        displacement_px=displacement(matrix, anchor.mask),
        sd_px=_sd(best) * anchor.factor,
        trust=max(0.0, best.likeness),
    )
    if not doubt and motion.displacement_px < LEAST_PX:
        doubt = f"below {LEAST_PX:g} px"
    if doubt:
        return Motion(reason=f"no motion proven: {doubt}", sd_px=motion.sd_px)
    return replace(motion, applied=True, reason=f"proven by fine structure: unseen parts agree {gained:.0%} better")


def _doubt(pair: _Pair, found: _Fit, reach: int) -> tuple[str, float]:
    """What speaks against a motion, empty where nothing does; and by how much unseen tiles agree better."""
    sd = _sd(found)
    moved, _, _, _ = _residual(pair, found.matrix)
    left = _phase_shift(replace(pair, moving=moved), reach)
    halves = [
        _fitted(replace(pair, weight=pair.weight * half), found.matrix, turning=False)
        for half in chessboard(pair.weight, TILES)
    ]
    before, after, significance = _on_unseen(pair, halves); gained=after-before
    apart = math.dist(*(_moved_by(half.matrix, pair) for half in halves))
    tests = (
        (displacement(found.matrix, pair.weight > 0) > BEYOND_SD * sd, "nothing beyond its error"),
        (
            math.hypot(*_moved_by(found.matrix, pair)) <= reach and abs(_degrees(found.matrix)) <= TURN_DEG,
            "what looks like one is implausibly far",
        ),
        (math.hypot(*left) <= AGREE_PX, "two estimates do not agree"),
        (apart <= AGREE_PX, "parts of the object do not agree"),
        (found.draws >= DRAWS, "what looks like one rests on too few places"),
        (found.likeness >= LIKE, "the surface shows no texture"),
        (gained >= BETTER and significance >= UNSEEN_SD, "unseen parts do not agree better"),
    )
    if os.environ.get("DBG"): print('[%s]'%','.join(str(i) for i,(p,_) in enumerate(tests) if not p), '%.2f>%.2f %.1f sd left %.2f apart %.2f draws %.1f like %.2f'%(before,after,significance,math.hypot(*left),apart,found.draws,found.likeness),end=' ')
    return next((said for passed, said in tests if not passed), ""), gained


def _structure(picture: Tensor, corner: tuple[int, int], inner: Tensor, factor: int) -> _Structure:
    """Fine structure of a picture's logarithm inside the object, and where it is the surface's."""
    (top, left), (rows, columns) = corner, (length * factor for length in inner.shape)
    values = _halved(picture[top : top + rows, left : left + columns].double(), factor).clamp_min(0)
    on_object = values[inner]
    if on_object.numel() == 0:
        return _Structure(values=torch.zeros_like(values), weight=torch.zeros_like(values))
    bright = on_object.kthvalue(max(1, round(0.9 * on_object.numel()))).values.clamp_min(1e-12)
    # Shadow and background are dark over more than a stroke of print is wide; their edges go with the light.
    lit = _grown((_grown(values, STROKE_PX) > DARK * bright).double() - 1.0, STROKE_PX, least=True) + 1.0
    lit = lit * inner
    logarithm = torch.log(values / bright + SMALL) * lit
    fine, coarse = (blurred(torch.stack([logarithm, lit]), width) for width in (FINE_PX, COARSE_PX))
    structure = (fine[0] / fine[1].clamp_min(1e-3) - coarse[0] / coarse[1].clamp_min(1e-3)) * lit
    weight = torch.zeros_like(lit)
    weight[RIM_PX:-RIM_PX, RIM_PX:-RIM_PX] = _grown(lit, RIM_PX, least=True)[RIM_PX:-RIM_PX, RIM_PX:-RIM_PX]
    return _Structure(values=structure, weight=weight)


def _grown(values: Tensor, pixels: int, *, least: bool = False) -> Tensor:
    """The largest (or least) value within so many pixels along both axes."""
    sign = -1.0 if least else 1.0
    return sign * max_pool2d(sign * values[None], 2 * pixels + 1, stride=1, padding=pixels)[0]


def _halved(values: Tensor, factor: int) -> Tensor:
    return avg_pool2d(values[None], factor)[0] if factor > 1 else values


def _in_picture(matrix: Tensor, anchor: Anchor) -> Tensor:
    """A motion of the compared box in the coordinates of the whole picture."""
    top, left = anchor.corner
    return shifted(left, top) @ from_level(matrix, anchor.factor) @ shifted(-left, -top)


def _phase_shift(pair: _Pair, reach: int) -> tuple[float, float]:
    """(x, y) at the peak of the phase correlation, to a fraction of a pixel by a parabola."""
    window = blurred(pair.weight[None], RIM_PX / 2)[0]
    shape = [2 ** math.ceil(math.log2(length + 2 * reach)) for length in window.shape]
    cross = torch.fft.rfft2(pair.still * window, shape).conj() * torch.fft.rfft2(pair.moving * window, shape)
    size = cross.abs()
    y, x = torch.fft.fftfreq(shape[0]).double()[:, None], torch.fft.rfftfreq(shape[1]).double()
    low = torch.exp(-2 * math.pi**2 * (x.square() + y.square()))
    surface = torch.fft.irfft2(low * cross / (size + 0.05 * size.mean() + 1e-300), shape)
    near = surface.roll((reach + 1, reach + 1), (0, 1))[: 2 * reach + 3, : 2 * reach + 3]
    row, column = divmod(int(near[1:-1, 1:-1].argmax()), 2 * reach + 1)
    top = near[row : row + 3, column : column + 3]
    return column - reach + _vertex(top[1]), row - reach + _vertex(top[:, 1])


def _vertex(three: Tensor) -> float:
    """Where a parabola through values at -1, 0 and 1 has its top."""
    before, at, after = three.tolist()
    bend = before - 2 * at + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0


def _fitted(pair: _Pair, start: Tensor, *, turning: bool) -> _Fit:
    """Gauss-Newton on shift, rotation where `turning`, and gain, with Tukey's weights."""
    still, weight, matrix = pair.still, pair.weight, start
    height, width = still.shape
    x = torch.arange(width, dtype=torch.float64) - (width - 1) / 2
    y = torch.arange(height, dtype=torch.float64)[:, None] - (height - 1) / 2
    rim = max(height, width) / 2
    slopes = _slopes(still)
    for _ in range(ITERATIONS):
        moved, gain, residual, counts = _residual(pair, matrix)
        gx, gy = 0.5 * (_slopes(moved) + gain * slopes)
        columns = torch.stack([gx, gy, *([(gy * x - gx * y) / rim] if turning else []), -still]).flatten(1)
        system = columns * counts.flatten()
        normal = system @ columns.mT
        normal += 1e-9 * normal.diagonal().mean().clamp_min(1e-300) * torch.eye(len(normal), dtype=torch.float64)
        step = -torch.linalg.solve(normal, system @ residual.flatten())
        shift = step[:2] / step[:2].norm().clamp_min(1.0)  # a linearisation holds for a pixel
        angle = math.degrees(float(step[2]) / rim) if turning else 0.0
        matrix = matrix @ shifted(*shift.tolist(), angle, ((width - 1) / 2, (height - 1) / 2))
        if float(shift.norm()) < 0.005 and abs(float(step[2]) if turning else 0.0) < 0.005:
            break
    # The tiles of the picture are the independent draws.
    tile = tile_index(weight, TILES).flatten()
    force = torch.zeros(TILES**2, len(normal), dtype=torch.float64).index_add_(0, tile, (system * residual.flatten()).mT)
    inverse = torch.linalg.inv(normal)
    covariance = torch.zeros(3, 3, dtype=torch.float64)
    kept = 3 if turning else 2
    covariance[:kept, :kept] = (inverse @ force.mT @ force @ inverse)[:kept, :kept]
    told, _ = per_tile((gx.square() + gy.square()) * counts, torch.ones_like(counts), TILES)
    moved, _, residual, _ = _residual(pair, matrix)
    return _Fit(
        matrix=matrix,
        covariance=covariance,
        turn=math.radians(_degrees(matrix)) * rim,
        sigma=_scale(residual, weight),
        likeness=_correlation(still, moved, weight),
        draws=float(told.sum().square() / told.square().sum().clamp_min(1e-300)),
    )


def _residual(pair: _Pair, matrix: Tensor) -> tuple[Tensor, float, Tensor, Tensor]:
    """The moved structure, its gain, what it leaves over, and robust weights."""
    still = pair.still
    places = positions(matrix, *still.shape)
    moved = sample(pair.moving[None], places)[0]
    valid = pair.weight * inside(places)
    gain = max(0.1, float((moved * still * valid).sum() / (still.square() * valid).sum().clamp_min(1e-300)))
    residual = moved - gain * still
    sigma = _scale(residual, valid)
    return moved, gain, residual, valid * (1.0 - (residual / (TUKEY * sigma)).square()).clamp_min(0).square()


def _on_unseen(pair: _Pair, halves: list[_Fit]) -> tuple[float, float, float]:
    """Correlation of tiles as they lie, and at a motion found without them; and the gain in standard errors."""
    still = torch.eye(3, dtype=torch.float64)
    correlations, before, after = [], 0.0, 0.0
    for matrices in ((still, still), (halves[1].matrix, halves[0].matrix)):
        moved = torch.zeros_like(pair.weight)
        for half, matrix in zip(chessboard(pair.weight, TILES), matrices, strict=True):
            moved += half * sample(pair.moving[None], positions(matrix, *moved.shape))[0]
        before, after = after, _correlation(pair.still, moved, pair.weight)
        a, b, c = (
            per_tile(x, pair.weight, TILES)[0] for x in (pair.still * moved, pair.still.square(), moved.square())
        )
        correlations.append(a / (b * c).sqrt().clamp_min(1e-300))
    seen = per_tile(pair.weight, pair.weight, TILES)[0] > 0
    better = (correlations[1] - correlations[0])[seen]
    spread = float(better.std()) * len(better) ** 0.5
    return before, after, float(better.sum()) / max(spread, 1e-300)


def _scale(residual: Tensor, weight: Tensor) -> float:
    counts = residual[weight > 0]
    return max(NOISE_FLOOR, MAD_TO_SIGMA * float(counts.abs().median())) if counts.numel() else NOISE_FLOOR


def _correlation(a: Tensor, b: Tensor, weight: Tensor) -> float:
    scale = ((a.square() * weight).sum() * (b.square() * weight).sum()).sqrt()
    return float((a * b * weight).sum() / scale.clamp_min(1e-300))


def _slopes(values: Tensor) -> Tensor:
    """Slopes (2, height, width) along x and y."""
    y, x = torch.gradient(values)
    return torch.stack([x, y])


def _sd(found: _Fit) -> float:
    """RMS standard deviation of the displacement, pixels of the level; a rotation's is that at half the rim."""
    variance = found.covariance.diagonal()
    return math.sqrt(float(variance[0] + variance[1] + 0.25 * variance[2]) + 2 * FLOOR_PX**2)


def _moved_by(matrix: Tensor, pair: _Pair) -> tuple[float, float]:
    """(x, y) by which the middle of the box is moved."""
    height, width = pair.weight.shape
    middle = torch.tensor([(width - 1) / 2, (height - 1) / 2, 1.0], dtype=torch.float64)
    x, y, _ = (matrix @ middle - middle).tolist()
    return x, y


def _degrees(matrix: Tensor) -> float:
    return Motion(matrix=matrix).rotation_deg
