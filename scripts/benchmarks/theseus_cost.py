"""The pixel's residual as Theseus takes it."""

from __future__ import annotations

import theseus as th
import torch
from torch import Tensor

from reflectsep.model import positive_power

from .problem import Case


class PixelCost(th.CostFunction):
    """One batch element a pixel; l = (d_1, d_2, d_3, log B)."""

    def __init__(self, x: th.Vector, images: th.Variable, s: th.Variable, case: Case) -> None:
        super().__init__(th.ScaleCostWeight(1.0), name="pixels")
        self.x, self.images, self.s, self.case = x, images, s, case
        self.register_optim_vars(["x"])
        self.register_aux_vars(["images", "s"])

    def _parts(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        p, lobe, x = self.case.problem, self.case.lobe, self.x.tensor
        d, B = x[:, :3], x[:, 3:].exp()
        return d @ p.alpha.T, (d + self.s.tensor) @ p.alpha.T, (lobe.a + B * d) @ p.alpha.T, B, p.light_weight.sqrt()

    def error(self) -> Tensor:
        """(pixels, lights)."""
        _, root, u, _, w = self._parts()
        return w * (root.clamp_min(0.0) + positive_power(u, self.case.lobe.n_s) - self.images.tensor)

    def jacobians(self) -> tuple[list[Tensor], Tensor]:
        """Closed form."""
        y, root, u, B, w = self._parts()
        n_s, alpha = self.case.lobe.n_s, self.case.problem.alpha
        f = n_s * positive_power(u, n_s - 1.0) * B
        by_d = (w * ((root > 0).to(f.dtype) + f))[..., None] * alpha
        return [torch.cat([by_d, (w * f * y)[..., None]], -1)], self.error()

    def dim(self) -> int:
        """Residuals of a pixel."""
        return len(self.case.problem.images)

    def _copy_impl(self, new_name: str | None = None) -> PixelCost:
        return PixelCost(self.x.copy(), self.images.copy(), self.s.copy(), self.case)


def make_objective(case: Case) -> tuple[th.Vector, th.Objective]:
    """All pixels as one batch."""
    p = case.problem
    x = th.Vector(tensor=case.start.T.contiguous(), name="x")
    images = th.Variable(p.images.T.contiguous(), name="images")
    s = th.Variable(p.s.T.contiguous(), name="s")
    objective = th.Objective()
    objective.add(PixelCost(x, images, s, case))
    return x, objective
