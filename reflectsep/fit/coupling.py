"""How every pixel's unknowns hang on the shared ones, put together from its parts as in `fit/normal.py`.

K_cj are the pictures' weighted slopes by a shared unknown g:

    of d_c with g    sum_j w P'_cj K_cj A_j + B / C b,       b = sum_cj w F'_j K_cj A_j
    of s_c with g    sum_j w P'_cj K_cj A_j
    of log B with g  z . b
"""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from reflectsep.fit.derivatives import alpha_columns, body_slopes, lobe_slopes
from reflectsep.fit.normal import Rows, Unknowns, last, lobe_rows, put_together, rows_of, shape_row_of, unknowns
from reflectsep.fit.problem import (
    ALPHA,
    GGX,
    LOG_C_2,
    LOG_N_D,
    LOG_N_S,
    SOFTNESS,
    Observations,
    Priors,
    refined,
    unpack,
    unpack_globals,
)
from reflectsep.solve.problem import Coupled


def coupled_equations(
    local: Tensor, shared: Tensor, obs: Observations, priors: Priors, robust: float | None
) -> Coupled:
    """`normal_equations` of every pixel, with the shared unknowns beside its own."""
    stated, obs = obs, refined(obs, shared)
    x = unknowns(local, obs)
    rows = rows_of(x, shared, obs, robust)
    K = slopes(local, x, rows, shared, (stated, obs))
    lobe, shape = lobe_rows(x, shared, priors), shape_row_of(x, shared, obs, priors)
    _, gradient, V = put_together(x, rows, obs.alpha, priors, (lobe, shape))

    A, three = obs.alpha, 3 * obs.channels
    root, b = A.T @ (rows.w * rows.p * K), A.T @ (rows.w * rows.f * K).sum(1)
    b[LOG_C_2] += lobe.z_with_crest
    W = x.d.new_empty(len(local.T), len(shared), len(local))
    W[:three] = (root + (x.B / obs.channels * b)[:, None]).flatten(1, 2).transpose(0, 1)
    W[three] = (x.z * b).sum(1)
    if x.s_free:
        W[three + 1 :] = root.flatten(1, 2).transpose(0, 1)
    W[:three, LOG_C_2] -= (shape.weight * shape.by_d).expand(obs.channels, -1, -1).flatten(0, 1)
    W[three, LOG_C_2] -= shape.weight**2

    flat, weighted = K.flatten(1), (rows.w * K).flatten(1)
    H, own = weighted @ flat.T, weighted @ rows.r.flatten()
    H[LOG_C_2, LOG_C_2] += len(local) * shape.weight**2 + lobe.of_crest_twice.sum()
    own[LOG_C_2] += lobe.by_crest.sum() - shape.weight * shape.row.sum()
    return Coupled(gradient, V, W, own, H)


def slopes(
    local: Tensor, x: Unknowns, rows: Rows, shared: Tensor, obs: tuple[Observations, Observations]
) -> Float[Tensor, "G channels lights pixels"]:
    """The pictures' rows by the shared unknowns; `obs` as stated and as the refined alphas have them."""
    stated, mixed = obs
    g = unpack_globals(shared, mixed.n_d)
    shine, body = lobe_slopes(rows.u, g), body_slopes(rows.root, rows.width, g.n_d)
    K = x.d.new_zeros(len(shared), *rows.r.shape)
    K[:3] = rows.f * mixed.alpha.T[:, None, :, None]
    K[LOG_N_S] = rows.pull * shine.by_log_n_s
    if bool(shared[GGX] > 0):
        K[LOG_C_2] = rows.pull * shine.by_log_crest
    K[SOFTNESS] = rows.pull * body.by_width * x.s_measured.mean(1, keepdim=True).clamp_min(0.0)
    if mixed.n_d is None:
        K[LOG_N_D] = rows.pull * body.by_log_n_d
    if len(shared) > ALPHA:
        first = lambda values: values.movedim(-1, 0)  # noqa: E731
        of_body = type(body)(*(first(part) for part in (body.by_root, body.by_width, body.by_log_n_d)))
        of_lobe = type(shine)(*(first(part) for part in (shine.by_u, shine.by_log_n_s, shine.by_log_crest)))
        columns = local.new_zeros(*first(rows.r).shape, len(shared))
        known = first(rows.pull), first(rows.root), of_body, of_lobe
        alpha_columns(columns, unpack(local, mixed.channels), shared, stated, mixed, known)
        K[ALPHA:] = last(columns)[..., ALPHA:, :].movedim(-2, 0)
    return K
