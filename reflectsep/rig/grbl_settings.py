"""A GRBL board's version and `$` settings, read and held against the configuration; never written."""

from __future__ import annotations

from collections.abc import Mapping

from reflectsep.errors import StageError
from reflectsep.rig.axes import StageAxis
from reflectsep.rig.devices import Axis
from reflectsep.rig.grbl_protocol import GrblProtocol
from reflectsep.rig.grbl_words import parse_setting

TOLERANCE = 1e-3
"""Relative: the board prints three decimals."""


def read_settings(board: GrblProtocol) -> tuple[str, dict[int, float]]:
    """Version, and settings by number.

    Raises:
        StageError: the board does not answer, or tells no version.
    """
    version = [line for line in board.command("$I") if line.startswith("[VER:")]
    if not version:
        raise StageError(f"{board.port}: does not tell its version")
    pairs = [pair for line in board.command("$$") if (pair := parse_setting(line)) is not None]
    return version[0].strip("[]"), dict(pairs)


def check_settings(settings: Mapping[int, float], axes: Mapping[Axis, StageAxis], port: str) -> None:
    """The controller's own numbers against the configured ones.

    Raises:
        StageError: it reports inches or work positions, or steps, speed, acceleration or travel differ.
    """
    if int(settings.get(10, 1)) & 1 == 0 or settings.get(13, 0) != 0:
        raise StageError(f"{port}: must report machine positions in mm: expected an odd $10, and $13=0")
    for axis in axes.values():
        index = "XYZ".index(axis.letter)
        where = f"{port}: axis {axis.letter}"
        steps, speed, acceleration, travel = (settings.get(100 + index + 10 * row, float("nan")) for row in range(4))
        _match(where, f"${100 + index}", steps, axis.steps_per_mm, "steps_per_mm")
        _match(where, f"${120 + index}", acceleration, axis.acceleration_mm_s2, "acceleration_mm_s2")
        if not speed / 60.0 >= axis.max_speed_mm_s * (1 - 1e-6):
            raise StageError(
                f"{where}: ${110 + index}={speed:g} mm/min is {speed / 60:g} mm/s, less than "
                f"max_speed_mm_s={axis.max_speed_mm_s:g}"
            )
        low, high = axis.travel_mm
        if settings.get(20) == 1 and not (-travel - 1e-6 <= low and high <= 1e-6):
            raise StageError(f"{where}: soft limits allow {-travel:g} to 0 mm, but travel_mm=[{low:g},{high:g}]")


def _match(where: str, number: str, found: float, expected: float, name: str) -> None:
    if not abs(found - expected) <= TOLERANCE * expected:
        raise StageError(f"{where}: {number}={found:g}, but the configuration says {name}={expected:g}")
