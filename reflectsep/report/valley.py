"""How well the pictures tell a from B: the cost over both, everything else refitted at every pixel.

Along the valley a stronger lobe (B) and a deeper offset (a) trade against each other: the longer the valley at a small
rise of the cost, the less the split between highlight and diffuse part is determined by the pictures.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.data import PhotometricStack
from reflectsep.flags import Flag
from reflectsep.model import Globals, diffuse, length, lobe_of, mixed
from reflectsep.separation import Separation

PIXELS = 120
STEPS = 10
ROUNDS = 3
SPAN = 0.3


@dataclass(frozen=True, kw_only=True)
class Valley:
    """Root mean square misfit over (scale of a, scale of B), the fitted values being (1, 1)."""

    scales: Float[Tensor, "n"]
    misfit: Float[Tensor, "n n"]
    """Rows: scale of a; columns: one scale of B for all pixels; in the capture's units."""
    along: Float[Tensor, "n"]
    """Over the scale of a, with B free at every pixel."""
    pixels: int


def cost_valley(separation: Separation, stack: PhotometricStack, *, count: int = 21) -> Valley | None:
    """Misfit of the grey pictures at pixels that show the highlight, d refitted everywhere; None where there are none.

    Gauss-Newton on d (3 unknowns a pixel) with a damping of its own for every pixel and place of the grid.
    """
    # Of one material: the first, which most of the object is of.
    shows = separation.mask & (separation.material == 0) & ((separation.flags & int(Flag.FAINT_LOBE)) == 0)
    good = shows & ~stack.saturated.any(0).any(0) & stack.images.isfinite().all(0).all(0)
    where = torch.nonzero(good)
    if len(where) < 10:
        return None
    where = where[torch.linspace(0, len(where) - 1, min(PIXELS, len(where))).round().long()]
    row, column = where.T
    alpha, intensity = separation.unit_mix(separation.alpha)
    d, s = (t.mean(1)[:, row, column].T.double() for t in (separation.d, separation.s))
    I = stack.images.mean(1)[:, row, column].T.double() / intensity.double().clamp_min(1e-12)  # noqa: E741
    scales = torch.linspace(1 - SPAN, 1 + SPAN, count, dtype=torch.float64)
    a = scales[:, None, None, None] * separation.a.double()
    B = separation.B[row, column].double()
    case = _Case(separation=separation, alpha=alpha.double(), d=d, s=s, I=I)
    x = d.expand(count, count, -1, -1).clone()  # jvp writes into what it is given
    _, held = case.refitted(x, a, scales[None, :, None] * B)
    # B starts where each pixel's own misfit is least on the grid: from elsewhere it may end in a false minimum.
    best = scales[held.argmin(1)][:, None, :, None]
    x, free = case.refitted(torch.cat([d.expand(count, 1, -1, -1), best], -1), a, B.expand(count, 1, -1))
    # Where a neighbour along the valley found a better one, go on from there.
    for shift in (1, -1) * ROUNDS:
        other, misfit = case.refitted(x.roll(shift, 0), a, B.expand(count, 1, -1))
        x = torch.where((misfit < free)[..., None], other, x)
        free = torch.minimum(free, misfit)
    return Valley(scales=scales, misfit=held.mean(-1).sqrt(), along=free.mean(-1).sqrt()[:, 0], pixels=len(where))


def in_double(g: Globals) -> Globals:
    """The globals in double precision."""
    return replace(g, **{name: value.double() for name, value in vars(g).items() if isinstance(value, Tensor)})


@dataclass(frozen=True, kw_only=True)
class _Case:
    """Grey values of some pixels under lights of unit intensity."""

    separation: Separation
    alpha: Float[Tensor, "lights 3"]
    d: Float[Tensor, "pixels 3"]
    s: Float[Tensor, "pixels 3"]
    I: Float[Tensor, "pixels lights"]  # noqa: E741

    def residual(self, x: Float[Tensor, "*grid pixels unknowns"], a: Tensor, B: Tensor) -> Tensor:
        """Model minus picture; x is d, or d and B over its start `B`."""
        d, B = x[..., :3], B * x[..., 3] if x.shape[-1] == 4 else B
        g = in_double(replace(self.separation, materials=self.separation.materials[:1]).globals)
        first = lambda x: x.movedim(-1, 0)  # noqa: E731
        whole = first(d + self.s)
        body = diffuse(mixed(self.alpha, whole), length(g.M, whole), g)
        v = first(a + B[..., None] * (d + (1.0 - g.f) * self.s))
        return (body + lobe_of(v, g, self.alpha)).movedim(0, -1) - self.I

    def refitted(self, x: Float[Tensor, "*grid pixels unknowns"], a: Tensor, B: Tensor) -> tuple[Tensor, Tensor]:
        """`x` after Gauss-Newton from there, and the mean square misfit of every pixel and place of the grid."""

        def residual(x: Tensor) -> Tensor:
            return self.residual(x, a, B)

        damping = torch.full_like(x[..., :1], 1e-3)
        r = residual(x)
        for _ in range(STEPS):
            axes = torch.eye(x.shape[-1], dtype=x.dtype)
            J = torch.stack([torch.func.jvp(residual, (x,), (e.expand_as(x).clone(),))[1] for e in axes], -1)
            normal = J.mT @ J
            scale = normal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-9)
            step = torch.linalg.solve(normal + torch.diag_embed(damping * scale + 1e-12), J.mT @ r[..., None])[..., 0]
            trial = residual(x - step)
            better = (trial.square().sum(-1) < r.square().sum(-1))[..., None]
            x, r = torch.where(better, x - step, x), torch.where(better, trial, r)
            damping = torch.where(better, damping / 5, damping * 5).clamp(1e-8, 1e8)
        return x, r.square().mean(-1)
