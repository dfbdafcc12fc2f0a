"""Motions between lights, checked by what all the other pictures say of each one.

Direct light and scattering mix as light vectors do, so that a picture is nearly a linear mix of three maps g, which the
other pictures give pixel by pixel:

    picture_k(x) = l_k . g(x),      g(x) from the pictures j other than k, robustly against shadows and highlights

A picture registered against this prediction of itself does not depend on how shading looks from light to light, as one
registered against another light's picture does (`across_lights`). But lobe and shadows are no mix of three maps, and
other pictures may lie wrong too: what is found is good to 0.15 px. So a motion is only put right where it is off by
more, the worst first, and only where that makes all pictures predict one another better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from reflectsep.calibrate.across_lights import SHADING_FLOOR_PX
from reflectsep.calibrate.align_options import MARGIN_PX, grown
from reflectsep.calibrate.motion import Motion, displacement, inside, positions, sample, shifted
from reflectsep.calibrate.pyramid import from_level, to_level
from reflectsep.calibrate.register import RegisterOptions, Registration, register
from reflectsep.errors import CaptureError

FEWEST_LIGHTS = 6
"""Three maps and two pictures to spare beside the one that is predicted."""
APART_PX = 0.2
"""Least disagreement with the prediction that speaks against a motion, where it rests on many pictures."""
MOST_PIXELS = 40_000
"""Pictures are halved until they are no larger."""
ROUNDS = 12
"""Of the reweighted fit."""
TOLERANCE = 0.03
"""Of a pixel's brightest value: a residual so large halves a picture's weight."""
SHADOW = 0.1
"""Of a pixel's brightest value: below it a picture shows a shadow."""
UNLIKE = 0.6
"""Mean disagreement, 0 to 1, above which the light vectors do not explain the pictures, and say nothing of motion."""
TRIES = 3
"""Times that one motion may be put right."""


@dataclass(frozen=True, kw_only=True)
class _Pictures:
    """All pictures at the size at which they are compared."""

    grey: Float[Tensor, "lights height width"]
    good: Bool[Tensor, "lights height width"]
    vectors: Float[Tensor, "lights 3"]
    mask: Bool[Tensor, "height width"]
    factor: int


def checked_among_lights(
    motions: Sequence[Motion],
    grey: Float[Tensor, "lights height width"],
    good: Bool[Tensor, "lights height width"],
    mask: Bool[Tensor, "height width"],
    vectors: Float[Tensor, "lights 3"] | None,
) -> list[Motion]:
    """Motions of all pictures, those put right that the other pictures contradict.

    Args:
        motions: of every picture against the first, which stays.
        grey: linear pictures as they were taken.
        good: their finite, unclipped values.
        mask: the object, in the first.
        vectors: light directions times intensity; None where they are not known, then nothing is checked.

    Returns:
        The motions in their order; the same objects where they hold.
    """
    found = list(motions)
    if vectors is None or len(found) < FEWEST_LIGHTS:
        return found
    pictures = _reduced(grey, good, mask, vectors)
    matrices = [to_level(m.matrix if m.applied else torch.eye(3).double(), pictures.factor) for m in found]
    still, sound = _stilled(pictures, matrices)
    cost = _disagreement(pictures, still, sound)
    if cost > UNLIKE:
        return found
    tries = dict.fromkeys(range(1, len(found)), TRIES)
    while suspects := _suspects(pictures, matrices, still, sound, [k for k, left in tries.items() if left]):
        _, k, matrix, registered = suspects[0]
        trial = [*matrices[:k], matrix, *matrices[k + 1 :]]
        moved, usable = _stilled(pictures, trial)
        changed = _disagreement(pictures, moved, usable)
        tries = {j: tries[j] - (j == k) for _, j, _, _ in suspects}
        if changed >= cost:
            tries[k] = 0
            continue
        found[k] = _corrected(found[k], from_level(matrix, pictures.factor), registered, mask, (cost, changed))
        matrices, still, sound, cost = trial, moved, usable, changed
    return found


def predicted(
    pictures: Float[Tensor, "lights height width"],
    good: Bool[Tensor, "lights height width"],
    vectors: Float[Tensor, "lights 3"],
    k: int,
) -> Float[Tensor, "height width"]:
    """Picture k as the others have it: their robust mix of three maps, none below 0."""
    others = [j for j in range(len(pictures)) if j != k]
    light, sound = vectors[others], good[others].flatten(1).mT
    values = pictures[others].flatten(1).mT * sound
    brightest = values.amax(1, keepdim=True)
    lit = (values > SHADOW * brightest).to(values).clamp_min(1e-3) * sound
    products = (light[:, :, None] * light[:, None, :]).flatten(1)
    ridge = 1e-6 * torch.eye(3, dtype=values.dtype)
    scale = _scale(brightest)
    weight, maps = lit, torch.zeros(len(values), 3, dtype=values.dtype)
    for _ in range(ROUNDS):
        normal = (weight @ products).unflatten(1, (3, 3)) + ridge
        maps = torch.linalg.solve(normal, (weight * values) @ light)
        error = values - maps @ light.mT
        # Light that no mix explains is a highlight more often than darkness is a shadow that was not seen as one.
        weight = lit * torch.where(error > 0, 0.5, 1.0) / (1.0 + (error / scale).square())
    return (maps @ vectors[k]).clamp_min(0.0).view(pictures.shape[1:])


def _scale(brightest: Tensor) -> Tensor:
    """The residual that counts half, of values as bright as that; above 0 where all is dark."""
    return TOLERANCE * brightest.clamp_min(0.01 * float(brightest.max()) + 1e-12)


def _suspects(
    pictures: _Pictures, matrices: list[Tensor], still: Tensor, sound: Tensor, among: list[int]
) -> list[tuple[float, int, Tensor, Registration]]:
    """Pictures that their predictions have elsewhere, the worst first: by how much, which, and where to."""
    found = []
    for k in among:
        prediction = predicted(still, sound, pictures.vectors, k)
        try:
            registered = register(
                pictures.grey[k],
                prediction[None],
                usable=grown(pictures.mask, MARGIN_PX),
                moving_usable=pictures.good[k],
                options=RegisterOptions(models=("translation",), levels=2),
                start=matrices[k],
            )
        except CaptureError:
            continue
        matrix = _shifted_like(registered.matrix, matrices[k], pictures.mask)
        apart = displacement(matrix @ torch.linalg.inv(matrices[k]), pictures.mask)
        if apart > APART_PX * max(1.0, _leverage(pictures.vectors, k)):
            found.append((apart, k, matrix, registered))
    return sorted(found, key=lambda suspect: -suspect[0])


def _leverage(vectors: Tensor, k: int) -> float:
    """By how much a prediction multiplies independent errors of the pictures that it is made from."""
    others = torch.cat([vectors[:k], vectors[k + 1 :]])
    return float((vectors[k] @ torch.linalg.pinv(others)).norm())


def _shifted_like(found: Tensor, before: Tensor, mask: Tensor) -> Tensor:
    """`before` with the object's middle where `found` has it: a prediction does not tell a rotation."""
    rows, columns = mask.nonzero(as_tuple=True)
    middle = torch.stack([columns.double().mean(), rows.double().mean(), torch.tensor(1.0, dtype=torch.float64)])
    x, y, _ = (found @ middle - before @ middle).tolist()
    return shifted(x, y) @ before


def _disagreement(pictures: _Pictures, still: Tensor, sound: Tensor) -> float:
    """How unlike their predictions the pictures are on the object, 0 to 1 (Geman and McClure's loss)."""
    scale = _scale((still * sound).amax(0))
    total = []
    for k, picture in enumerate(still):
        counts = pictures.mask & sound[k]
        error = (picture - predicted(still, sound, pictures.vectors, k)) / scale
        square = error[counts].square()
        total.append(float((square / (1.0 + square)).mean()) if bool(counts.any()) else 1.0)
    return sum(total) / len(total)


def _corrected(
    before: Motion, matrix: Tensor, registered: Registration, mask: Tensor, cost: tuple[float, float]
) -> Motion:
    whole = displacement(matrix, mask)
    moves = whole > SHADING_FLOOR_PX
    fall = f"pictures agree {100 * (1 - cost[1] / cost[0]):.0f} % better"
    said = "by the other lights' pictures" if moves else "no motion beyond chance by the other lights' pictures"
    return replace(
        before,
        matrix=matrix,
        model=before.model if before.applied and moves else "translation",
        displacement_px=whole,
        sd_px=(registered.sd_px**2 + SHADING_FLOOR_PX**2) ** 0.5,
        trust=registered.trust,
        gain=float(registered.coefficients[0]),
        applied=moves,
        reason=f"{said}: {fall}",
    )


def _reduced(grey: Tensor, good: Tensor, mask: Tensor, vectors: Tensor) -> _Pictures:
    factor = 1
    while mask.numel() > MOST_PIXELS and min(mask.shape) > 2:
        grey = avg_pool2d(grey[:, None], 2)[:, 0]
        good = max_pool2d((~good)[:, None].float(), 2)[:, 0] == 0
        mask = avg_pool2d(mask[None].float(), 2)[0] > 0.5
        factor *= 2
    return _Pictures(grey=grey.double(), good=good, vectors=vectors.double(), mask=mask, factor=factor)


def _stilled(pictures: _Pictures, matrices: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Pictures where the first one has them, and their values that count."""
    height, width = pictures.mask.shape
    still, sound = torch.empty_like(pictures.grey), torch.empty_like(pictures.good)
    for k, matrix in enumerate(matrices):
        places = positions(matrix, height, width)
        still[k] = sample(pictures.grey[k][None], places)[0]
        bad = sample((~pictures.good[k])[None].double(), places, "bilinear")[0]
        sound[k] = (bad < 1e-6) & inside(places)
    return still, sound
