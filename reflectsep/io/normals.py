"""Known normals of a photometric data set: DiLiGenT's `Normal_gt.mat`, through SciPy (an extra)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.errors import CaptureError, MissingExtraError

VARIABLE = "Normal_gt"


def read_normals(
    path: Path | str,
) -> tuple[Float[Tensor, "3 height width"], Bool[Tensor, "height width"]]:
    """Normals of a MATLAB file with one array (height, width, 3): x right, y up, z to the camera.

    Returns:
        Unit normals, float32, zero where there is none; and where there is one.

    Raises:
        CaptureError: missing, no MATLAB file (version 4 to 7.2), no such array, or not one normal in it.
        MissingExtraError: SciPy is not installed.
    """
    path = Path(path)
    try:
        from scipy.io import loadmat
    except ImportError:
        raise MissingExtraError(f"{path}: reading MATLAB files needs SciPy: pip install 'reflectsep[matlab]'") from None
    if not path.is_file():
        raise CaptureError(f"{path}: no such file")
    try:
        variables = loadmat(str(path), variable_names=[VARIABLE])
    except Exception as error:
        # SciPy raises half a dozen kinds for a damaged file, some of them plain TypeError or struct.error.
        reason = " ".join(str(error).split()) or type(error).__name__
        raise CaptureError(f"{path}: not a readable MATLAB file: {reason}") from error
    if VARIABLE not in variables:
        raise CaptureError(f"{path}: no array {VARIABLE} in it")
    array = np.asarray(variables[VARIABLE])
    if array.ndim != 3 or array.shape[2] != 3 or not np.issubdtype(array.dtype, np.number):
        raise CaptureError(f"{path}: {VARIABLE} is {array.dtype} of shape {array.shape}, expected (height, width, 3)")
    normals = torch.from_numpy(np.ascontiguousarray(array, dtype=np.float64)).permute(2, 0, 1)
    length = normals.norm(dim=0)
    there = torch.isfinite(length) & (length > 0.5)
    if not bool(there.any()):
        raise CaptureError(f"{path}: not one normal in {VARIABLE}")
    unit = torch.where(there, normals / length.clamp_min(1e-12), 0.0)
    return unit.float().contiguous(), there
