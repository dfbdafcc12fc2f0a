"""Motion of a simulated board as pieces of constant acceleration: its exact position at any moment, past ones too."""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass

Point = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Piece:
    """A stretch of a straight way from `start_s` on; the last piece of a trace has no end."""

    start_s: float
    origin: Point
    direction: Point
    """Unit vector."""
    speed: float
    acceleration: float

    def at(self, time_s: float) -> Point:
        """Position."""
        dt = time_s - self.start_s
        way = self.speed * dt + 0.5 * self.acceleration * dt * dt
        x, y, z = (o + d * way for o, d in zip(self.origin, self.direction, strict=True))
        return (x, y, z)

    def speed_at(self, time_s: float) -> float:
        """Along the direction."""
        return self.speed + self.acceleration * (time_s - self.start_s)


class Trace:
    """Where the carriage was, and will be if nothing intervenes."""

    def __init__(self, start_s: float = 0.0, position: Point = (0.0, 0.0, 0.0)) -> None:
        self.pieces = [_rest(start_s, position)]

    @property
    def end_s(self) -> float:
        """When it comes to rest."""
        return self.pieces[-1].start_s

    def at(self, time_s: float) -> Point:
        """Position at a moment."""
        return self._piece(time_s).at(time_s)

    def speed_at(self, time_s: float) -> float:
        """Speed at a moment."""
        return self._piece(time_s).speed_at(time_s)

    def move(self, start_s: float, target: Point, speed: float, acceleration: float) -> None:
        """Append a motion from rest to rest."""
        origin = self.at(start_s)
        way = math.dist(origin, target)
        if way < 1e-12:
            return
        direction = tuple((t - o) / way for o, t in zip(origin, target, strict=True))
        peak = min(speed, math.sqrt(acceleration * way))
        ramp_s, ramp = peak / acceleration, peak**2 / (2 * acceleration)
        cruise_s = (way - 2 * ramp) / peak
        times = (start_s, start_s + ramp_s, start_s + ramp_s + cruise_s)
        ways = (0.0, ramp, way - ramp)
        speeds, accelerations = (0.0, peak, peak), (acceleration, 0.0, -acceleration)
        for time_s, gone, v, a in zip(times, ways, speeds, accelerations, strict=True):
            x, y, z = (o + d * gone for o, d in zip(origin, direction, strict=True))
            self.pieces.append(
                Piece(start_s=time_s, origin=(x, y, z), direction=direction, speed=v, acceleration=a)  # type: ignore[arg-type]
            )
        self.pieces.append(_rest(times[2] + ramp_s, target))

    def stop(self, time_s: float, deceleration: float) -> None:
        """Forget what was to come after `time_s` and decelerate to rest."""
        piece = self._piece(time_s)
        speed, place = piece.speed_at(time_s), piece.at(time_s)
        self.pieces = [p for p in self.pieces if p.start_s <= time_s]
        if speed <= 0:
            self.pieces.append(_rest(time_s, place))
            return
        braking = Piece(
            start_s=time_s, origin=place, direction=piece.direction, speed=speed, acceleration=-deceleration
        )
        end_s = time_s + speed / deceleration
        self.pieces += [braking, _rest(end_s, braking.at(end_s))]

    def jump(self, time_s: float, position: Point) -> None:
        """Be elsewhere from `time_s` on: a position that was redefined."""
        self.pieces = [p for p in self.pieces if p.start_s <= time_s]
        self.pieces.append(_rest(time_s, position))

    def _piece(self, time_s: float) -> Piece:
        index = bisect.bisect_right(self.pieces, time_s, key=lambda piece: piece.start_s)
        return self.pieces[max(0, index - 1)]


def _rest(start_s: float, place: Point) -> Piece:
    return Piece(start_s=start_s, origin=place, direction=(1.0, 0.0, 0.0), speed=0.0, acceleration=0.0)
