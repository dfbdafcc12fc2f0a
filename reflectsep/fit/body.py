"""The whole diffuse root before anything is known of the lobe, and what it says of scattering in shadow.

Robust least squares of b in I = pos(A b)^n_d over all pictures of a pixel: highlights and cast shadows are outliers,
attached shadows are clamped inside the formula. b is a start value and a guide, never a result.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.kernel.linear import factorise, solve
from reflectsep.model import signed_root
from reflectsep.room import by_rows

AT_ONCE = 1 << 12
"""Pixels whose maps stay in the cache."""
LIT_FRACTION = 0.4
"""A basis light counts as fully lighting a patch where b_k exceeds this share of the largest of the three."""


def robust_body(
    images: Float[Tensor, "pixels channels lights"],
    weight: Float[Tensor, "pixels channels lights"],
    alpha: Float[Tensor, "lights 3"],
    n_d: float,
    *,
    iterations: int = 25,
) -> Float[Tensor, "pixels channels 3"]:
    """Signed whole diffuse root of the basis lights.

    `weight` is 1 / standard deviation of every value. Values above the model are highlights and count less than
    values below it, which are noise or cast shadows.
    """

    def of(cut: slice) -> Tensor:
        return _robust_body(images[cut], weight[cut], alpha, n_d, iterations)

    return by_rows(len(images), AT_ONCE, of)


def _robust_body(images: Tensor, weight: Tensor, alpha: Tensor, n_d: float, iterations: int) -> Tensor:
    # As maps (lights, channels, pixels), value by value: three unknowns are too few for matrices.
    root, weight = (values.permute(2, 1, 0).contiguous() for values in (signed_root(images, n_d), weight))
    relative = (weight / weight.amax(0).clamp_min(1e-30)).clamp_min(1e-6).square()
    lit = 3.0 / weight.clamp_min(1e-30)
    b = solve_weighted(root, relative, alpha)
    for _ in range(iterations):
        mixed = alpha[:, 0, None, None] * b[0] + alpha[:, 1, None, None] * b[1] + alpha[:, 2, None, None] * b[2]
        residual = root - mixed.clamp_min(0.0)
        # In units of noise; the root's derivative is near 1 wherever n_d is.
        size = residual * weight
        trust = torch.where(size > 0, 1.5 / size.clamp_min(1.5), 4.0 / (-size).clamp_min(4.0))
        # A light behind the horizon has nothing to say unless the picture is lit.
        active = (mixed > 0) | (root > lit)
        b = 0.5 * b + 0.5 * solve_weighted(root, relative * trust * active, alpha)
    return b.permute(2, 1, 0).contiguous()


def solve_weighted(
    root: Float[Tensor, "lights channels pixels"], weight: Tensor, alpha: Float[Tensor, "lights 3"]
) -> Float[Tensor, "3 channels pixels"]:
    """argmin_b sum_j weight_j (root_j - A_j b)^2, with a trace of a ridge."""
    upper = [(i, j) for i in range(3) for j in range(i, 3)]
    system, right = [torch.zeros_like(root[0]) for _ in upper], [torch.zeros_like(root[0]) for _ in range(3)]
    for A, w, value in zip(alpha.tolist(), weight, root, strict=True):
        for entry, (i, j) in zip(system, upper, strict=True):
            entry.add_(w, alpha=A[i] * A[j])
        weighted = w * value
        for entry, A_k in zip(right, A, strict=True):
            entry.add_(weighted, alpha=A_k)
    largest = torch.maximum(torch.maximum(system[0], system[3]), system[5]).clamp_min(1e-12)
    return torch.stack(solve(factorise(system, [1e-6 * largest] * 3), right))


def extend_into_shadow(
    s_basis: Float[Tensor, "pixels channels 3"], body: Float[Tensor, "pixels channels 3"]
) -> Float[Tensor, "pixels channels 3"]:
    """Signed scattering root: as measured where the patch is lit, going on in proportion to `body` beyond the edge.

    What a shadowed patch scatters is measured but is no linear function of the light, so mixing it by alpha would
    light the shadow under every other light. Beyond the edge the signed root keeps the share of scattered light that
    the patch shows under the lights that do reach it.
    """
    lit = body.clamp_min(0.0)
    share = (s_basis * lit).sum(-1, keepdim=True) / lit.square().sum(-1, keepdim=True).clamp_min(1e-12)
    brightest = body.amax(-1, keepdim=True).clamp_min(1e-9)
    weight = (body / (LIT_FRACTION * brightest)).clamp(0.0, 1.0)
    return weight * s_basis + (1.0 - weight) * share.clamp(0.0, 1.0) * body
