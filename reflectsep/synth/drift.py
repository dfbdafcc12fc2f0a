"""A camera that moves between exposures: where each picture of a simulated capture lies, and the picture it then takes.

    picture(S x) = still picture(x),     S = shift by t, after a rotation round the middle of the picture

Resampled by Lagrange's quintics through six neighbours along each axis: exact for polynomials of degree five and
sharper than the cubic that corrects it, so that the correction is not handed its own inverse. (A Lanczos kernel would
not do: it moves a ramp by 0.02 px.)
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.errors import SettingsError

TAPS = 6


@dataclass(frozen=True, kw_only=True)
class Drift:
    """How far the camera moves; the first basis light's full picture is where the truth is."""

    between_px: float = 0.0
    """Shift of every sweep against the full picture of its light, in a random direction."""
    between_deg: float = 0.0
    """Rotation of every sweep, of random sign."""
    across_px: float = 0.0
    """Shift of every full picture against the first."""
    across_deg: float = 0.0
    """Rotation of every full picture against the first."""
    within_px: float = 0.0
    """Shift from the first frame of a sweep to its last, in a random direction."""

    def __post_init__(self) -> None:
        """Refuse distances below zero."""
        values = (self.between_px, self.between_deg, self.across_px, self.across_deg, self.within_px)
        if not min(values) >= 0:
            raise SettingsError(f"drift {values}, expected none below 0")

    @property
    def any(self) -> bool:
        """Whether anything moves."""
        return max(self.between_px, self.between_deg, self.across_px, self.across_deg, self.within_px) > 0


@dataclass(frozen=True, kw_only=True)
class Pose:
    """Where a picture lies: a matrix from the still picture's pixel coordinates to its own, and a velocity."""

    matrix: Float[Tensor, "3 3"]
    velocity: tuple[float, float] = (0.0, 0.0)
    """Pixels from the middle of a sweep to its end."""

    def at(self, time: float) -> Float[Tensor, "3 3"]:
        """The matrix at `time`, -1 to 1 over a sweep."""
        shift = torch.eye(3, dtype=torch.float64)
        shift[0, 2], shift[1, 2] = time * self.velocity[0], time * self.velocity[1]
        return shift @ self.matrix

    def document(self) -> dict[str, object]:
        """As it stands in JSON."""
        return {"matrix": self.matrix.tolist(), "velocity_px": list(self.velocity)}


def pose(drift: Drift, name: str, *, seed: int, size: tuple[int, int], still: Pose | None = None) -> Pose:
    """Pose of a full picture (`still` None) or, against its full picture's, of a sweep.

    Args:
        drift: how far things move.
        name: of the picture or sweep; with the seed it decides on directions.
        seed: of the capture.
        size: (width, height).
        still: pose of the full picture of a sweep's light.
    """
    rng = np.random.default_rng([seed, zlib.crc32(f"pose {name}".encode())])
    way, turn, along = rng.uniform(0, 2 * math.pi), rng.choice([-1.0, 1.0]), rng.uniform(0, 2 * math.pi)
    pixels, degrees = (drift.across_px, drift.across_deg) if still is None else (drift.between_px, drift.between_deg)
    width, height = size
    own = _matrix(pixels * math.cos(way), pixels * math.sin(way), turn * degrees, ((width - 1) / 2, (height - 1) / 2))
    if still is None:
        return Pose(matrix=own)
    half = drift.within_px / 2
    return Pose(matrix=own @ still.matrix, velocity=(half * math.cos(along), half * math.sin(along)))


def moved(
    picture: Float[Tensor, "channels fine_height fine_width"], matrix: Float[Tensor, "3 3"], oversample: int = 1
) -> Float[Tensor, "channels height width"]:
    """The picture as a camera at `matrix` (pixels) takes it; black beyond its edge.

    `picture` has `oversample` patches along a pixel's side; it is moved as it is, and its pixels take their mean then.
    """
    if oversample > 1:
        fine = torch.tensor([[oversample, 0, (oversample - 1) / 2], [0, oversample, (oversample - 1) / 2], [0, 0, 1]])
        fine = fine.to(matrix)
        return binned(moved(picture, fine @ matrix @ torch.linalg.inv(fine)), oversample)
    if torch.equal(matrix, torch.eye(3, dtype=matrix.dtype)):
        return picture
    height, width = picture.shape[1:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    points = torch.stack([x, y, torch.ones_like(x)]).double().flatten(1)
    back = torch.linalg.inv(matrix) @ points
    column, row = (back[:2] / back[2:]).view(2, height, width)
    first_x, first_y = column.floor() - TAPS // 2 + 1, row.floor() - TAPS // 2 + 1
    across, down = _lagrange(column - first_x), _lagrange(row - first_y)
    result = torch.zeros(picture.shape, dtype=torch.float64)
    flat = picture.double().flatten(1)
    for j in range(TAPS):
        for i in range(TAPS):
            u, v = first_x + i, first_y + j
            within = (u >= 0) & (u < width) & (v >= 0) & (v < height)
            index = (v.clamp(0, height - 1) * width + u.clamp(0, width - 1)).long().flatten()
            result += flat[:, index].view(-1, height, width) * (across[i] * down[j] * within)
    return result.to(picture.dtype)


def binned(
    picture: Float[Tensor, "channels fine_height fine_width"], oversample: int
) -> Float[Tensor, "channels height width"]:
    """Means of blocks of `oversample` by `oversample` values."""
    if oversample == 1:
        return picture
    return torch.nn.functional.avg_pool2d(picture[None], oversample)[0]


def _lagrange(place: Tensor) -> list[Tensor]:
    """Weights of nodes 0 to TAPS - 1 at a place between them."""
    weights = []
    for node in range(TAPS):
        weight = torch.ones_like(place)
        for other in range(TAPS):
            if other != node:
                weight = weight * (place - other) / (node - other)
        weights.append(weight)
    return weights


def _matrix(dx: float, dy: float, degrees: float, centre: tuple[float, float]) -> Tensor:
    angle = math.radians(degrees)
    c, s = math.cos(angle), math.sin(angle)
    x, y = centre
    return torch.tensor(
        [[c, -s, x - c * x + s * y + dx], [s, c, y - s * x - c * y + dy], [0.0, 0.0, 1.0]], dtype=torch.float64
    )
