"""The pixel's residual as Theseus takes it, in double precision: in single one wild pixel ends the whole batch."""

from __future__ import annotations

import theseus as th  # pyright: ignore[reportMissingImports]
import torch
from torch import Tensor

from reflectsep.model import positive_power

from .problem import Case


class PixelCost(th.CostFunction):
    """One batch element a pixel; l = (d_1, d_2, d_3, log B)."""

    def __init__(self, x: th.Vector, images: th.Variable, s: th.Variable, case: Case) -> None:
        super().__init__(th.ScaleCostWeight(torch.ones(1, 1, dtype=torch.float64)), name="pixels")
        self.x, self.images, self.s, self.case = x, images, s, case
        self.register_optim_vars(["x"])
        self.register_aux_vars(["images", "s"])

    def _parts(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        d, B, mix = (
            self.x.tensor[:, :3],
            self.x.tensor[:, 3:].clamp(-7.0, 7.0).exp(),
            self.case.problem.alpha.double().T,
        )
        u = (self.case.lobe.a.double() + B * d) @ mix
        return d @ mix, (d + self.s.tensor) @ mix, u, B, self.case.problem.light_weight.double().sqrt()

    def error(self) -> Tensor:
        """(pixels, lights)."""
        _, root, u, _, w = self._parts()
        return w * (root.clamp_min(0.0) + positive_power(u, self.case.lobe.n_s) - self.images.tensor)

    def jacobians(self) -> tuple[list[Tensor], Tensor]:
        """Closed form."""
        y, root, u, B, w = self._parts()
        n_s, alpha = self.case.lobe.n_s, self.case.problem.alpha.double()
        f = n_s * positive_power(u, n_s - 1.0) * B
        by_d = (w * ((root > 0).to(f.dtype) + f))[..., None] * alpha
        return [torch.cat([by_d, (w * f * y)[..., None]], -1)], self.error()

    def dim(self) -> int:
        """Residuals of a pixel."""
        return len(self.case.problem.images)

    def _copy_impl(self, new_name: str | None = None) -> PixelCost:  # noqa: ARG002  (its interface)
        return PixelCost(self.x.copy(), self.images.copy(), self.s.copy(), self.case)


def make_objective(case: Case) -> tuple[th.Vector, th.Objective]:
    """All pixels as one batch."""
    p = case.problem
    x = th.Vector(tensor=case.start.T.double().contiguous(), name="x")
    images = th.Variable(p.images.T.double().contiguous(), name="images")
    s = th.Variable(p.s.T.double().contiguous(), name="s")
    objective = th.Objective(dtype=torch.float64)
    objective.add(PixelCost(x, images, s, case))
    return x, objective
