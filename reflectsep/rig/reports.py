"""Status reports of a simulated board: what is told in each, and what only now and then."""

from __future__ import annotations

from dataclasses import dataclass

OFFSETS_EVERY, OVERRIDES_EVERY = {True: 30, False: 10}, {True: 20, False: 10}
"""Reports from one that tells work offsets, or overrides, to the next, by whether the board is busy."""
QUIET = ("Idle", "Alarm", "Check", "Sleep")


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What a report is of."""

    state: str
    position_mm: tuple[float, ...]
    speed_mm_s: float
    room: tuple[int, int]
    """Motions and bytes that the board could still take."""
    override: int
    """Of the feed, in per cent."""


class Reports:
    """Makes reports; counts them, to tell what changes rarely only from time to time."""

    def __init__(self) -> None:
        self._until_offsets = self._until_overrides = 0

    def tell_overrides(self) -> None:
        """In the next report: they changed."""
        self._until_overrides = 0

    def line(self, seen: Seen, mask: int) -> str:
        """One report; `mask` is $10: 1 machine positions, else those of the work, 2 also the room in the buffers."""
        place = ",".join(f"{value:.3f}" for value in seen.position_mm)
        fields = [seen.state, f"{'M' if mask & 1 else 'W'}Pos:{place}"]
        if mask & 2:
            fields.append(f"Bf:{seen.room[0]},{seen.room[1]}")
        fields.append(f"FS:{60 * seen.speed_mm_s:.0f},0")
        fields += self._now_and_then(seen)
        return f"<{'|'.join(fields)}>"

    def _now_and_then(self, seen: Seen) -> list[str]:
        """Offsets in the first report, overrides in the second."""
        busy, said = seen.state not in QUIET, []
        if self._until_offsets > 0:
            self._until_offsets -= 1
        else:
            self._until_offsets = OFFSETS_EVERY[busy] - 1
            self._until_overrides = max(1, self._until_overrides)
            said.append("WCO:0.000,0.000,0.000")
        if self._until_overrides > 0:
            self._until_overrides -= 1
        else:
            self._until_overrides = OVERRIDES_EVERY[busy] - 1
            said.append(f"Ov:{seen.override},100,100")
        return said
