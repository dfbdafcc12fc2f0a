"""The whole diffuse root before anything is known of the lobe, and what it says of scattering in shadow.

Robust least squares of b in I = pos(A b)^n_d over all pictures of a pixel: highlights and cast shadows are outliers,
attached shadows are clamped inside the formula. b is a start value and a guide, never a result.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.fit.chunks import in_chunks
from reflectsep.model import signed_root

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

    return in_chunks(len(images), of)


def _robust_body(images: Tensor, weight: Tensor, alpha: Tensor, n_d: float, iterations: int) -> Tensor:
    root = signed_root(images, n_d)
    ridge = 1e-6 * torch.eye(3, dtype=images.dtype)
    relative = (weight / weight.amax(-1, keepdim=True).clamp_min(1e-30)).clamp_min(1e-6)
    b = solve_weighted(root, relative.square(), alpha, ridge)
    for _ in range(iterations):
        mixed = b @ alpha.mT
        residual = root - mixed.clamp_min(0.0)
        # In units of noise; the root's derivative is near 1 wherever n_d is.
        size = residual * weight
        trust = torch.where(size > 0, 1.5 / size.clamp_min(1.5), 4.0 / (-size).clamp_min(4.0))
        # A light behind the horizon has nothing to say unless the picture is lit.
        active = ((mixed > 0) | (root > 3.0 / weight.clamp_min(1e-30))).to(root.dtype)
        b = 0.5 * b + 0.5 * solve_weighted(root, relative.square() * trust * active, alpha, ridge)
    return b


def solve_weighted(
    root: Float[Tensor, "pixels channels lights"], weight: Tensor, alpha: Float[Tensor, "lights 3"], ridge: Tensor
) -> Float[Tensor, "pixels channels 3"]:
    """argmin_b sum_j weight_j (root_j - A_j b)^2, with a trace of a ridge."""
    normal = torch.einsum("pcl,li,lj->pcij", weight, alpha, alpha)
    normal = normal + ridge * normal.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(1e-12)[..., None, None]
    right = torch.einsum("pcl,li,pcl->pci", weight, alpha, root)
    return torch.linalg.solve(normal, right[..., None])[..., 0]


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
