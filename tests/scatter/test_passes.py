"""The two passes over a sweep: what they keep, and that it is the same however they go about it."""

import os
import subprocess
import sys
from dataclasses import replace

import pytest
import torch

from reflectsep.errors import SweepError
from reflectsep.progress import silent
from reflectsep.scatter import ScatterOptions, measure_scattering
from reflectsep.scatter import passage as passage_module
from reflectsep.scatter import spread as spread_module
from reflectsep.scatter import windows as windows_module
from reflectsep.scatter.band import LitBand
from reflectsep.scatter.evidence import Evidence
from reflectsep.scatter.passage import tiles, watch
from reflectsep.scatter.windows import Profiles


@pytest.fixture
def swept(body):
    b = body(channels=2)
    return b.stack(), [b.stream(k) for k in range(3)]


def test_tiles_cover_the_object_once_and_leave_the_rest():
    mask = torch.zeros(37, 50, dtype=torch.bool)
    mask[5:30, 11:41] = torch.rand(25, 30, generator=torch.Generator().manual_seed(0)) > 0.3
    count = torch.zeros(37, 50, dtype=torch.int32)
    for place in tiles(mask, 120):
        assert count[place].numel() <= 120
        count[place] += 1
    assert bool((count[mask] == 1).all())
    assert int(count.max()) == 1
    assert not count[:, :11].any()
    assert not count[30:].any()


@pytest.mark.parametrize(
    ("module", "name", "value"),
    [
        (passage_module, "TOGETHER", 1),
        (passage_module, "CACHED", 60),
        (windows_module, "TOGETHER", 1),
        (spread_module, "ROWS_AT_ONCE", 60),
    ],
)
def test_result_is_the_same_in_other_portions(swept, monkeypatch, module, name, value):
    stack, streams = swept
    expected = measure_scattering(stack, streams)
    monkeypatch.setattr(module, name, value)
    found = measure_scattering(stack, streams)
    # A pixel whose lit interval ends with a frame, to the last digit, may take that frame or the next.
    torch.testing.assert_close(found.root, expected.root, rtol=5e-3, atol=2e-6)
    assert float((found.root - expected.root).abs().mean() / expected.root.mean()) < 1e-4
    assert torch.equal(found.flags, expected.flags)


def test_passage_is_that_of_plain_sums_in_double_precision(body):
    b = body()
    stack, stream = b.stack(), b.stream(0)
    full, mask = stack.images[0], stack.mask
    found = watch(
        stream,
        full,
        mask,
        exponents=torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64),
        samples=mask.expand(1, -1, -1),
        progress=silent,
    )
    frames = torch.stack(stream.frames).double()
    grey = full.double().mean(0)
    q = (frames.mean(1) / grey).clamp(min=0.0)[:, mask]
    participation = (q**4).sum(0) ** 2 / (q**8).sum(0)
    torch.testing.assert_close(found.peak[mask].double(), q.amax(0), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(found.lit_frames[mask].double(), participation, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(found.total[:, mask].double(), frames.sum(0)[:, mask], rtol=1e-5, atol=1e-6)
    for row, n in zip(found.sums, (0.5, 1.0, 2.0), strict=True):
        expected = (frames[:, 0, mask].sign() * frames[:, 0, mask].abs() ** (1 / n)).sum(0)
        torch.testing.assert_close(row, expected, rtol=1e-5, atol=1e-6)


def test_windows_hold_each_pixels_own_frames(body):
    b = body()
    stack, stream = b.stack(), b.stream(0, lost=[9])
    seen = torch.zeros(stack.mask.numel(), dtype=torch.int32)
    frames = torch.stack(stream.frames)[:, 0].flatten(1)

    def look(p: Profiles) -> torch.Tensor:
        seen[p.at] += 1
        index = (p.offset + evidence.band.passage.centre.flatten()[p.at]).round().long()
        assert bool((p.offset[len(p.offset) // 2].abs() <= 0.5).all())
        received = (index >= 0) & (index < len(frames)) & (index != 9)
        assert torch.equal(p.present, received)
        expected = frames[index.clamp(0, len(frames) - 1), p.at]
        assert torch.equal(p.root[:, 0][received], expected[received])
        return torch.zeros_like(p.root[0])

    evidence = _evidence(stack, stream)
    evidence.gather(look)
    assert torch.equal(seen.view_as(stack.mask) == 1, stack.mask)


@pytest.mark.parametrize("n_d", [1.0, 1.4])
def test_root_sum_of_all_frames(body, n_d):
    b = body()
    stack, stream = b.stack(), b.stream(0)
    _, found = _evidence(stack, stream, n_d).gather(lambda p: torch.zeros_like(p.root[0]))
    expected = sum(values.sign() * values.abs() ** (1 / n_d) for values in stream.frames) * stack.mask
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_both_passes_are_closed_when_they_fail(swept):
    stack, streams = swept
    closed = []

    class Watched:
        sweep = streams[0].sweep

        def __len__(self):
            return len(streams[0])

        def __iter__(self):
            try:
                for frame in streams[0]:
                    values = frame.values.clone()
                    if frame.index == 11:
                        values[0, 12, 12] = torch.nan
                    yield replace(frame, values=values)
            finally:
                closed.append(True)

    with pytest.raises(SweepError, match="frame 11"):
        measure_scattering(stack, [Watched(), *streams[1:]])
    assert closed == [True]


def test_two_passes_and_no_more(swept):
    stack, streams = swept
    measure_scattering(stack, streams)
    assert [len(stream.passes) for stream in streams] == [2, 2, 2]
    measure_scattering(stack, streams, options=ScatterOptions(n_d=1.3))
    assert [len(stream.passes) for stream in streams] == [4, 4, 4]


MEMORY = """
import sys
import torch
from reflectsep.data import Frame, PhotometricStack, Sweep
from reflectsep.scatter import measure_scattering
count, height, width = int(sys.argv[1]), 300, 400
step = width / count
x = torch.arange(width)
mask = torch.zeros(height, width, dtype=torch.bool)
mask[20:-20, 20:-20] = True
def frame(i):
    away = (x - (i + 0.5) * step).abs()
    line = 0.35 * (away <= step) + 0.12 * torch.exp(-away / 15)
    return (line * mask)[None]
class Stream:
    def __init__(self, name):
        self.sweep = Sweep(light=name, count=count)
    def __len__(self):
        return count
    def __iter__(self):
        return (Frame(index=i, values=frame(i)) for i in range(count))
full = sum(frame(i) for i in range(count)) / 2
images = full.expand(3, 1, height, width).contiguous()
stack = PhotometricStack(
    names=("L1", "L2", "L3"), images=images, mask=mask, saturated=torch.zeros_like(images, dtype=torch.bool),
    flags=torch.zeros(mask.shape, dtype=torch.int32), alpha=torch.eye(3), view=torch.tensor([0.0, 0.0, 1.0]))
measure_scattering(stack, [Stream(name) for name in stack.names])
for line in open("/proc/self/status"):
    if line.startswith("VmHWM"):
        print(int(line.split()[1]) / 1024)
"""


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_memory_does_not_grow_with_the_number_of_frames():
    def peak_mib(frames):
        # The allocator gives back at once what is free, so that the peak is that of what is kept.
        strict = {**os.environ, "MALLOC_ARENA_MAX": "1", "MALLOC_MMAP_THRESHOLD_": "65536"}
        command = [sys.executable, "-c", MEMORY, str(frames)]
        run = subprocess.run(command, capture_output=True, text=True, check=True, env=strict)
        return float(run.stdout)

    # 150 more frames of 0.46 MiB, were they kept: 69 MiB, in any form at least a quarter of it.
    assert peak_mib(200) - peak_mib(50) < 12.0


def _evidence(stack, stream, n_d=1.0):
    passage = watch(
        stream,
        stack.images[0],
        stack.mask,
        exponents=torch.tensor([n_d], dtype=torch.float64),
        samples=stack.mask.expand_as(stack.images[0]),
        progress=silent,
    )
    band = LitBand(
        passage=passage,
        half=1.3,
        edge=0.5,
        lit=stack.mask,
        doubtful=torch.zeros_like(stack.mask),
        threshold=None,
    )
    return Evidence(
        stream=stream,
        full=stack.images[0],
        mask=stack.mask,
        band=band,
        n_d=n_d,
        reach=6,
        clipped_elsewhere=torch.zeros_like(stack.mask),
        progress=silent,
    )
