"""Light directions from a mirror ball: where the highlight sits on the ball says where the light is.

On a ball of centre c and radius r, seen from far along V, the highlight at (x, y) has the normal

    N = ((x - c_x) / r, -(y - c_y) / r, sqrt(1 - ...)),      L = 2 (N . V) N - V

L is the reflected view, not the normal: taking N for L halves the angle off the view.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.data import Vector
from reflectsep.errors import LightError

HIGHLIGHT = 0.5
"""Of the ball's brightest value; the highlight is the largest region above, each pixel weighing by how far."""
FEWEST_RIM = 32
HYPOTHESES = 400
TOUCHING = 1.5
"""Pixels from the circle within which a rim pixel agrees."""


@dataclass(frozen=True, kw_only=True)
class Circle:
    """A ball in a picture, pixels, (column, row)."""

    x: float
    y: float
    radius: float
    residual_px: float = 0.0
    """RMS distance of the rim pixels that agree."""
    support: float = 1.0
    """Their share of all rim pixels."""


@dataclass(frozen=True, kw_only=True)
class ChromeLight:
    """A light direction from one or several balls."""

    light: str
    direction: Vector
    spread_deg: float
    """Largest angle between two balls' directions; 0 for a single one."""
    position_deg: float
    """What a pixel's error of the highlight means in degrees, at its place on the ball."""


def find_circle(mask: Bool[Tensor, "height width"]) -> Circle:
    """The circle round a mask: robust (random triples, then least squares on the rim pixels that agree).

    Raises:
        LightError: too small, or no circle.
    """
    outside = torch.nn.functional.max_pool2d((~mask)[None, None].float(), 3, stride=1, padding=1)[0, 0] > 0
    rows, columns = (mask & outside).nonzero(as_tuple=True)
    points = torch.stack([columns, rows], 1).double()
    if len(points) < FEWEST_RIM:
        raise LightError(f"chrome ball: an outline of {len(points)} pixels, expected at least {FEWEST_RIM}")
    generator = torch.Generator().manual_seed(0)
    triples = points[torch.randint(len(points), (HYPOTHESES, 3), generator=generator)]
    centres, radii = _through(triples)
    distance = ((points[None] - centres[:, None]).norm(dim=2) - radii[:, None]).abs()
    agree = (distance < TOUCHING).double().mean(1).nan_to_num(0.0)
    best = int(agree.argmax())
    near = distance[best] < TOUCHING
    centre, radius, error = centres[best], radii[best], distance[best]
    for _ in range(5):
        centre, radius = least_squares_circle(points[near])
        error = (points - centre).norm(dim=1) - radius
        near = error.abs() < TOUCHING
        if int(near.sum()) < FEWEST_RIM // 2:
            raise LightError("chrome ball: its outline is no circle; give circle=[x,y,radius]")
    support = float(near.double().mean())
    if support < 0.5:
        raise LightError(f"chrome ball: {support:.0%} of its outline lie on a circle; give circle=[x,y,radius]")
    # Rim pixels are the outermost inside: their centres lie half a pixel within the outline.
    return Circle(
        x=float(centre[0]),
        y=float(centre[1]),
        radius=float(radius) + 0.5,
        residual_px=float(error[near].square().mean().sqrt()),
        support=support,
    )


def disc(circle: Circle, height: int, width: int) -> Bool[Tensor, "height width"]:
    """Pixels of a ball."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return (x - circle.x) ** 2 + (y - circle.y) ** 2 <= circle.radius**2


def highlight(picture: Float[Tensor, "height width"], circle: Circle) -> tuple[float, float]:
    """Centre (column, row) of the highlight: the intensity-weighted middle of the bright region.

    Raises:
        LightError: the ball is dark.
    """
    inside = disc(circle, *picture.shape)
    values = torch.where(inside, picture.double(), 0.0)
    most = float(values.max())
    if not most > 0:
        raise LightError("chrome ball: dark, expected a highlight; was the light on?")
    bright = values >= HIGHLIGHT * most
    region = _largest(bright)
    weight = torch.where(region, values - 0.99 * HIGHLIGHT * most, 0.0)
    y, x = torch.meshgrid(
        torch.arange(picture.shape[0], dtype=torch.float64),
        torch.arange(picture.shape[1], dtype=torch.float64),
        indexing="ij",
    )
    return float((weight * x).sum() / weight.sum()), float((weight * y).sum() / weight.sum())


def reflected(place: tuple[float, float], circle: Circle, view: Vector = (0.0, 0.0, 1.0)) -> tuple[Vector, float]:
    """Direction to the light whose highlight is at `place`, and degrees that one pixel there stands for.

    Raises:
        LightError: the place is off the ball.
    """
    n_x, n_y = (place[0] - circle.x) / circle.radius, -(place[1] - circle.y) / circle.radius
    rest = 1.0 - n_x**2 - n_y**2
    if rest <= 1e-6:
        raise LightError(
            f"chrome ball: highlight at ({place[0]:.1f}, {place[1]:.1f}), off the ball of radius {circle.radius:.1f}"
        )
    normal = torch.tensor([n_x, n_y, math.sqrt(rest)], dtype=torch.float64)
    toward = torch.tensor(view, dtype=torch.float64)
    toward = toward / toward.norm()
    light = 2.0 * float(normal @ toward) * normal - toward
    light = light / light.norm()
    x, y, z = light.tolist()
    return (x, y, z), math.degrees(2.0 / circle.radius / math.sqrt(rest))


def chrome_lights(
    names: Sequence[str],
    pictures: Float[Tensor, "lights height width"],
    circles: Sequence[Circle],
    view: Vector = (0.0, 0.0, 1.0),
) -> tuple[ChromeLight, ...]:
    """Direction of every light, the mean over the balls.

    Args:
        names: of the lights.
        pictures: grey pictures of the balls, one a light.
        circles: the balls.
        view: towards the camera.

    Raises:
        LightError: a light without a highlight on some ball, named.
    """
    found = []
    for name, picture in zip(names, pictures, strict=True):
        try:
            each = [reflected(highlight(picture, circle), circle, view) for circle in circles]
        except LightError as error:
            raise LightError(f"light {name}: {error}") from None
        directions = torch.tensor([direction for direction, _ in each], dtype=torch.float64)
        mean = directions.mean(0)
        x, y, z = (mean / mean.norm()).tolist()
        cosines = (directions @ directions.mT).clamp(-1, 1)
        found.append(
            ChromeLight(
                light=name,
                direction=(x, y, z),
                spread_deg=math.degrees(math.acos(float(cosines.min()))) if len(each) > 1 else 0.0,
                position_deg=max(degrees for _, degrees in each),
            )
        )
    return tuple(found)


@dataclass(frozen=True, kw_only=True)
class Difference:
    """How two sources of a light differ."""

    light: str
    angle_deg: float
    magnitude_percent: float


def compare_lights(first: Mapping[str, Vector], second: Mapping[str, Vector]) -> tuple[Difference, ...]:
    """Angles and magnitudes between two lists, for the lights that both have; per cent of the first."""
    result = []
    for name in first:
        if name in second:
            a, b = (torch.tensor(v[name], dtype=torch.float64) for v in (first, second))
            angle = math.atan2(float(torch.linalg.cross(a, b).norm()), float(a @ b))
            size = 100.0 * (float(b.norm() / a.norm()) - 1.0)
            result.append(Difference(light=name, angle_deg=math.degrees(angle), magnitude_percent=size))
    return tuple(result)


def sphere_normals(circle: Circle, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Normals (height, width, 3) of a ball, and where it is seen."""
    y, x = torch.meshgrid(
        torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64), indexing="ij"
    )
    n_x, n_y = (x - circle.x) / circle.radius, -(y - circle.y) / circle.radius
    rest = 1.0 - n_x**2 - n_y**2
    return torch.stack([n_x, n_y, rest.clamp_min(0).sqrt()], -1), rest > 0.04


@dataclass(frozen=True, kw_only=True)
class DiffuseSphere:
    """What a matte ball of one albedo says of a light."""

    light: str
    intensity: float
    """Least-squares I / N.L over the lit pixels; the same unit for all lights of a set."""
    error: float
    """RMS of what the direction leaves unexplained, over the picture's RMS."""
    direction: Vector
    """The direction that explains the ball best."""


def diffuse_lights(
    names: Sequence[str],
    pictures: Float[Tensor, "lights height width"],
    circle: Circle,
    directions: Mapping[str, Vector],
) -> tuple[DiffuseSphere, ...]:
    """Intensity of every light from a matte ball, and how well its direction explains the ball.

    Pixels near the terminator and clipped ones (at the largest value) are left out.
    """
    normals, seen = sphere_normals(circle, *pictures.shape[1:])
    result = []
    for name, picture in zip(names, pictures.double(), strict=True):
        light = torch.tensor(directions[name], dtype=torch.float64)
        light = light / light.norm()
        shading = normals @ light
        use = seen & (shading > 0.15) & (picture < 0.999 * max(1e-12, float(pictures.max())))
        values = picture[use]
        strength = float((values * shading[use]).sum() / shading[use].square().sum())
        error = float((values - strength * shading[use]).norm() / values.norm())
        lit = seen & (picture > 0.15 * float(picture[seen].max())) & (picture < 0.999 * float(picture.max()))
        free = torch.linalg.lstsq(normals[lit], picture[lit][:, None]).solution[:, 0]
        x, y, z = (free / free.norm()).tolist()
        result.append(DiffuseSphere(light=name, intensity=strength, error=error, direction=(x, y, z)))
    return tuple(result)


def _through(triples: Tensor) -> tuple[Tensor, Tensor]:
    """Circles through three points each."""
    a, b, c = triples[:, 0], triples[:, 1], triples[:, 2]
    matrix = 2 * torch.stack([b - a, c - a], 1)
    right = torch.stack([(b.square() - a.square()).sum(1), (c.square() - a.square()).sum(1)], 1)
    determinant = torch.linalg.det(matrix)
    safe = torch.where(determinant.abs()[:, None, None] > 1e-6, matrix, torch.eye(2, dtype=matrix.dtype))
    centre = torch.linalg.solve(safe, right[..., None])[..., 0]
    radius = (a - centre).norm(dim=1)
    return centre, torch.where(determinant.abs() > 1e-6, radius, torch.nan)


def least_squares_circle(points: Float[Tensor, "points 2"]) -> tuple[Float[Tensor, "2"], Float[Tensor, ""]]:
    """Centre and radius through points (column, row): algebraic, then three geometric steps."""
    columns = torch.cat([2 * points, torch.ones(len(points), 1, dtype=points.dtype)], 1)
    solution = torch.linalg.lstsq(columns, points.square().sum(1, keepdim=True)).solution[:, 0]
    centre = solution[:2]
    for _ in range(3):
        away = points - centre
        length = away.norm(dim=1)
        jacobian = torch.cat([-away / length[:, None], -torch.ones(len(points), 1, dtype=points.dtype)], 1)
        radius = length.mean()
        step = torch.linalg.lstsq(jacobian, -(length - radius)[:, None]).solution[:, 0]
        centre = centre + step[:2]
    return centre, (points - centre).norm(dim=1).mean()


def _largest(mask: Tensor) -> Tensor:
    """The connected region (4 neighbours and diagonals) with the most pixels: labels spread to a fixed point."""
    height, width = mask.shape
    labels = torch.where(mask, torch.arange(1, mask.numel() + 1, dtype=torch.float64).view(height, width), 0.0)
    for _ in range(height * width):
        spread = torch.nn.functional.max_pool2d(labels[None, None], 3, stride=1, padding=1)[0, 0]
        spread = torch.where(mask, spread, 0.0)
        if torch.equal(spread, labels):
            break
        labels = spread
    if not bool(mask.any()):
        return mask
    found, counts = labels[mask].unique(return_counts=True)
    return labels == found[int(counts.argmax())]
