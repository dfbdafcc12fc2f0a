"""Camera raw files through rawpy (an extra): linear, in the camera's own colours, neither balanced nor brightened."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from reflectsep.errors import CaptureError, MissingExtraError


def read_raw(
    path: Path,
) -> tuple[Float[Tensor, "3 height width"], Bool[Tensor, "3 height width"]]:
    """One raw picture: black level subtracted, demosaiced linearly, 1 at the sensor's white level.

    Returns:
        Values in the camera's R, G, B; and those that touch a clipped photosite.

    Raises:
        CaptureError: not a raw file that LibRaw can read.
        MissingExtraError: rawpy is not installed.
    """
    rawpy = _rawpy(path)
    try:
        with rawpy.imread(str(path)) as raw:
            sites = raw.raw_image_visible.copy()
            white = int(raw.white_level)
            pixels = raw.postprocess(
                demosaic_algorithm=rawpy.DemosaicAlgorithm.LINEAR,
                gamma=(1, 1),
                no_auto_bright=True,
                no_auto_scale=False,
                adjust_maximum_thr=0.0,
                output_bps=16,
                output_color=rawpy.ColorSpace.raw,
                user_wb=[1.0, 1.0, 1.0, 1.0],
                user_flip=0,
                highlight_mode=rawpy.HighlightMode.Clip,
            )
    except (rawpy.LibRawError, ValueError, MemoryError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise CaptureError(f"{path}: not a readable camera raw file: {reason}") from error
    values = torch.from_numpy((pixels / 65535.0).astype(np.float32)).permute(2, 0, 1).contiguous()
    return values, _clipped(sites, white, values)


def _clipped(sites: np.ndarray, white: int, values: Tensor) -> Tensor:
    """Values whose demosaicing touched a clipped photosite."""
    if sites.shape != tuple(values.shape[1:]):
        return values >= 1.0
    full = torch.from_numpy((sites >= white).astype(np.float32))
    near = max_pool2d(full[None, None], 3, stride=1, padding=1)[0, 0] > 0
    return near.expand(3, -1, -1).clone()


def _rawpy(path: Path) -> Any:
    try:
        import rawpy  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MissingExtraError(f"{path}: camera raw needs rawpy: pip install 'reflectsep[raw]'") from None
    return rawpy
