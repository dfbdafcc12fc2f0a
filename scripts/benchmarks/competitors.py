"""The same pixels from the same starts by other solvers, each in the way that suits it best.

Every function takes a case and returns (4, pixels); what is not installed raises `NotInstalled`.
"""

from __future__ import annotations

import ctypes
import functools
import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from reflectsep.kernel.problem import Lobe

from .problem import ITERATIONS, TOLERANCE, Case
from .yardstick import NotInstalled, constants, library, pointer


def scipy_trf(case: Case) -> Tensor:
    """Scipy's trust-region reflective solver, one pixel at a time, closed-form Jacobian."""
    try:
        from scipy.optimize import least_squares
    except ImportError:
        raise NotInstalled("scipy: pip install scipy") from None
    p, lobe = case.problem, case.lobe
    A, a = p.alpha.double().numpy(), lobe.a.double().numpy()
    root_w = p.light_weight.double().sqrt().numpy()
    images, s, start = (v.double().numpy() for v in (p.images, p.s, case.start))

    def value(x: np.ndarray, i: int) -> np.ndarray:
        u = A @ (a + math.exp(min(x[3], 30.0)) * x[:3])
        root = A @ (x[:3] + s[:, i])
        return root_w * (np.maximum(root, 0) + np.maximum(u, 0) ** lobe.n_s - images[:, i])

    def slope(x: np.ndarray, i: int) -> np.ndarray:
        B, y = math.exp(min(x[3], 30.0)), A @ x[:3]
        f = lobe.n_s * np.maximum(A @ (a + B * x[:3]), 0) ** (lobe.n_s - 1) * B
        lit = (A @ (x[:3] + s[:, i]) > 0).astype(float)
        return root_w[:, None] * np.column_stack([A * (lit + f)[:, None], f * y])

    found = np.empty_like(start)
    for i in range(start.shape[1]):
        options: dict[str, Any] = {"ftol": TOLERANCE, "xtol": 1e-10, "gtol": 1e-12, "max_nfev": 200}
        with np.errstate(over="ignore"):
            found[:, i] = least_squares(
                value,
                start[:, i],
                jac=slope,  # type: ignore[arg-type]
                args=(i,),
                x_scale="jac",
                **options,
            ).x
    return torch.from_numpy(found)


@functools.cache
def _numba_solver() -> Callable[..., None]:
    try:
        import numba  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise NotInstalled("numba: pip install numba") from None
    from .numba_solver import solve_all

    return numba.njit(fastmath=True)(solve_all)


def numba_lm(case: Case) -> Tensor:
    """The algorithm of the yardstick as scalar code, compiled by numba with fastmath."""
    p, local = case.problem, case.start.clone()
    c = constants(p, case.lobe).float().numpy()
    _numba_solver()(p.images.numpy(), p.s.numpy(), c, np.float32(TOLERANCE), ITERATIONS, local.numpy())
    return local


def theseus_lm(case: Case) -> Tensor:
    """Theseus' batched Levenberg-Marquardt with a closed-form Jacobian, adaptive damping, dense Cholesky."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            import theseus as th  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise NotInstalled("Theseus: pip install theseus-ai") from None
        from .theseus_cost import make_objective

        _, objective = make_objective(case)
        optimizer = th.LevenbergMarquardt(
            objective,
            linear_solver_cls=th.CholeskyDenseSolver,
            max_iterations=ITERATIONS,
            abs_err_tolerance=1e-12,
            rel_err_tolerance=TOLERANCE,
        )
        layer = th.TheseusLayer(optimizer)
        options = {"damping": 1e-3, "adaptive_damping": True, "ellipsoidal_damping": True, "damping_eps": 1e-9}
        with torch.no_grad():
            values, _ = layer.forward({"x": case.start.T.double().contiguous()}, optimizer_kwargs=options)
        return values["x"].detach().T


def _ceres(lights: int) -> ctypes.CDLL:
    try:
        flags = ("-O3", "-march=native", "-I/usr/include/eigen3")
        return library("ceres.cpp", lights, flags, ("-lceres", "-lglog"))
    except NotInstalled as error:
        raise NotInstalled(f"Ceres: apt-get install libceres-dev ({error})") from None


def _ceres_local(case: Case, name: str) -> Tensor:
    p, c = case.problem, constants(case.problem, case.lobe)
    images, s, local = p.images.double(), p.s.double(), case.start.T.double().contiguous()
    shared = case.lobe.shared.double()
    getattr(_ceres(len(images)), name)(
        *(ctypes.c_int64(len(p)), pointer(images), pointer(s), pointer(c), pointer(shared)),
        *(ctypes.c_double(TOLERANCE), ITERATIONS, pointer(local)),
    )
    return local.T


def ceres_lm(case: Case) -> Tensor:
    """Ceres, a problem of its own for every pixel."""
    return _ceres_local(case, "ceres_local")


def ceres_tiny(case: Case) -> Tensor:
    """Ceres' TinySolver, which is made for many small problems."""
    return _ceres_local(case, "ceres_tiny")


def ceres_joint(case: Case, local: Tensor, lobe: Lobe, tolerance: float, limit: int) -> tuple[Tensor, Lobe, int]:
    """All pixels and the globals by Ceres' dense Schur complement."""
    p, c = case.problem, constants(case.problem, lobe)
    images, s, places = p.images.double(), p.s.double(), local.T.double().contiguous()
    shared = lobe.shared.double()
    steps = _ceres(len(images)).ceres_joint(
        *(ctypes.c_int64(len(p)), pointer(images), pointer(s), pointer(c), pointer(shared)),
        *(ctypes.c_double(tolerance), limit, pointer(places)),
    )
    return places.T, lobe.moved(shared), steps
