"""Motion of a picture against the reference, and the one warp that takes it back.

    sample(x) = S x + tau v,      tau from -1 at the first frame of a sweep to 1 at its last

S maps pixel coordinates (column, row, 1) of the reference to those of the picture; v, pixels, is slow drift inside a
sweep. Motions are composed as matrices, so that a picture is resampled once however many estimates led to S.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

Model = Literal["identity", "translation", "rigid", "affine", "homography"]
MODELS: tuple[Model, ...] = ("identity", "translation", "rigid", "affine", "homography")

EXACT = 1e-9
"""Pixels; a sampling position this near the picture's edge is inside."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Where a picture lies against the reference."""

    matrix: Float[Tensor, "3 3"] = field(default_factory=lambda: torch.eye(3, dtype=torch.float64))
    """From the reference's pixel coordinates to the picture's."""
    model: str = "identity"
    """Which model the evidence chose."""
    velocity: tuple[float, float] = (0.0, 0.0)
    """(x, y) pixels from the middle of a sweep to its end."""
    displacement_px: float = 0.0
    """RMS over the object."""
    sd_px: float = 0.0
    """Standard deviation of that displacement, by the data's own scatter."""
    trust: float = 1.0
    """0 to 1: share of the pixels that agree with the motion."""
    gain: float = 1.0
    """Least-squares factor between the two pictures, for a sweep its C."""
    applied: bool = False
    """Whether the picture is resampled by it."""
    reason: str = ""
    """Why it is applied or not."""

    @property
    def shift_px(self) -> tuple[float, float]:
        """(x, y) of the matrix's translation at the origin of the coordinates."""
        return float(self.matrix[0, 2]), float(self.matrix[1, 2])

    @property
    def rotation_deg(self) -> float:
        """Rotation of the matrix, of its linear part's nearest rotation, positive from x to y of the raster."""
        m = self.matrix
        return math.degrees(math.atan2(float(m[1, 0] - m[0, 1]), float(m[0, 0] + m[1, 1])))

    def at(self, time: float) -> Float[Tensor, "3 3"]:
        """The matrix at `time`, -1 at the start of a sweep, 1 at its end."""
        shift = torch.eye(3, dtype=torch.float64)
        shift[0, 2], shift[1, 2] = time * self.velocity[0], time * self.velocity[1]
        return shift @ self.matrix

    def plain(self) -> dict[str, Any]:
        """Every field in values that JSON has, exactly; `Motion.from_plain` takes them back."""
        return {**vars(self), "matrix": self.matrix.tolist()}

    @classmethod
    def from_plain(cls, values: dict[str, Any]) -> Motion:
        """What `plain` gave."""
        x, y = values["velocity"]
        return cls(**{**values, "matrix": torch.tensor(values["matrix"], dtype=torch.float64), "velocity": (x, y)})

    def document(self) -> dict[str, Any]:
        """As it stands in JSON."""
        return {
            "matrix": self.matrix.tolist(),
            "model": self.model,
            "velocity_px": list(self.velocity),
            "displacement_px": self.displacement_px,
            "rotation_deg": self.rotation_deg,
            "sd_px": self.sd_px,
            "trust": self.trust,
            "gain": self.gain,
            "applied": self.applied,
            "reason": self.reason,
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Motion:
        """What `document` gave.

        Raises:
            KeyError, TypeError, ValueError: it is none.
        """
        numbers = {name: float(document[name]) for name in ("displacement_px", "sd_px", "trust", "gain")}
        x, y = (float(value) for value in document["velocity_px"])
        matrix = torch.tensor(document["matrix"], dtype=torch.float64)
        if matrix.shape != (3, 3) or not matrix.isfinite().all() or not all(map(math.isfinite, (x, y))):
            raise ValueError(f"a motion of matrix {matrix.tolist()} and velocity {(x, y)}; finite ones were expected")
        return cls(
            matrix=matrix,
            velocity=(x, y),
            model=str(document["model"]),
            applied=bool(document["applied"]),
            reason=str(document["reason"]),
            **numbers,
        )


def shifted(dx: float, dy: float, degrees: float = 0.0, centre: tuple[float, float] = (0.0, 0.0)) -> Tensor:
    """Matrix of a rotation by `degrees` round `centre` (column, row), then a shift by (dx, dy) pixels."""
    angle = math.radians(degrees)
    c, s = math.cos(angle), math.sin(angle)
    x, y = centre
    return torch.tensor(
        [[c, -s, x - c * x + s * y + dx], [s, c, y - s * x - c * y + dy], [0.0, 0.0, 1.0]], dtype=torch.float64
    )


def pixel_grid(height: int, width: int) -> Float[Tensor, "3 height width"]:
    """Homogeneous pixel coordinates (column, row, 1), float64."""
    y, x = torch.meshgrid(
        torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64), indexing="ij"
    )
    return torch.stack([x, y, torch.ones_like(x)])


def positions(
    matrix: Float[Tensor, "3 3"], height: int, width: int, offset: Float[Tensor, "2 height width"] | None = None
) -> Float[Tensor, "2 height width"]:
    """Where each reference pixel is in the picture: (column, row)."""
    mapped = torch.einsum("ij,jhw->ihw", matrix, pixel_grid(height, width))
    places = mapped[:2] / mapped[2:]
    return places if offset is None else places + offset


def displacement(matrix: Float[Tensor, "3 3"], mask: Bool[Tensor, "height width"]) -> float:
    """RMS displacement over the object, pixels."""
    height, width = mask.shape
    moved = positions(matrix, height, width) - pixel_grid(height, width)[:2]
    return float(moved[:, mask].square().sum(0).mean().sqrt()) if bool(mask.any()) else 0.0


def sample(
    picture: Float[Tensor, "channels height width"],
    places: Float[Tensor, "2 height width"],
    mode: Literal["bilinear", "bicubic", "nearest"] = "bicubic",
) -> Float[Tensor, "channels height width"]:
    """The picture at fractional places (column, row); its edge is drawn on outwards.

    Torch's cubic has a = -0.75, which does not even keep a ramp in its place (0.05 px at a quarter of a pixel). The
    family is linear in a, and a = 0 is bilinear interpolation at f^2 (3 - 2 f) in place of the fraction f: two thirds
    of the one and a third of the other are a = -0.5, exact for parabolas (Keys, 1981).
    """
    if mode != "bicubic":
        return _remap(picture, places, mode)
    whole = places.floor()
    fraction = places - whole
    eased = whole + fraction.square() * (3.0 - 2.0 * fraction)
    return (2.0 * _remap(picture, places, "bicubic") + _remap(picture, eased, "bilinear")) / 3.0


def _remap(picture: Tensor, places: Tensor, mode: str) -> Tensor:
    # One grid for all channels, in torch's coordinates: -1 and 1 are the middles of the outermost pixels.
    size = places.new_tensor(picture.shape[:0:-1]).sub(1).clamp_min(1)
    grid = (places * (2.0 / size)[:, None, None] - 1.0).permute(1, 2, 0).to(picture.dtype)
    return grid_sample(picture[None], grid[None], mode=mode, padding_mode="border", align_corners=True)[0]


def inside(places: Float[Tensor, "2 height width"]) -> Bool[Tensor, "height width"]:
    """Places that lie in a picture of the same size."""
    height, width = places.shape[1:]
    return (
        (places[0] >= -EXACT)
        & (places[0] <= width - 1 + EXACT)
        & (places[1] >= -EXACT)
        & (places[1] <= height - 1 + EXACT)
    )


def warp(
    picture: Float[Tensor, "channels height width"],
    matrix: Float[Tensor, "3 3"],
    saturated: Bool[Tensor, "channels height width"] | None = None,
) -> tuple[Tensor, Tensor | None, Bool[Tensor, "height width"]]:
    """The picture as the reference sees it: resampled once, bicubic.

    Args:
        picture: linear values; where they are not finite, so is what touches them.
        matrix: from reference to picture coordinates.
        saturated: clipped values.

    Returns:
        Values; clipped ones (any that enter the value with the bilinear neighbours); and true where the value comes
        from inside the picture.
    """
    height, width = picture.shape[-2:]
    places = positions(matrix, height, width)
    values = sample(picture, places)
    clipped = None
    if saturated is not None:
        clipped = sample(saturated.to(picture.dtype), places, "bilinear") > 1e-6
        # Next to a clipped value the cubic's overshoot is no measurement.
        values = torch.where(clipped, sample(picture, places, "bilinear"), values)
    return values, clipped, inside(places)
