"""The shape of a carved turtle seen from above: a glazed shell of scutes on a softly carved body.

Everything is a function of (u, v), fractions of the picture's side: u to the right, v towards the head. Heights are
fractions of that side too. Parts are rounded ellipses that melt into one another by a smooth maximum; lines are
engraved by what separates the two nearest of a set of centres (a Voronoi diagram), so that they follow the scutes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

SHELL = (0.0, -0.055, 0.262, 0.305)
"""Middle and half axes of the shell's outline."""
SCUTES = (
    *((0.0, v) for v in (0.250, 0.133, 0.0, -0.133, -0.246)),
    *((side * u, v) for side in (-1, 1) for u, v in ((0.144, 0.203), (0.169, 0.067), (0.169, -0.075), (0.139, -0.208))),
)
"""Centres of the five scutes along the back and of the four on either side, relative to the shell's middle."""
MARGINAL = 0.80
"""Where the shell's rim begins, as a share of its outline's radius."""
RIM_PLATES = 24
EYES = tuple((side * 0.049, 0.375) for side in (-1, 1))
EYE = 0.0165
"""Radius of an eye."""


class Limb(NamedTuple):
    """A part of the body: a rounded ellipse, bent."""

    u: float
    v: float
    half_length: float
    half_width: float
    angle_deg: float
    """Of its long axis, from u towards v."""
    bend: float
    """How far its ends lie to the right of its long axis, as a share of its half length."""
    rise: float


def _pair(limb: Limb) -> tuple[Limb, Limb]:
    """A limb of the right-hand side, and its mirror image."""
    return limb, limb._replace(u=-limb.u, angle_deg=180 - limb.angle_deg, bend=-limb.bend)


BODY = (
    Limb(0.0, 0.315, 0.125, 0.083, 90, 0.0, 0.110),
    Limb(0.0, -0.365, 0.080, 0.030, -90, 0.0, 0.040),
    *_pair(Limb(0.290, 0.125, 0.205, 0.088, -14, 0.34, 0.070)),
    *_pair(Limb(0.225, -0.310, 0.140, 0.074, -52, 0.15, 0.058)),
)
"""Head, tail, front flippers and hind flippers."""


def turtle_height(u: Float[Tensor, "*p"], v: Float[Tensor, "*p"]) -> Float[Tensor, "*p"]:
    """Height of the turtle at (u, v), a fraction of the picture's side; NaN beside it."""
    body = _softly_largest([_ellipse(limb, u, v) for limb in BODY], 0.012)
    body = body + torch.where(body > 0, _pebbles(u, v), 0.0) * (body / 0.03).clamp(0, 1)
    for eye_u, eye_v in EYES:
        away = ((u - eye_u).square() + (v - eye_v).square()) / EYE**2
        body = body + 0.013 * torch.exp(-1.2 * away.square()) - 0.006 * torch.exp(-8 * (away.sqrt() - 1.45).square())
    out = _outline(u, v)
    shell = 0.035 + 0.125 * (1 - out.clamp_max(1).square()).clamp_min(0) ** 0.75 + _carving(u, v)
    shell = torch.where(out < 1, shell, -1.0)
    z = torch.where(out < 1, _softly_largest([shell, body], 0.006), body)
    return torch.where(z > 0, z, torch.nan)


def on_shell(u: Float[Tensor, "*p"], v: Float[Tensor, "*p"]) -> Bool[Tensor, "*p"]:
    """Where the shell is seen."""
    return _outline(u, v) < 1


def in_eye(u: Float[Tensor, "*p"], v: Float[Tensor, "*p"]) -> Bool[Tensor, "*p"]:
    """Where an eye is seen."""
    found = torch.zeros_like(u, dtype=torch.bool)
    for eye_u, eye_v in EYES:
        found |= (u - eye_u).square() + (v - eye_v).square() < EYE**2
    return found


def stain(u: Float[Tensor, "*p"], v: Float[Tensor, "*p"]) -> Float[Tensor, "*p"]:
    """How deeply glaze or wax is coloured, 0 pale to 1 deep: deep along seams and in hollows, pale in mid-scute."""
    gap, centre = _seam(u, v)
    rays = 0.5 + 0.5 * torch.sin(9 * torch.atan2(centre[1], centre[0]) + 2.0)
    inner = torch.exp(-gap / 0.034) * (0.55 + 0.45 * rays)
    rim = _outline(u, v) > MARGINAL
    plates = 0.5 + 0.5 * torch.cos(2 * RIM_PLATES / 2 * _bearing(u, v))
    shell = torch.where(rim, 0.25 + 0.6 * plates, inner)
    skin = (0.35 - 110 * _pebbles(u, v)).clamp(0, 1)
    return torch.where(on_shell(u, v), shell, skin).clamp(0, 1)


def _outline(u: Tensor, v: Tensor) -> Tensor:
    """Radius relative to the shell's outline, which is an egg, broader behind."""
    middle_u, middle_v, half_u, half_v = SHELL
    y = (v - middle_v) / half_v
    x = (u - middle_u) / (half_u * (1 - 0.06 * y))
    return (x.square() + y.square() + 1e-12).sqrt()


def _bearing(u: Tensor, v: Tensor) -> Tensor:
    return torch.atan2((v - SHELL[1]) / SHELL[3], (u - SHELL[0]) / SHELL[2])


def _seam(u: Tensor, v: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Distance from the nearest seam between scutes, and the way from the middle of the scute."""
    ways = [(u - SHELL[0] - x, v - SHELL[1] - y) for x, y in SCUTES]
    far = torch.stack([(du.square() + dv.square()).sqrt() for du, dv in ways])
    two, which = far.topk(2, dim=0, largest=False)
    du, dv = (torch.stack([way[k] for way in ways]).gather(0, which[:1])[0] for k in range(2))
    return (two[1] - two[0]) / 2, (du, dv)


def _carving(u: Tensor, v: Tensor) -> Tensor:
    """Relief of the shell: seams, growth rings along them, and the plates of the rim."""
    gap, _ = _seam(u, v)
    out = _outline(u, v)
    inner = torch.sigmoid((MARGINAL - out) / 0.006)
    scutes = 0.016 * (1 - torch.exp(-gap / 0.016)) - 0.007 * torch.exp(-(gap / 0.0055).square())
    rings = 0.0011 * torch.cos(2 * math.pi * gap / 0.0135) * torch.exp(-(gap / 0.045).square()) * (gap > 0.005)
    edge = -0.010 * torch.exp(-((out - MARGINAL) / 0.020).square())
    plates = (torch.cos(RIM_PLATES / 2 * _bearing(u, v))).abs()
    rim = 0.008 * (1 - torch.exp(-plates / 0.25)) * ((1 - out) / 0.08).clamp(0, 1)
    return inner * (scutes + rings) + (1 - inner) * rim + edge


def _pebbles(u: Tensor, v: Tensor) -> Tensor:
    """Relief of the skin: rounded grains on a warped hexagonal lattice, about 0.0175 of the picture apart."""
    wave = 2 * math.pi / 0.0185
    x, y = u + 0.006 * torch.sin(38 * v + 1), v + 0.006 * torch.sin(35 * u)
    total = torch.zeros_like(u)
    for turn in range(3):
        along = x * math.cos(turn * math.pi / 3 + 0.2) + y * math.sin(turn * math.pi / 3 + 0.2)
        total = total + torch.cos(wave * along)
    return 0.0011 * total


def _ellipse(limb: Limb, u: Tensor, v: Tensor) -> Tensor:
    """Height of a rounded ellipse, falling below 0 outside it."""
    angle = math.radians(limb.angle_deg)
    x, y = u - limb.u, v - limb.v
    along, across = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)
    across = across + limb.bend * along.square() / limb.half_length
    # A blade: broad at the shoulder, pointed at its end.
    width = limb.half_width * (1 - 0.3 * along / limb.half_length).clamp_min(0.5)
    radius = (along / limb.half_length).square() + (across / width).square()
    return limb.rise * torch.where(radius < 1, (1 - radius).clamp_min(0) ** 0.6, 1 - radius)


def _softly_largest(heights: Sequence[Tensor], blend: float) -> Tensor:
    """The largest of heights, with the creases between them filled over `blend`."""
    return blend * torch.logsumexp(torch.stack(list(heights)) / blend, 0)
