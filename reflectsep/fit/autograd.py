"""Problems whose slopes come from autograd: reference of the closed forms, and the way for formulas of one's own."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd import forward_ad

from reflectsep.fit.problem import PixelProblem
from reflectsep.solve.levenberg import Normal


@dataclass(frozen=True, kw_only=True)
class DifferentiatedProblem(PixelProblem):
    """`PixelProblem` by forward-mode autograd alone; a subclass may have other `residuals`, in any unknowns."""

    def jacobian(self, local: Float[Tensor, "P pixels"], shared: Tensor) -> Float[Tensor, "rows P pixels"]:
        """Derivatives of `residuals` by the local unknowns; a pixel's rows hang on its own unknowns alone."""
        columns = []
        for axis in torch.eye(len(local), dtype=local.dtype, device=local.device):
            with forward_ad.dual_level():
                at = forward_ad.make_dual(local, axis[:, None].expand_as(local).clone())
                found = forward_ad.unpack_dual(self.residuals(at, shared))
                rows, column = found.primal, found.tangent
            columns.append(torch.zeros_like(rows) if column is None else column)
        return torch.stack(columns, 1)

    def shared_jacobian(self, local: Float[Tensor, "P pixels"], shared: Float[Tensor, "G"]) -> Tensor:
        """Derivatives of `residuals` by the shared unknowns (rows, G, pixels)."""
        columns = []
        for axis in torch.eye(len(shared), dtype=shared.dtype):
            with forward_ad.dual_level():
                found = forward_ad.unpack_dual(self.residuals(local, forward_ad.make_dual(shared, axis)))
                rows, column = found.primal, found.tangent
            columns.append(torch.zeros_like(rows) if column is None else column)
        return torch.stack(columns, 1)

    def normal(self, local: Float[Tensor, "P pixels"], shared: Float[Tensor, "G"]) -> Normal:
        """Cost, gradient and Gauss-Newton matrix of every pixel."""
        rows = self.residuals(local, shared)
        cost, weight = self.robust(rows)
        J = self.jacobian(local, shared)
        return Normal(
            cost,
            torch.einsum("rpn,rn->pn", J, weight * rows),
            torch.einsum("rpn,rn,rqn->pqn", J, weight, J),
        )


@dataclass(frozen=True, kw_only=True)
class UnknownScattering(DifferentiatedProblem):
    """The paper's harder problem: the scattering roots of the basis lights are unknowns too.

    local = (d; log B; s_11, .., s_3C)
    """

    def packed(self, d: Float[Tensor, "3 channels pixels"], log_B: Float[Tensor, "pixels"]) -> Tensor:
        """A start: half of what is diffuse is scattered."""
        s = 0.5 * d.clamp_min(0.0)
        return torch.cat([(d - s).flatten(0, 1), log_B[None], s.flatten(0, 1)])

    def unpacked(self, local: Float[Tensor, "P pixels"]) -> tuple[Tensor, Tensor]:
        """D (3, channels, pixels) and B (pixels)."""
        count = 3 * self.obs.channels
        return local[:count].unflatten(0, (3, self.obs.channels)), local[count].exp()

    def scattering(self, local: Float[Tensor, "P pixels"]) -> Float[Tensor, "3 channels pixels"]:
        """The fitted scattering roots of the basis lights."""
        return local[3 * self.obs.channels + 1 :].unflatten(0, (3, self.obs.channels))

    def residuals(self, local: Float[Tensor, "P pixels"], shared: Float[Tensor, "G"]) -> Float[Tensor, "rows pixels"]:
        """Those of `PixelProblem` with s as the unknowns have it."""
        s = self.scattering(local)
        every = torch.tensordot(self.obs.alpha, s, 1)
        return PixelProblem.residuals(replace(self, obs=replace(self.obs, s=every)), local, shared)
