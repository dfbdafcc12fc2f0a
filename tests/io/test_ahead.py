import threading
import time
from dataclasses import replace

import pytest
import torch

from reflectsep.data import Sweep
from reflectsep.errors import CaptureError
from reflectsep.io.ahead import NO_LEAD, Lead, frames_of, in_order, lead_for, one_thread
from reflectsep.io.frames import FileFrames
from reflectsep.io.pictures import write_picture

TWO = Lead(threads=2, held=3)


def readers():
    return [thread for thread in threading.enumerate() if thread.name.startswith("reading ahead")]


def note(sweep, seen, error=None):
    """Go through a sweep and write down its frames; fail on purpose at frame 3 where an error is given."""
    with frames_of(sweep) as frames:
        for frame in frames:
            seen.append(frame.index)
            if error is not None and frame.index == 3:
                assert readers()
                raise error


@pytest.fixture
def sweep(tmp_path):
    generator = torch.Generator().manual_seed(0)
    for i in range(12):
        write_picture(tmp_path / f"{i:04d}.png", torch.rand((1, 8, 10), generator=generator), bits=16)
    return FileFrames(
        sweep=Sweep(light="L1", frames="{:04d}.png", count=12, lost=frozenset({4})),
        folder=tmp_path,
        size=(10, 8),
        channels=1,
        lead=TWO,
    )


def test_frames_are_the_same_read_ahead_or_not(sweep):
    ahead, plain = list(sweep), list(replace(sweep, lead=NO_LEAD))
    assert [frame.index for frame in ahead] == [0, 1, 2, 3, 5, 6, 7, 8, 9, 10, 11]
    for a, b in zip(ahead, plain, strict=True):
        assert a.index == b.index
        assert torch.equal(a.values, b.values)
        assert torch.equal(a.saturated, b.saturated)
    assert not readers()


@pytest.mark.parametrize("lead", [NO_LEAD, TWO])
def test_results_keep_their_order_however_long_each_takes(lead):
    def slow_at_first(i):
        time.sleep(0.02 if i % 3 == 0 else 0.0)
        return i * i

    assert list(in_order(slow_at_first, range(20), lead)) == [i * i for i in range(20)]


@pytest.mark.parametrize("lead", [NO_LEAD, TWO])
def test_damaged_frame_is_named_after_those_before_it(sweep, lead):
    path = sweep.folder / "0006.png"
    path.write_bytes(path.read_bytes()[:-20])
    seen = []
    with pytest.raises(CaptureError, match=r"0006\.png: not a readable PNG"):
        note(replace(sweep, lead=lead), seen)
    assert seen == [0, 1, 2, 3, 5]
    assert not readers()


def test_only_so_many_results_wait():
    begun, most = [], 0
    lead = Lead(threads=2, held=3)
    for taken, _ in enumerate(in_order(begun.append, range(40), lead), start=1):
        time.sleep(0.002)
        most = max(most, len(begun) - taken)
    assert 1 <= most <= lead.held


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_no_thread_goes_on_when_the_reader_is_left(sweep, error):
    with pytest.raises(error):
        note(sweep, [], error)
    assert not readers()


def test_interrupt_while_waiting_for_a_frame_leaves_no_thread():
    def make(i):
        if i == 2:
            raise KeyboardInterrupt
        return i

    with pytest.raises(KeyboardInterrupt):
        list(in_order(make, range(9), TWO))
    assert not readers()


def test_large_frames_are_held_one_at_a_time(monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1, 2, 3, 4, 5}, raising=False)
    assert lead_for(10**6) == Lead(threads=4, held=8)
    assert lead_for(10**9) == Lead(threads=1, held=1)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0}, raising=False)
    assert lead_for(10**6) == NO_LEAD


def test_torch_has_its_threads_back():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with one_thread():
            assert torch.get_num_threads() == 1
        with pytest.raises(ZeroDivisionError), one_thread():
            _ = 1 / 0
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
