"""Both passes over the sweeps, shared among the processes of a run: each goes through sweeps of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from reflectsep.data import FrameStream
from reflectsep.scatter.evidence import Mask, Picture
from reflectsep.scatter.passage import Passage
from reflectsep.scatter.width import Kept
from reflectsep.solve.sharing import by_turns

NUMBERS = {
    "first": torch.int64,
    "last": torch.int64,
    "received": torch.int64,
    "noise": torch.float64,
    "dark": torch.float64,
}


def watched(streams: Sequence[FrameStream], watch: Callable[[int], Passage]) -> list[Passage]:
    """What the first pass over every sweep found; `watch` goes over one of them.

    Raises:
        WorkerError: another process of the run is gone.
    """
    found = by_turns(len(streams), lambda i: tensors_of(watch(i)))
    return [passage_of(stream, tensors) for stream, tensors in zip(streams, found, strict=True)]


def tensors_of(passage: Passage) -> dict[str, Tensor]:
    """A passage without its sweep; `passage_of` takes it back."""
    values = {f.name: getattr(passage, f.name) for f in fields(passage) if f.name not in ("sweep", "kept")}
    tensors = {name: torch.tensor(v, dtype=NUMBERS[name]) if name in NUMBERS else v for name, v in values.items()}
    return tensors | {f"kept.{f.name}": getattr(passage.kept, f.name) for f in fields(passage.kept)}


def passage_of(stream: FrameStream, tensors: dict[str, Tensor]) -> Passage:
    """What `tensors_of` was given."""
    kept = {name.removeprefix("kept."): value for name, value in tensors.items() if name.startswith("kept.")}
    values: dict[str, Any] = {name: value for name, value in tensors.items() if not name.startswith("kept.")}
    values |= {name: tensors[name].item() for name in NUMBERS}
    return Passage(sweep=stream.sweep, kept=Kept(**kept), **values)


def summed(
    clipped: Sequence[Mask], root_sum: Callable[[int], tuple[Picture, Picture]]
) -> list[tuple[Picture, Picture]]:
    """Roots and their deviations by all sweeps; `root_sum` makes one, and tells `clipped` what is clipped elsewhere.

    Raises:
        WorkerError: another process of the run is gone.
    """

    def one(i: int) -> dict[str, Tensor]:
        found, deviation = root_sum(i)
        return {"sum": found, "deviation": deviation, "clipped": clipped[i]}

    found = by_turns(len(clipped), one)
    for mask, each in zip(clipped, found, strict=True):
        mask |= each["clipped"]  # noqa: PLW2901  (in its place)
    return [(each["sum"], each["deviation"]) for each in found]
