"""Several exposures of one light: merged to one linear picture, and what they say of the camera's response.

    I = sum_i w_i I_i / sum_i w_i,     I_i = ratio_i (f(value_i) - f(dark_i)),     w_i = exposure_i, 0 where clipped

Every I_i is in the capture's units; with shot noise the variance of I_i goes as one over its exposure, so that the
weights are the best ones. Where every exposure is clipped the shortest stands, marked as clipped.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from reflectsep.errors import CaptureError, MissingExtraError

LAST = 245
"""First code of the end of an 8-bit curve, where clipped values mix in."""
NEARLY = 0.98
"""Of full scale: a value above it may be bent by the camera's shoulder, and counts as clipped in a bracket."""


def merge(
    pictures: Sequence[Float[Tensor, "channels height width"]],
    clipped: Sequence[Bool[Tensor, "channels height width"]],
    exposures_s: Sequence[float],
) -> tuple[Float[Tensor, "channels height width"], Bool[Tensor, "channels height width"]]:
    """One picture from a bracket.

    Args:
        pictures: developed, in the capture's units; NaN where a value is not finite.
        clipped: values that are at the camera's limit, or nearly.
        exposures_s: of each.

    Returns:
        The merged picture, and where every exposure is clipped.
    """
    total = torch.zeros_like(pictures[0])
    weight = torch.zeros_like(pictures[0])
    for picture, bad, exposure_s in zip(pictures, clipped, exposures_s, strict=True):
        w = torch.where(bad | ~torch.isfinite(picture), 0.0, exposure_s)
        total += w * torch.nan_to_num(picture)
        weight += w
    shortest = min(range(len(pictures)), key=lambda i: exposures_s[i])
    nothing = weight == 0
    merged = torch.where(nothing, pictures[shortest], total / weight.clamp_min(1e-30))
    every = torch.stack(list(clipped)).all(0)
    return merged, every


def estimate_response(
    codes: Sequence[UInt8[np.ndarray, "height width channels"]],
    exposures_s: Sequence[float],
    method: Literal["debevec", "robertson"] = "debevec",
) -> tuple[Float[Tensor, "256"], Float[Tensor, "256"]]:
    """The camera's response from a bracket of 8-bit pictures (OpenCV's Debevec-Malik or Robertson).

    Args:
        codes: one picture an exposure, of a scene that does not change, 1 or 3 channels.
        exposures_s: of each; three or more, over a factor of 4 at least.
        method: which of the two.

    Returns:
        Values 0 to 1 and their radiances, both rising, the last one 1: mean of the channels.

    Raises:
        CaptureError: too few exposures, or a curve that does not rise.
        MissingExtraError: OpenCV is not installed.
    """
    cv2 = _opencv()
    if len(codes) < 3 or max(exposures_s) / min(exposures_s) < 4:
        raise CaptureError(
            f"response: {len(codes)} exposures over a factor of {max(exposures_s) / min(exposures_s):.3g}; expected at "
            "least 3 over a factor of 4"
        )
    pictures = [np.ascontiguousarray(np.broadcast_to(code, (*code.shape[:2], 3))) for code in codes]
    times = np.asarray(exposures_s, dtype=np.float32)
    solver = cv2.createCalibrateDebevec(samples=400) if method == "debevec" else cv2.createCalibrateRobertson()
    curve = np.asarray(solver.process(pictures, times=times), dtype=np.float64).reshape(256, 3).mean(1)
    known = np.isfinite(curve) & (curve > 0)
    if known[10:-10].mean() < 0.5:
        raise CaptureError("response: the bracket gives no curve; expected pictures of one scene, from dark to clipped")
    curve = _rising(_ended(np.interp(np.arange(256), np.flatnonzero(known), curve[known])))
    return torch.linspace(0, 1, 256, dtype=torch.float64), torch.from_numpy(curve / curve[-1])


def fit_gamma(values: Float[Tensor, "rows"], radiances: Float[Tensor, "rows"]) -> tuple[float, float]:
    """Gamma of radiance = value^gamma, and that curve's largest error (of full scale), on the upper nine tenths."""
    use = (values > 0.1) & (values < NEARLY)
    x, y = values[use].log(), radiances[use].log()
    gamma = float(((x - x.mean()) * (y - y.mean())).sum() / (x - x.mean()).square().sum())
    scale = float((y - gamma * x).mean().exp())
    return gamma, float((scale * values[use] ** gamma - radiances[use]).abs().max())


def _ended(curve: np.ndarray) -> np.ndarray:
    """The last codes, which hold what is clipped, as the curve before them goes on (a power of the code)."""
    before = np.arange(LAST - 30, LAST)
    slope, height = np.polyfit(np.log(before), np.log(curve[before]), 1)
    ended = curve.copy()
    ended[LAST:] = np.exp(height + slope * np.log(np.arange(LAST, len(curve))))
    return ended


def _rising(curve: np.ndarray) -> np.ndarray:
    """Isotonic: noise at the ends must not make the table fall. Pools of equal values get the smallest slope."""
    blocks: list[list[float]] = []
    for value in curve:
        blocks.append([float(value), 1.0])
        while len(blocks) > 1 and blocks[-2][0] >= blocks[-1][0]:
            value_, count = blocks.pop()
            last = blocks[-1]
            last[0] = (last[0] * last[1] + value_ * count) / (last[1] + count)
            last[1] += count
    flat = np.concatenate([np.full(int(count), value) for value, count in blocks])
    return flat + np.arange(len(flat)) * 1e-9 * max(1e-12, float(flat[-1]))


def _opencv() -> Any:
    try:
        import cv2  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MissingExtraError("response: needs OpenCV: pip install 'reflectsep[response]'") from None
    return cv2
