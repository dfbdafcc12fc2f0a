"""The second pass over a sweep: what every hole filling works from.

The sum of the frames is known from the first pass where n_d is 1, and is taken here where it is not; from it come off
the frames that are no scattering alone, and in their place comes what the filling says of them. So only the pixels that
the slab is near are looked at in a frame.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.data import FrameStream
from reflectsep.progress import Progress
from reflectsep.room import empty
from reflectsep.scatter.band import LitBand
from reflectsep.scatter.frames import Step, signed_root, steps
from reflectsep.scatter.passage import CACHED, tiles
from reflectsep.scatter.windows import Profiles, View, Windows

Picture = Float[Tensor, "channels height width"]
Mask = Bool[Tensor, "height width"]


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """A sweep ready for its second pass."""

    stream: FrameStream
    full: Float[Tensor, "channels height width"]
    mask: Bool[Tensor, "height width"]
    band: LitBand
    n_d: float
    reach: int
    clipped_elsewhere: Bool[Tensor, "height width"]
    """Pixels saturated in a frame that does not light them; written while the frames pass."""
    progress: Progress

    def walk(self, visit: Callable[[Step, Picture, Mask], None]) -> None:
        """Call `visit(step, root, hole)` for every frame; a full pass over the files."""
        with closing(self._steps()) as walked:
            for step in walked:
                visit(step, signed_root(step.values, self.n_d), self.band.hole(step))

    def gather(self, wanted: Callable[[Profiles], Float[Tensor, "channels P"]]) -> tuple[Picture, Picture]:
        """`wanted(profiles)` of the object's pixels as a picture, and the root sum of the frames; nothing elsewhere.

        A full pass over the files; the pixels come in parts, each as soon as its windows are complete.
        """
        result = empty(*self.full.shape, dtype=self.full.dtype).zero_().flatten(1)
        total = self.band.passage.total
        places: list[tuple[slice, ...]] = []
        if self.n_d != 1.0:
            total, places = torch.zeros_like(self.full), [(slice(None), *place) for place in tiles(self.mask, CACHED)]

        def visit(step: Step) -> None:
            for place in places:
                total[place] += signed_root(step.values[place], self.n_d)

        with closing(self._profiles(visit)) as parts:
            for profiles in parts:
                result[:, profiles.at] = wanted(profiles).to(result)
        return result.view_as(self.full), total.mul_(self.mask)

    def _profiles(self, visit: Callable[[Step], None]) -> Generator[Profiles, None, None]:
        windows = Windows(
            View(
                full=self.full,
                mask=self.mask,
                band=self.band,
                n_d=self.n_d,
                reach=self.reach,
            )
        )
        with closing(self._steps()) as walked:
            for step in walked:
                visit(step)
                yield from windows.add(step)
        yield from windows.rest()

    def _steps(self) -> Generator[Step, None, None]:
        name = f"sweep {self.stream.sweep.light} {self.stream.sweep.direction}: scattering"
        with closing(steps(self.stream, self.full, self.mask)) as walked:
            for step in walked:
                if step.saturated is not None:
                    self.clipped_elsewhere.logical_or_(step.saturated.any(0) & ~self.band.hole(step))
                yield step
                self.progress(name, step.index + 1, len(self.stream))
