"""Exposures of one sweep that do not lie alike are found, and each is resampled once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
import torch

from reflectsep.calibrate.align_options import AlignOptions
from reflectsep.calibrate.aligned_stream import AlignedStream, after, aligned_stream
from reflectsep.calibrate.bracket_motion import bracket_motions
from reflectsep.calibrate.bracketed_sweep import BracketedStream
from reflectsep.calibrate.motion import Motion, positions, shifted
from reflectsep.data import Frame, Sweep
from reflectsep.errors import CaptureError

SIZE, COUNT, STEP_PX = 64, 30, 2.0
SHORT_S, LONG_S = 0.01, 0.16


def glow(x, y):
    """Albedo with texture, anywhere."""
    return 0.5 + 0.2 * torch.sin(0.55 * x + 0.3 * y) + 0.15 * torch.cos(0.4 * x - 0.65 * y)


@dataclass(frozen=True, kw_only=True)
class Bench:
    """A disc that scatters, lit by a slab, by a camera at `matrix`."""

    exposure_s: float
    matrix: torch.Tensor
    noise: float = 5e-4

    @property
    def sweep(self):
        return Sweep(light="L1", exposure_s=self.exposure_s, count=COUNT)

    def __len__(self):
        return COUNT

    def __iter__(self):
        x, y = positions(torch.linalg.inv(self.matrix), SIZE, SIZE)
        disc = torch.sigmoid(2.0 * (26.0 - ((x - 31.5) ** 2 + (y - 31.5) ** 2).sqrt()))
        generator = torch.Generator().manual_seed(round(1000 * self.exposure_s))
        for i in range(COUNT):
            away = (x - (4.0 + STEP_PX * i)).abs()
            light = 0.8 * ((2.5 - away) / 1.0).clamp(0, 1) + 0.05 * torch.exp(-away / 6.0)
            noise = self.noise * SHORT_S / self.exposure_s
            values = glow(x, y) * disc * light + noise * torch.randn(SIZE, SIZE, generator=generator)
            most = 1.0 * SHORT_S / self.exposure_s
            yield Frame(index=i, values=values.clamp(max=most)[None].float(), saturated=(values >= most)[None])


def bracket(shift, degrees=0.0):
    matrix = shifted(shift[0], shift[1], degrees, (31.5, 31.5))
    still = torch.eye(3, dtype=torch.float64)
    streams = (Bench(exposure_s=SHORT_S, matrix=still), Bench(exposure_s=LONG_S, matrix=matrix))
    return BracketedStream(streams=streams, where="bench"), matrix


MASK = torch.zeros(SIZE, SIZE, dtype=torch.bool)
MASK[6:58, 6:58] = True


@pytest.mark.parametrize(("shift", "degrees"), [((0.4, -0.2), 0.0), ((-1.1, 0.8), 0.5)])
def test_a_moved_exposure_is_found_though_it_clips_where_it_is_lit(shift, degrees):
    stream, true = bracket(shift, degrees)
    assert any(frame.saturated is not None and bool(frame.saturated.any()) for frame in stream.streams[1])
    (found,) = bracket_motions(stream, MASK, AlignOptions())
    assert found.applied, found.reason
    apart = positions(found.matrix, SIZE, SIZE) - positions(true, SIZE, SIZE)
    assert float(apart[:, MASK].square().sum(0).mean().sqrt()) < 0.1


def test_exposures_that_lie_alike_stay_as_they_are():
    stream, _ = bracket((0.0, 0.0))
    motions = bracket_motions(stream, MASK, AlignOptions())
    assert [m.applied for m in motions] == [False]
    assert aligned_stream(stream, Motion(), motions) is stream
    assert bracket_motions(stream.streams[0], MASK, AlignOptions()) == ()


def test_moved_exposures_are_refused_as_they_lie_and_merged_once_placed():
    stream, _ = bracket((1.0, 0.0))
    still, _ = bracket((0.0, 0.0))
    with pytest.raises(CaptureError, match=r"0\.01 and 0\.16 s differ by \d+%"):
        list(stream)
    placed = aligned_stream(stream, Motion(), bracket_motions(stream, MASK, AlignOptions()))
    apart = [(a.values - b.values)[:, MASK] for a, b in zip(placed, still, strict=True)]
    assert float(torch.cat(apart).square().mean().sqrt()) < 0.01  # of a lit value of 0.4


def test_motions_are_composed_and_frames_resampled_once():
    stream, _ = bracket((1.0, 0.0))
    turn = Motion(matrix=shifted(0.0, 0.0, 90.0, (31.5, 31.5)), velocity=(0.5, 0.0), applied=True)
    own = Motion(matrix=shifted(1.0, 0.0), applied=True)
    placed = aligned_stream(stream, turn, (own,))
    assert isinstance(placed, BracketedStream)
    first, second = placed.streams
    assert isinstance(first, AlignedStream)
    assert isinstance(second, AlignedStream)
    assert isinstance(second.stream, Bench)  # not a warp of a warp
    torch.testing.assert_close(first.motion.matrix, turn.matrix)
    for time in (-1.0, 0.0, 1.0):
        torch.testing.assert_close(second.motion.at(time), own.matrix @ turn.at(time))
    assert after(Motion(), own) is own
    assert after(turn, replace(own, applied=False)) is turn
