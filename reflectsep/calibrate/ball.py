"""A ball in pictures without a mask: the circle whose outline is in every picture and inside which the highlight moves.

Edges that stay where they are under every light are those of the mean logarithm of the pictures, in which what moves is
small. Every edge votes for the centres that lie along its slope (Kimme, Ballard and Sklansky 1975), at every radius; a
mirror's slopes point either way, by what is behind the ball. Candidates are refined on the edges next to them, and the
one is taken whose circumference shows most of its edges and which holds the brightest place of nearly every picture.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from kornia.filters import gaussian_blur2d, spatial_gradient
from torch import Tensor

from reflectsep.calibrate.chrome import Circle, least_squares_circle
from reflectsep.errors import LightError

LARGEST_PX = 160
"""Longer side of the picture in which centres are voted for."""
SMALLEST_SHARE, LARGEST_SHARE = 0.04, 0.6
"""Radii that are tried, of the shorter side."""
EDGES = 0.12
"""Share of the pixels, those of the steepest slopes, that vote."""
CANDIDATES = 24
SECTORS = 90
"""Of a circumference; each shows an edge or not."""
LEAST_SHOWN = 0.35
"""Share of them that must."""
RADIAL = math.cos(math.radians(20.0))
"""Cosine between an edge's slope and the radius."""
HOLDS = 0.8
"""Share of the pictures whose brightest place must lie on the ball."""
FAINT = 0.02
"""Of the bright end of the pictures, below which differences count as noise."""


def find_ball_circle(pictures: Float[Tensor, "lights height width"]) -> Circle:
    """The outline of the ball that all pictures show.

    Args:
        pictures: grey, linear, one a light; the ball whole and larger than a twelfth of the shorter side.

    Raises:
        LightError: no circle stands out; a mask or a circle must be given.
    """
    logarithm = _steady(pictures)
    places = _brightest(pictures)
    factor = max(1, math.ceil(max(logarithm.shape) / LARGEST_PX))
    small = torch.nn.functional.avg_pool2d(logarithm[None, None], factor)[0, 0]
    found: list[tuple[float, Circle]] = []
    for x, y, radius in _candidates(small):
        start = Circle(x=(x + 0.5) * factor - 0.5, y=(y + 0.5) * factor - 0.5, radius=radius * factor)
        circle = _refined(logarithm, start, 1.5 * factor + 1.0)
        if circle is not None and _holds(circle, places):
            found.append((circle.support, circle))
    if not found:
        raise LightError(
            "chrome ball: no circle holds the highlights of the pictures; give a mask or circle=[x,y,radius]"
        )
    shown, circle = max(found, key=lambda pair: pair[0])
    if shown < LEAST_SHOWN:
        raise LightError(
            f"chrome ball: the clearest circle shows {shown:.0%} of its outline, expected at least {LEAST_SHOWN:.0%}; "
            "give a mask or circle=[x,y,radius]"
        )
    return circle


def _steady(pictures: Tensor) -> Tensor:
    """Mean logarithm over the lights, each in its own unit."""
    values = pictures.double().clamp_min(0.0)
    # What the object itself sends, not the lamp's image, is the unit.
    unit = values.flatten(1).quantile(0.9, dim=1).clamp_min(1e-9)
    return (values / (FAINT * 10.0 * unit[:, None, None])).log1p().mean(0)


def _brightest(pictures: Tensor) -> Float[Tensor, "lights 2"]:
    """(column, row) of what every picture shows most brightly that the others do not."""
    own = pictures - pictures.median(0).values if len(pictures) > 2 else pictures
    smooth = gaussian_blur2d(own[:, None].double(), (7, 7), (1.5, 1.5))[:, 0]
    at = smooth.flatten(1).argmax(1)
    width = pictures.shape[2]
    return torch.stack([at % width, at // width], 1).double()


def _edges(logarithm: Tensor, blur_px: float, share: float) -> tuple[Tensor, Tensor, Tensor]:
    """Places (column, row) of the steepest pixels, unit slopes, and how steep they are."""
    size = 2 * math.ceil(3 * blur_px) + 1
    smooth = gaussian_blur2d(logarithm[None, None], (size, size), (blur_px, blur_px), border_type="replicate")
    slope = spatial_gradient(smooth, mode="sobel")[0, 0]
    steep = slope.norm(dim=0)
    least = steep.flatten().kthvalue(max(1, round((1.0 - share) * steep.numel()))).values
    rows, columns = (steep > least.clamp_min(1e-9)).nonzero(as_tuple=True)
    at = steep[rows, columns]
    return torch.stack([columns, rows], 1).double(), (slope[:, rows, columns] / at).mT, at


def _candidates(small: Tensor) -> list[tuple[float, float, float]]:
    """Centres and radii with the most votes, the best of every neighbourhood."""
    height, width = small.shape
    places, slopes, steep = _edges(small, 1.0, EDGES)
    shorter = min(height, width)
    radii = torch.arange(max(3.0, SMALLEST_SHARE * shorter), LARGEST_SHARE * shorter, 1.0, dtype=torch.float64)
    votes = torch.zeros(len(radii), height * width, dtype=torch.float64)
    weight = (steep / steep.median()).clamp(max=2.0)
    for way in (-1.0, 1.0):
        for i, radius in enumerate(radii.tolist()):
            centre = (places + way * radius * slopes).round().long()
            inside = (centre[:, 0] >= 0) & (centre[:, 0] < width) & (centre[:, 1] >= 0) & (centre[:, 1] < height)
            index = centre[inside, 1] * width + centre[inside, 0]
            votes[i].index_add_(0, index, weight[inside])
    score = votes.view(1, 1, len(radii), height, width)
    score = torch.nn.functional.avg_pool3d(score, 3, stride=1, padding=1)[0, 0] / radii[:, None, None].sqrt()
    peak = torch.nn.functional.max_pool3d(score[None, None], 7, stride=1, padding=3)[0, 0] == score
    best = torch.where(peak, score, 0.0).flatten().topk(CANDIDATES).indices.tolist()
    area = height * width
    return [(float(k % area % width), float(k % area // width), float(radii[k // area])) for k in best]


def _refined(logarithm: Tensor, start: Circle, reach_px: float) -> Circle | None:
    """The circle through the edges next to a candidate; its support is the share of sectors that show one."""
    places, slopes, steep = _edges(logarithm, 1.5, 1.5 * EDGES)
    circle = start
    for reach in (reach_px, 0.5 * reach_px + 1.0, 3.0, 2.0, 2.0):
        near = _nearest(places, slopes, steep, circle, reach)
        if len(near) < SECTORS // 5:
            return None
        centre, radius = least_squares_circle(places[near])
        error = (places[near] - centre).norm(dim=1) - radius
        circle = replace(
            circle,
            x=float(centre[0]),
            y=float(centre[1]),
            radius=float(radius),
            residual_px=float(error.square().mean().sqrt()),
            support=len(near) / SECTORS,
        )
    shorter = min(logarithm.shape)
    return circle if SMALLEST_SHARE * shorter < circle.radius < LARGEST_SHARE * shorter else None


def _nearest(places: Tensor, slopes: Tensor, steep: Tensor, circle: Circle, reach_px: float) -> Tensor:
    """Of every sector of the circle the steepest edge along the radius within reach."""
    away = places - torch.tensor([circle.x, circle.y], dtype=places.dtype)
    length = away.norm(dim=1).clamp_min(1e-9)
    radial = ((away / length[:, None]) * slopes).sum(1).abs() > RADIAL
    use = (radial & ((length - circle.radius).abs() < reach_px)).nonzero()[:, 0]
    sector = ((torch.atan2(away[use, 1], away[use, 0]) / (2 * math.pi) + 0.5) * SECTORS).long().clamp(0, SECTORS - 1)
    order = steep[use].argsort(stable=True)
    chosen = torch.full((SECTORS,), -1, dtype=torch.long)
    chosen[sector[order]] = use[order]  # the last written, the steepest, stays
    return chosen[chosen >= 0]


def _holds(circle: Circle, places: Tensor) -> bool:
    away = (places - torch.tensor([circle.x, circle.y], dtype=places.dtype)).norm(dim=1)
    return float((away < circle.radius).double().mean()) >= HOLDS
