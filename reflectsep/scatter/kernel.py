"""A pixel's profile over the frames as the line spread of a sum of exponentials, and what of it left beyond a distance.

A line of light at distance t from a pixel adds A e^(-|t|/s) to it; a slab of half width h, its middle at u, adds the
integral over its width. Sources on either side have amplitudes of their own, four scales s or more are shared, and the
lit frames hold a constant more, the light that entered at the pixel itself (local diffuse and specular):

    P(u) = Phi(u) sum_i [A-_i E-(u; s_i) + A+_i E+(u; s_i)] + D [|u| < h],      all amplitudes >= 0
    E-(u; s) = e^(min(u+h,0)/s) - e^(min(u-h,0)/s),    E+(u; s) = E-(-u; s),    sum over frames of E = 2 h

Phi is the light that the slab brings to the object, relative to the pixel's own frames: none where it has left the
object or crosses a shadow. Without it the cut-off profile of a pixel near the rim passes for a steep one, and on a flat
disc as wide as five scales the sum came out 10 to 25 % too high.

The line spread e^(-|t|/s) belongs to the radial spread K_0(r/s), since the integral of K_0(sqrt(t^2+y^2)/s) dy is
pi s e^(-|t|/s). Of its light the part (d/s) K_1(d/s) left farther than d from where it entered. So the fitted profile
says how much of the scattering is beyond any distance: the part nearer than d is taken off the sum of filled frames.

Frames are a unit step apart, so that away from the slab every E is a power of the row, the same for all pixels, times
one factor a pixel, f its fraction of a frame:

    E-(k + f; s) = e^(f/s) c(k; s),    c(k; s) = e^((k+h)/s) (1 - e^(-2h/s)),    k + f <= -h;    E+ mirrored

With the factor taken into the amplitude, the normal equations are products of one small matrix with the weights of all
pixels; only the rows at the slab, and those on both sides of nothing, are worked out pixel by pixel.

K_0 is pointed, as the spread of real media is. A round spread, e^(-r/s), has the same tails, and from frames that are
two pixels apart the two cannot be told from each other: of such a body the scattering comes out 0 to 20 % too high.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.scatter.windows import Profiles
from reflectsep.solve.nonnegative import nonnegative_least_squares

SMALLEST_SCALE = 0.35
LARGEST_SCALE = 2.8
CHUNK = 1 << 13
MODEL_ERROR = 0.05
"""Relative error of the sum of exponentials; noise counts against it."""
RIDGE = 1e-3
LEAST_RIDGE = 1e-9
"""Of the light that entered at the pixel."""


@dataclass(frozen=True, kw_only=True)
class Slab:
    """The slab as the frames see it."""

    half: float
    """Half the number of frames in which it lights a patch."""
    edge: float
    """Frames around its edge in which a patch may be lit in part."""
    frames_per_px: float
    """Frames in which it moves by one pixel."""


def scales(slab: Slab) -> Float[Tensor, "scales"]:
    """Scales of the exponentials in frames, a factor of two apart: from what a frame resolves to nearly three slabs."""
    count = 1 + round(math.log2(LARGEST_SCALE * max(1.0, slab.half) / SMALLEST_SCALE))
    return SMALLEST_SCALE * 2.0 ** torch.arange(count, dtype=torch.float32)


def beyond(distance: float | Float[Tensor, "pixels"], s: Float[Tensor, "scales"]) -> Float[Tensor, "scales *pixels"]:
    """Part (d/s) K_1(d/s) of the light of a K_0 spread that leaves farther than d from where it entered."""
    if isinstance(distance, Tensor):
        s = s[:, None]
    x = (distance / s).clamp(min=1e-6)
    return x * torch.special.modified_bessel_k1(x)


def line_response(
    u: Float[Tensor, "frames values"], half: float, s: Float[Tensor, "scales"]
) -> Float[Tensor, "frames sides_scales values"]:
    """E- then E+ for every scale, of a slab at offset u; the sum over frames a unit step apart is 2 h."""
    columns = []
    for side in (u, -u):
        v, scale = side[:, None, :], s[:, None]
        far, near = ((half - v) / scale).clamp(min=0), ((-half - v) / scale).clamp(min=0)
        columns.append(torch.exp(-near) - torch.exp(-far))
    return torch.cat(columns, 1)


def fill_by_profile(
    profiles: Profiles, slab: Slab, *, distance_px: float | Float[Tensor, "pixels"], noise: float
) -> Float[Tensor, "channels pixels"]:
    """What the scattering added in the holes, less what left nearer than `distance_px` from where it entered.

    Args:
        profiles: root frames around each pixel's passage.
        slab: its geometry.
        distance_px: pixels across the sheet of light, one for all or one a pixel.
        noise: standard deviation of a root frame.
    """
    channels, pixels = profiles.root.shape[1:]
    result = torch.zeros((channels, pixels))
    # Where nothing is lit or lost there is nothing to fill.
    wanted = profiles.hole.any(0).nonzero()[:, 0]
    parts = -(-len(wanted) // CHUNK)
    for part in wanted.chunk(parts) if parts else ():
        at = slice(int(part[0]), int(part[-1]) + 1) if int(part[-1]) - int(part[0]) < len(part) else part
        some = profiles.part(at)
        near_px = distance_px[at] if isinstance(distance_px, Tensor) else distance_px
        base = _Base(some, slab)
        far = beyond(near_px * slab.frames_per_px, base.scales).reshape(len(base.scales), -1)
        for c in range(channels):
            result[c, at] = _fill(some, c, base, far, noise)
    return result


def _fill(profiles: Profiles, channel: int, base: _Base, far: Tensor, noise: float) -> Tensor:
    value, clipped = profiles.root[:, channel], profiles.saturated[:, channel]
    sound = profiles.present & ~clipped
    weight, plateau, size = _weights(value, sound & ~profiles.hole, sound & profiles.hole & base.inside, noise)
    normal, right = base.equations(weight, plateau, value)
    ridge = torch.diagonal(normal).T
    ridge[:-1] += RIDGE / (size * base.factor) ** 2
    ridge[-1] += LEAST_RIDGE / size**2
    amplitude = nonnegative_least_squares(normal, right)[:-1]
    return _beyond_in_holes(profiles, value, sound, base, amplitude, far)


def _weights(value: Tensor, measured: Tensor, plateau: Tensor, noise: float) -> tuple[Tensor, Tensor, Tensor]:
    """Squared weights; those of the plateau's frames alone; and the signal's size.

    They are of relative errors where the signal is strong, of absolute ones in the noise.
    """
    high = value.abs()
    size = (high * measured).amax(0).clamp_(min=1e-6) + noise / MODEL_ERROR
    # Lit frames may be dark to the last digit, in a shadow or a channel: they count no more than a dark frame beside
    # them, nor than the noise allows. Their weight would drown all others' digits.
    least = (0.02 * size).clamp_min(max(1e-6, noise))
    lit = plateau / torch.maximum((high * plateau).amax(0), least) ** 2
    tail = measured / high.add_(0.02 * size).square_().add_((noise / MODEL_ERROR) ** 2)
    return tail.add_(lit), lit, size


def _beyond_in_holes(
    profiles: Profiles, value: Tensor, sound: Tensor, base: _Base, amplitude: Tensor, far: Tensor
) -> Tensor:
    """Sum of the model over the holes, never above what was measured there, less its near part."""
    filled, whole = torch.zeros_like(value[0]), torch.zeros_like(value[0])
    for row in profiles.hole.any(1).nonzero()[:, 0].tolist():
        model = base.model(row, amplitude) * profiles.hole[row]
        whole += model
        filled += torch.where(sound[row], torch.minimum(model, value[row].clamp(min=0.0)), model)
    kept = filled / whole.clamp(min=1e-20)
    near = 2.0 * base.slab.half * (amplitude / base.factor * (1.0 - torch.cat([far, far]))).sum(0)
    return filled - kept.clamp_(max=1.0) * near * profiles.lit


class _Base:
    """The columns of the fit: E- and E+ of every scale, times the light, each over its pixel's factor."""

    def __init__(self, profiles: Profiles, slab: Slab) -> None:
        self.slab, self.scales, self.light = slab, scales(slab), profiles.light
        reach = len(profiles.offset) // 2
        fraction = profiles.offset[reach]
        self.factor = torch.cat([self._powers(-fraction), self._powers(fraction)])
        """e^(f/s) of E-, e^(-f/s) of E+."""
        # Rows that may lie within the slab, for a fraction of up to half a frame, those before and those after them.
        inner = min(reach, math.ceil(slab.half + 0.5) - 1)
        self.before, self.after = slice(0, reach - inner), slice(reach + inner + 1, len(profiles.offset))
        self.middle = slice(reach - inner, reach + inner + 1)
        rows = torch.arange(inner + 1.0, reach + 1.0)[:, None]
        self.outer = torch.exp((slab.half - rows) / self.scales) * -torch.expm1(-2.0 * slab.half / self.scales)
        """c(k; s) of the rows after the inner ones; of those before them in reverse."""
        u = profiles.offset[self.middle]
        self.columns = torch.stack(
            [self._inner(row, light) for row, light in zip(u, self.light[self.middle], strict=True)]
        )
        self.inside = profiles.offset.abs() <= slab.half - slab.edge

    def _powers(self, x: Tensor) -> Float[Tensor, "scales values"]:
        """e^(-x/s): scales are a factor of two apart, so that each is the square of the next."""
        powers = [torch.exp(-x / self.scales[-1])]
        for _ in self.scales[1:]:
            powers.append(powers[-1].square())
        return torch.stack(powers[::-1])

    def _inner(self, u: Tensor, light: Tensor) -> Float[Tensor, "sides_scales values"]:
        """A row of columns, of any offset."""
        half = self.slab.half
        sides = [self._powers((-half - v).clamp_(min=0.0)) - self._powers((half - v).clamp_(min=0.0)) for v in (u, -u)]
        return torch.cat(sides) * (light / self.factor)

    def equations(
        self, weight: Float[Tensor, "frames values"], plateau: Float[Tensor, "frames values"], value: Tensor
    ) -> tuple[Float[Tensor, "unknowns unknowns values"], Float[Tensor, "unknowns values"]]:
        """Normal equations of E-, E+ and the light that entered at the pixel; weights are squared ones."""
        s, both = len(self.scales), 2 * len(self.scales)
        normal, right = (
            value.new_zeros((both + 1, both + 1, value.shape[1])),
            value.new_zeros((both + 1, value.shape[1])),
        )
        lit = weight * self.light
        seen = lit * value
        lit.mul_(self.light)
        pairs = (self.outer[:, :, None] * self.outer[:, None, :]).flatten(1)
        normal[:s, :s] = (pairs.flip(0).T @ lit[self.before]).view(s, s, -1)
        normal[s:both, s:both] = (pairs.T @ lit[self.after]).view(s, s, -1)
        right[:s], right[s:both] = self.outer.flip(0).T @ seen[self.before], self.outer.T @ seen[self.after]
        for i, row in enumerate(range(self.middle.start, self.middle.stop)):
            columns = self.columns[i]
            weighted = columns * weight[row]
            normal[:both, :both].addcmul_(weighted[:, None], columns)
            right[:both].addcmul_(weighted, value[row])
            normal[:both, both].addcmul_(columns, plateau[row])
        normal[both, :both] = normal[:both, both]
        normal[both, both] = plateau[self.middle].sum(0)
        right[both] = (plateau * value)[self.middle].sum(0)
        return normal, right

    def model(self, row: int, amplitude: Float[Tensor, "sides_scales values"]) -> Float[Tensor, "values"]:
        """What a frame of the window has by the fit, without the light that entered at the pixel."""
        s = len(self.scales)
        if row < self.before.stop:
            return self.light[row] * (self.outer[self.before.stop - 1 - row] @ amplitude[:s])
        if row >= self.after.start:
            return self.light[row] * (self.outer[row - self.after.start] @ amplitude[s:])
        return (self.columns[row - self.middle.start] * amplitude).sum(0)
