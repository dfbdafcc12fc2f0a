"""A least-squares problem of many small blocks that share a few parameters.

Block p (a pixel) has its own unknowns l_p and all blocks share g:

    cost(l, g) = sum_p sum_m rho_m( r_pm(l_p, g) )  +  1/2 |q(g)|^2

r is written by the caller for a whole batch of blocks at once. Its derivatives come from forward-mode automatic
differentiation: blocks do not see each other, so one tangent per unknown, laid over the whole batch, gives a full
column of every block's Jacobian. A caller may supply a closed form instead.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.func import jvp, vmap

Residual = Callable[..., Tensor]
Jacobians = Callable[..., tuple[Tensor, Tensor, Tensor | None]]


@dataclass(frozen=True)
class Coupled:
    """Normal equations of blocks and shared parameters together."""

    gradient: Float[Tensor, "P blocks"]
    V: Float[Tensor, "P P blocks"]
    """In its lower triangle at least."""
    W: Float[Tensor, "P G blocks"]
    shared_gradient: Float[Tensor, "G"]
    """Summed over the blocks, as is H."""
    H: Float[Tensor, "G G"]


@dataclass(frozen=True, kw_only=True)
class BlockProblem:
    """Residuals of all blocks, with the data that each block needs."""

    residual: Residual
    """(local (blocks, P), shared (G,), *data) -> (blocks, M), whitened."""
    data: tuple[Tensor, ...]
    """Per-block constants, each (blocks, ...)."""
    threshold: Float[Tensor, "residuals"] | None = None
    """Huber threshold of every residual, in units of the residual; inf is plain least squares. None: all plain."""
    shared_residual: Callable[[Tensor], Tensor] | None = None
    """q: residuals of the shared parameters alone, (G,) -> (R,)."""
    jacobian: Jacobians | None = None
    """Closed form: (local, shared, *data, with_shared=bool) -> r (blocks, M), dr/dl (blocks, M, P), and dr/dg
    (blocks, M, G) if asked for, else None."""
    normal: Callable[..., tuple[Tensor, Tensor, Tensor]] | None = None
    """Closed form of `normal_equations`, where forming J would be a waste: (local, shared, *data) -> the same."""
    coupled: Callable[..., Coupled] | None = None
    """Closed form of `coupled_equations`, likewise."""
    held: Callable[..., Any] | None = None
    """A solver of its own for blocks under shared parameters that are held: (local, shared, termination, *data) to the
    `LocalSolution` that `solve_local` finds."""
    device: torch.device | None = None
    """Where blocks that are taken from it are worked on; None: where they are."""

    def __len__(self) -> int:
        """Number of blocks."""
        return len(self.data[0])

    def take(self, index: Int[Tensor, "some"] | slice) -> BlockProblem:
        """The same problem on some of the blocks."""
        data = tuple(d[index] for d in self.data)
        if self.device is None:
            return replace(self, data=data)
        threshold = None if self.threshold is None else self.threshold.to(self.device)
        return replace(self, data=tuple(d.to(self.device) for d in data), threshold=threshold)

    def chunk(self, index: Int[Tensor, "some"] | slice, local: Tensor, *shared: Tensor) -> tuple[Any, ...]:
        """Some of the blocks, with their own and with shared parameters beside them where they are worked on."""
        part = self.take(index)
        there = part.data[0].device
        return part, local.to(there), *(each.to(there) for each in shared)

    def residuals(self, local: Tensor, shared: Tensor) -> Tensor:
        """r, (blocks, M)."""
        return self.residual(local, shared, *self.data)

    def costs(self, local: Tensor, shared: Tensor) -> Float[Tensor, "blocks"]:
        """Cost of every block."""
        return robust_cost(self.residuals(local, shared), self.threshold)

    def shared_cost(self, shared: Tensor) -> Tensor:
        """1/2 |q|^2."""
        if self.shared_residual is None:
            return shared.new_zeros(())
        return 0.5 * self.shared_residual(shared).square().sum()

    def linearise(self, local: Tensor, shared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """R and its derivatives by l and by g at (local, shared)."""
        if self.jacobian is not None:
            r, J, K = self.jacobian(local, shared, *self.data, with_shared=True)
            assert K is not None  # it was asked for
            return r, J, K
        return forward_jacobian(self.residual, local, shared, self.data)

    def linearise_local(self, local: Tensor, shared: Tensor) -> tuple[Tensor, Tensor]:
        """R and its derivative by l alone."""
        if self.jacobian is not None:
            r, J, _ = self.jacobian(local, shared, *self.data, with_shared=False)
            return r, J
        return local_jacobian(self.residual, local, shared, self.data)

    def normal_equations(
        self, local: Tensor, shared: Tensor
    ) -> tuple[Float[Tensor, "blocks"], Float[Tensor, "P blocks"], Float[Tensor, "P P blocks"]]:
        """Robust cost, J^T w r and J^T w J of every block, shared parameters held; V in its lower triangle at least.

        Blocks come last: an entry of all matrices is one line, so that work on them goes by whole vectors.
        """
        if self.normal is not None:
            return self.normal(local, shared, *self.data)
        r, J = self.linearise_local(local, shared)
        V, gradient = normal_equations(r, J, robust_weight(r, self.threshold))
        return robust_cost(r, self.threshold), gradient.T.contiguous(), V.permute(1, 2, 0).contiguous()

    def coupled_equations(self, local: Tensor, shared: Tensor) -> Coupled:
        """The same with the shared parameters free."""
        if self.coupled is not None:
            return self.coupled(local, shared, *self.data)
        r, J, K = self.linearise(local, shared)
        weight = robust_weight(r, self.threshold)
        V, gradient = normal_equations(r, J, weight)
        weighted = K * weight[..., None]
        return Coupled(
            gradient=gradient.T.contiguous(),
            V=V.permute(1, 2, 0).contiguous(),
            W=(J.mT @ weighted).permute(1, 2, 0).contiguous(),
            shared_gradient=torch.einsum("nmg,nm->g", weighted, r),
            H=torch.einsum("nmg,nmh->gh", weighted, K),
        )


def normal_equations(r: Tensor, J: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """J^T w J and J^T w r."""
    weighted = J * weight[..., None]
    return weighted.mT @ J, (weighted.mT @ r[..., None])[..., 0]


def local_jacobian(
    residual: Residual, local: Tensor, shared: Tensor, data: tuple[Tensor, ...]
) -> tuple[Tensor, Tensor]:
    """R (blocks, M) and dr/dl (blocks, M, P) alone: with eight shared parameters, half the work or less."""
    basis = torch.eye(local.shape[-1], dtype=local.dtype, device=local.device)

    def column(tangent: Tensor) -> tuple[Tensor, Tensor]:
        step = tangent.expand_as(local).contiguous()
        result = jvp(lambda x: residual(x, shared, *data), (local,), (step,))
        return result[0], result[1]

    values, columns = vmap(column, out_dims=(0, -1))(basis)
    return values[0], columns


def forward_jacobian(
    residual: Residual, local: Tensor, shared: Tensor, data: tuple[Tensor, ...]
) -> tuple[Tensor, Tensor, Tensor]:
    """R (blocks, M), dr/dl (blocks, M, P) and dr/dg (blocks, M, G), by forward mode over the whole batch."""
    P, G = local.shape[-1], shared.shape[-1]
    basis = torch.eye(P + G, dtype=local.dtype, device=local.device)

    def column(tangent: Tensor) -> tuple[Tensor, Tensor]:
        result = jvp(
            lambda x, g: residual(x, g, *data),
            (local, shared),
            (tangent[:P].expand_as(local).contiguous(), tangent[P:].contiguous()),
        )
        return result[0], result[1]

    values, columns = vmap(column, out_dims=(0, -1))(basis)
    return values[0], columns[..., :P], columns[..., P:]


def robust_cost(r: Float[Tensor, "blocks residuals"], threshold: Tensor | None) -> Float[Tensor, "blocks"]:
    """Sum over residuals of r^2 / 2 within the threshold and of t (|r| - t / 2) beyond it (Huber)."""
    if threshold is None:
        return 0.5 * r.square().sum(-1)
    size = r.abs()
    linear = threshold * size - 0.5 * threshold * torch.where(threshold.isfinite(), threshold, 0.0)
    return torch.where(size <= threshold, 0.5 * r.square(), linear).nan_to_num(nan=torch.inf, posinf=torch.inf).sum(-1)


def robust_weight(r: Float[Tensor, "blocks residuals"], threshold: Tensor | None) -> Tensor:
    """rho'(r) / r: the weight of every residual in the Gauss-Newton system."""
    if threshold is None:
        return torch.ones_like(r)
    return (threshold / r.abs().clamp_min(torch.finfo(r.dtype).tiny)).clamp_max(1.0)
