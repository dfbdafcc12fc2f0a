"""Where the slit was in each frame: the stage's reports give position over time, the camera's clock gives the time.

    x(t) = x_0 + v t         a robust line over the reports taken at constant speed
    t    = o + (1 + r) c     host time of camera time c: from clock readings, else from the arrivals of the frames

An arrival is never early, only late, and by as much as the host slept: the line through arrivals is their lower edge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from reflectsep.errors import CameraError, StageError
from reflectsep.rig.devices import ClockReading, RawFrame, StageReport

SPEED_TOLERANCE = 0.005
LEAST_REPORTS = 5
LARGEST_DRIFT = 0.002
"""Of a camera's clock against the host's; more is no clock."""


@dataclass(frozen=True, kw_only=True)
class Line:
    """y = value + slope (t - centre), with standard deviations."""

    centre: float
    value: float
    slope: float
    value_sd: float
    slope_sd: float
    rms: float

    def at(self, t: np.ndarray) -> np.ndarray:
        """The ordinate at t."""
        return self.value + self.slope * (t - self.centre)

    def sd_at(self, t: np.ndarray) -> np.ndarray:
        """Standard deviation of the ordinate at t."""
        return np.hypot(self.value_sd, self.slope_sd * (t - self.centre))


@dataclass(frozen=True, kw_only=True)
class Track:
    """A sweep's motion, as it was."""

    line: Line
    reports: int
    worst_mm: float


def robust_line(t: np.ndarray, y: np.ndarray, noise: np.ndarray | float) -> Line:
    """Line through most of the points: Theil and Sen's slope, then Tukey's weights.

    Args:
        t: Abscissae, at least two different ones.
        y: Ordinates.
        noise: Expected scatter of each, above 0.
    """
    sigma = np.broadcast_to(np.asarray(noise, dtype=float), t.shape)
    centre = float(np.mean(t))
    i, j = np.triu_indices(len(t), 1)
    far = t[j] != t[i]
    slope = float(np.median((y[j] - y[i])[far] / (t[j] - t[i])[far]))
    value = float(np.median(y - slope * (t - centre)))
    scale = sigma
    weights = np.ones_like(y)
    for _ in range(20):
        residual = (y - value - slope * (t - centre)) / scale
        spread = max(1.0, 1.4826 * float(np.median(np.abs(residual))))
        weights = np.clip(1 - (residual / (4.685 * spread)) ** 2, 0, None) ** 2 / scale**2
        slope, value = _weighted(t - centre, y, weights)
    residual = y - value - slope * (t - centre)
    used = weights > 0
    rms = float(np.sqrt(np.mean(residual[used] ** 2))) if used.any() else math.inf
    total = weights.sum()
    mean = float((weights * (t - centre)).sum() / total)
    scatter = float((weights * (t - centre - mean) ** 2).sum())
    unit = max(1.0, float(np.sqrt((weights * residual**2).sum() / max(1, used.sum() - 2))))
    slope_sd = unit / math.sqrt(scatter)
    return Line(
        centre=centre + mean,
        value=value + slope * mean,
        slope=slope,
        value_sd=unit / math.sqrt(total),
        slope_sd=slope_sd,
        rms=rms,
    )


def _weighted(t: np.ndarray, y: np.ndarray, w: np.ndarray) -> tuple[float, float]:
    total = w.sum()
    mean_t, mean_y = (w * t).sum() / total, (w * y).sum() / total
    slope = (w * (t - mean_t) * (y - mean_y)).sum() / (w * (t - mean_t) ** 2).sum()
    return float(slope), float(mean_y - slope * mean_t)


def fit_track(
    reports: Sequence[StageReport], cruise_mm: tuple[float, float], speed_mm_s: float, step_mm: float
) -> Track:
    """The line of a sweep's motion, and whether the motion was what was asked for.

    Args:
        reports: All reports of the motion.
        cruise_mm: Between these positions the speed is constant.
        speed_mm_s: As asked for.
        step_mm: Resolution of the reports.

    Raises:
        StageError: too few reports, a feed override, a speed more than 0.5 % off, or a residual beyond noise.
    """
    override = [r.override_percent for r in reports if r.override_percent is not None and r.override_percent != 100]
    if override:
        raise StageError(f"the feed override of the stage is {override[0]:g} %, expected 100 %: the sweep is void")
    low, high = sorted(cruise_mm)
    kept = [r for r in reports if low <= r.position_mm <= high]
    if len(kept) < LEAST_REPORTS:
        raise StageError(
            f"{len(kept)} position reports between {low:g} and {high:g} mm, expected {LEAST_REPORTS} or more"
        )
    t, x = np.array([r.time_s for r in kept]), np.array([r.position_mm for r in kept])
    noise = np.array([max(step_mm, 1e-4) + abs(speed_mm_s) * (0.0005 + r.uncertainty_s) for r in kept])
    line = robust_line(t, x, noise)
    if abs(line.slope / speed_mm_s - 1) > SPEED_TOLERANCE:
        raise StageError(
            f"the stage moved at {line.slope:.4f} mm/s, {speed_mm_s:g} was asked for: more than "
            f"{100 * SPEED_TOLERANCE:g} % off"
        )
    residual = np.abs(x - line.at(t))
    allowed = 6 * noise + 0.005 * abs(speed_mm_s)
    if (residual > allowed).any():
        worst = int(np.argmax(residual / allowed))
        raise StageError(
            f"at {x[worst]:g} mm the stage was {residual[worst]:.3f} mm off its line, {allowed[worst]:.3f} is noise: "
            "its motion was not uniform"
        )
    return Track(line=line, reports=len(kept), worst_mm=float(residual.max()))


def fit_clock(frames: Sequence[RawFrame], readings: Sequence[ClockReading], latency_s: float) -> Line:
    """Host time as a line of the camera's time.

    Args:
        frames: Of a sweep; those with a device time and an arrival count.
        readings: Of the camera's clock, where it can be read.
        latency_s: From the middle of an exposure to the earliest arrival, where there are no readings.

    Raises:
        CameraError: too few times, or clocks that do not run alike.
    """
    if len(readings) >= 3:
        host = np.array([r.host_time_s for r in readings])
        device = np.array([r.device_time_s for r in readings])
        noise = np.array([max(r.uncertainty_s, 1e-5) for r in readings])
        line = robust_line(device, host, noise)
    else:
        pairs = [
            (f.device_time_s, f.host_time_s)
            for f in frames
            if f.device_time_s is not None and f.host_time_s is not None
        ]
        if len(pairs) < 10:
            raise CameraError(f"{len(pairs)} frames with a time, 10 or more are needed to know the camera's clock")
        line = _lower_edge(np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs]) - latency_s)
    if abs(line.slope - 1) > LARGEST_DRIFT:
        raise CameraError(
            f"the camera's clock runs {1e6 * (line.slope - 1):+.0f} ppm off the host's, at most "
            f"{1e6 * LARGEST_DRIFT:.0f} was expected: are its times in seconds?"
        )
    return line


def _lower_edge(device: np.ndarray, arrival: np.ndarray) -> Line:
    """The line below all points that is nearest to them: the edge of their convex hull under their mean."""
    order = np.lexsort((arrival, device))
    x, y = device[order] - device[order[0]], arrival[order] - arrival[order[0]]
    # Late by what the clocks cannot explain: the hull is made on y - x, where it is flat and well scaled.
    z = y - x
    hull: list[int] = []
    for k in range(len(x)):
        while len(hull) >= 2:
            a, b = hull[-2], hull[-1]
            if (z[b] - z[a]) * (x[k] - x[a]) >= (z[k] - z[a]) * (x[b] - x[a]):
                hull.pop()
            else:
                break
        hull.append(k)
    mean = float(x.mean())
    right = next((n for n in range(1, len(hull)) if x[hull[n]] >= mean), len(hull) - 1)
    a, b = hull[right - 1], hull[right]
    drift = (z[b] - z[a]) / (x[b] - x[a]) if x[b] > x[a] else 0.0
    late = z - (z[a] + drift * (x - x[a]))
    near = float(np.quantile(late, 0.25))
    span = max(float(x[-1]), 1e-9)
    centre = float(device[order[0]]) + mean
    value = float(arrival[order[0]]) + mean + z[a] + drift * (mean - x[a])
    return Line(
        centre=centre, value=float(value), slope=1.0 + float(drift), value_sd=near, slope_sd=near / span, rms=near
    )


@dataclass(frozen=True, kw_only=True)
class Placed:
    """Slit positions of frames."""

    position_mm: np.ndarray
    sd_mm: np.ndarray
    time_s: np.ndarray
    """Host time of the middle of each exposure."""


def place(device_time_s: np.ndarray, clock: Line, track: Track, step_mm: float) -> Placed:
    """Slit position and its standard deviation in the middle of each exposure."""
    host = clock.at(device_time_s)
    position = track.line.at(host)
    clock_sd = clock.sd_at(device_time_s)
    sd = np.sqrt(track.line.sd_at(host) ** 2 + (track.line.slope * clock_sd) ** 2 + (step_mm / math.sqrt(12)) ** 2)
    return Placed(position_mm=position, sd_mm=sd, time_s=host)


def unwrap(sequences: Sequence[int], first: int, last: int | None) -> list[int]:
    """A camera's count made to go on where it wraps from `last` to `first`, starting from its first value."""
    if not sequences:
        return []
    result = [sequences[0]]
    for number in sequences[1:]:
        if last is None:
            result.append(number)
            continue
        length = last - first + 1
        # The nearest continuation of the frame before: frames may be out of order by a little.
        ahead = (number - result[-1]) % length
        result.append(result[-1] + (ahead if ahead <= length // 2 else ahead - length))
    return result
