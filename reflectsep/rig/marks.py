"""A camera's clock from what its frames show: the light of a sweep goes on before the motion and off after it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from reflectsep.errors import CameraError
from reflectsep.rig.sync import LARGEST_DRIFT, Line

LEAST_JUMP = 4.0
"""Of the brightness at a switch, over its scatter before and after."""


@dataclass(frozen=True, kw_only=True)
class Switched:
    """When the light went on and off by the session's clock."""

    on_s: float
    off_s: float


def clock_of_marks(times_s: np.ndarray, levels: np.ndarray, switched: Switched) -> Line:
    """Session time as a line of the camera's time, from the first rise and the last fall of the frames' brightness.

    Args:
        times_s: Of the frames by the camera's clock, rising.
        levels: Mean value of each frame.
        switched: When the light was switched.

    Raises:
        CameraError: the frames do not show it, or the clocks do not agree on how long it was on.
    """
    dark = float(np.median(np.concatenate([levels[:3], levels[-3:]])))
    scatter = max(1e-6, float(np.ptp(np.concatenate([levels[:3], levels[-3:]]))))
    lit = np.flatnonzero(levels > dark + LEAST_JUMP * scatter)
    if len(times_s) < 8 or not len(lit) or lit[0] == 0 or lit[-1] == len(levels) - 1:
        raise CameraError(
            "the frames do not show the light going on before the motion and off after it: the camera must record "
            "from before the shot to after it, and see something of the light at both ends of the sweep"
        )
    on_s = float(times_s[lit[0] - 1] + times_s[lit[0]]) / 2
    off_s = float(times_s[lit[-1]] + times_s[lit[-1] + 1]) / 2
    slope = (switched.off_s - switched.on_s) / (off_s - on_s)
    period = float(np.median(np.diff(times_s)))
    allowed = LARGEST_DRIFT + 2 * period / (off_s - on_s)
    if abs(slope - 1) > allowed:
        raise CameraError(
            f"the light was on for {switched.off_s - switched.on_s:.3f} s, but for {off_s - on_s:.3f} s in the frames"
        )
    each = period / math.sqrt(12)
    centre = (on_s + off_s) / 2
    value = (switched.on_s + switched.off_s) / 2
    # Over one sweep a clock drifts less than the two ends can tell.
    return Line(centre=centre, value=value, slope=1.0, value_sd=each / math.sqrt(2), slope_sd=2e-5, rms=each)
