"""A sweep's frames added up."""

import pytest
import torch

from reflectsep.calibrate.sweep_sum import add_frames
from reflectsep.data import Frame, Sweep
from reflectsep.errors import CaptureError


def test_sum_knows_when_the_slab_passed_and_what_is_lost():
    class Passing:
        sweep = Sweep(light="L1", frames="{}.exr", count=11, lost=frozenset({5}))

        def __len__(self):
            return 11

        def __iter__(self):
            for index in range(11):
                if index != 5:
                    values = torch.full((1, 4, 22), 0.01)
                    values[..., 2 * index : 2 * index + 2] = 1.0
                    yield Frame(index=index, values=values)

    added = add_frames(Passing())
    assert added.time[0, 0] == pytest.approx(-1.0, abs=1e-3)
    assert added.time[0, 21] == pytest.approx(1.0, abs=1e-3)
    assert added.usable[0].tolist() == [abs(i // 2 - 5) > 3 for i in range(22)]


def test_a_sweep_without_frames_is_refused():
    class Nothing:
        sweep = Sweep(light="L1", frames="{}.exr", count=1)

        def __len__(self):
            return 1

        def __iter__(self):
            return iter(())

    with pytest.raises(CaptureError, match="sweep of L1 along x: no frames"):
        add_frames(Nothing())
