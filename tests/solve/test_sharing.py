"""Chunks shared among processes: the same numbers as alone, and no process that waits for a dead one."""

import json
import os
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.errors import SaidElsewhereError, WorkerError
from reflectsep.solve.sharing import ALIGNED, SHARES, by_chunks, by_items, by_turns, cuts_of, shared_work, workers

WORKER = """
import json, os, sys
import torch
from reflectsep.errors import FitError, ReflectsepError
from reflectsep.solve.sharing import by_chunks, by_items, shared_work, workers

def work(cut):
    assert workers().count == 1  # what is nested is not shared again
    values = torch.arange(cut.start, cut.stop, dtype=torch.float64).sin()
    return torch.stack([values, values.square()], 1), values > 0, values.sum()[None]

with shared_work() as crew:
    seen = []
    def watched(cut):
        seen.append(cut.start)
        return work(cut)
    pairs, positive, sums = by_chunks(23, 4, watched)
    torch.save({"pairs": pairs, "positive": positive, "sums": sums, "seen": torch.tensor(seen)}, sys.argv[1])
    print(json.dumps(by_items(5, lambda i: (0.1 + i, f"item {i}\\n", None))))
    few = by_chunks(3, 4, watched)
    assert len(few[0]) == 3
    if sys.argv[2] == "die" and crew.rank == 1:
        os._exit(9)
    try:
        if sys.argv[2] == "raise":
            raise FitError("no pixel")
        by_chunks(23, 4, work)
    except ReflectsepError as error:
        print(type(error).__name__, error)
        raise
"""


def run_two(folder: Path, what: str) -> list[subprocess.CompletedProcess[str]]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    running = []
    for rank in range(2):
        environment = os.environ | {
            "RANK": str(rank),
            "WORLD_SIZE": "2",
            "MASTER_ADDR": "127.0.0.1",
            "MASTER_PORT": str(port),
            "OMP_NUM_THREADS": "1",
        }
        words = [sys.executable, "-c", WORKER, str(folder / f"{rank}.pt"), what]
        running.append(
            subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        )
    ended = []
    for process in running:
        out, err = process.communicate(timeout=60)
        ended.append(subprocess.CompletedProcess(process.args, process.returncode, out, err))
    return ended


def work(cut):
    values = torch.arange(cut.start, cut.stop, dtype=torch.float64).sin()
    return torch.stack([values, values.square()], 1), values > 0, values.sum()[None]


def test_alone_chunks_are_joined_in_order():
    pairs, positive, sums = by_chunks(23, 4, work)
    everything = torch.arange(23, dtype=torch.float64).sin()
    assert torch.equal(pairs[:, 0], everything)
    assert torch.equal(positive, everything > 0)
    torch.testing.assert_close(sums, torch.stack([part.sum() for part in everything.split(3)]))


def test_parts_that_are_no_block_each_are_joined_whatever_their_length():
    def some(cut):
        return torch.ones(3, 2) * cut.start, torch.arange(float(cut.start), float(cut.stop))

    threes, blocks = by_chunks(12, 4, some)  # a chunk is four: one of four and one of eight
    assert torch.equal(threes[:, 0], torch.tensor([cut.start for cut in cuts_of(12, 4) for _ in range(3)]).float())
    assert torch.equal(blocks, torch.arange(12.0))


@given(st.integers(1, 200_000), st.integers(1, 5000))
def test_cuts_cover_the_blocks_and_leave_no_process_waiting(count, chunk):
    cuts = cuts_of(count, chunk)
    assert [0, *(cut.stop for cut in cuts)] == [*(cut.start for cut in cuts), count]
    lengths = {cut.stop - cut.start for cut in cuts[:-1]}
    assert len(lengths) <= 1
    assert all(0 < cut.stop - cut.start <= chunk for cut in cuts)
    if len(cuts) > 1 and count >= SHARES * ALIGNED:
        assert len(cuts) >= SHARES - 1
        # The two halves of the chunks, in turn, are alike to two chunks at most.
        own = [sum(cut.stop - cut.start for cut in cuts[rank::2]) for rank in (0, 1)]
        assert abs(own[0] - own[1]) <= max(lengths) + max(lengths) - (cuts[-1].stop - cuts[-1].start)


def test_a_few_chunks_too_many_become_even_ones():
    assert [cut.stop - cut.start for cut in cuts_of(8923, 4096)] == [2240, 2240, 2240, 2203]
    assert cuts_of(4096, 4096) == [slice(0, 4096)]
    assert [cut.stop for cut in cuts_of(5, 1)] == [1, 2, 3, 4, 5]


def test_items_alone_are_what_work_gives():
    assert by_items(3, lambda i: {"i": i}) == [{"i": 0}, {"i": 1}, {"i": 2}]
    assert by_items(0, lambda i: i) == []


def test_items_side_by_side_keep_their_order_and_one_thread_each():
    meeting = threading.Barrier(2, timeout=20.0)

    def work(i):
        meeting.wait()  # which only two that are under way at once get past
        return i, torch.get_num_threads()

    assert by_items(4, work, at_once=2) == [(0, 1), (1, 1), (2, 1), (3, 1)]


def test_an_item_that_fails_side_by_side_is_not_lost():
    def work(i):
        if i == 2:
            raise ValueError("item 2")

    with pytest.raises(ValueError, match="item 2"):
        by_items(4, work, at_once=2)


def test_without_other_processes_nothing_is_shared():
    with shared_work({"WORLD_SIZE": "1"}) as crew:
        assert crew.count == 1
        assert crew.first
    with shared_work({}):
        assert workers().first


def test_two_processes_give_every_bit_of_one_and_each_does_its_part(tmp_path):
    ended = run_two(tmp_path, "share")
    assert [process.returncode for process in ended] == [0, 0], ended[0].stderr + ended[1].stderr
    found = [torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(2)]
    for name, alone in zip(("pairs", "positive", "sums"), by_chunks(23, 4, work), strict=True):
        for result in found:
            assert torch.equal(result[name], alone)
            assert result[name].dtype == alone.dtype
    assert found[0]["seen"].tolist() == [0, 6, 12, 18]
    assert found[1]["seen"].tolist() == [3, 9, 15, 21]
    for process in ended:
        assert json.loads(process.stdout) == [[0.1 + i, f"item {i}\n", None] for i in range(5)]


def test_a_process_that_dies_is_an_error_of_the_other(tmp_path):
    survivor, dead = run_two(tmp_path, "die")
    assert dead.returncode == 9
    assert survivor.returncode != 0
    said = survivor.stdout.splitlines()[1:]  # after the items
    assert len(said) == 1
    assert said[0].startswith(f"{WorkerError.__name__} another process of this run is gone")


def test_an_error_of_all_is_said_by_one(tmp_path):
    ended = run_two(tmp_path, "raise")
    assert all(process.returncode != 0 for process in ended)
    quiet = [SaidElsewhereError.__name__ in process.stderr for process in ended]
    assert sorted(quiet) == [False, True]


TURNS = """
import sys
import torch
from reflectsep.solve.sharing import by_turns, shared_work, workers

def work(i):
    assert workers().count == 1  # what is nested is not shared again
    made.append(i)
    values = torch.arange(i + 1.0, dtype=torch.float64).sin()
    return {"a": values, "flags": values > 0, "n": torch.tensor(i), "none": torch.empty(0, i), "T": torch.rand(2, 3).T}

with shared_work() as crew:
    made = []
    torch.manual_seed(crew.rank)
    found = by_turns(5, work)
    torch.save({"found": found, "made": made}, sys.argv[1])
    by_turns(1, work)
    if sys.argv[2] == "die" and crew.rank == 1:
        import os
        os._exit(9)
    try:
        by_turns(3, work)
    except Exception as error:
        print(type(error).__name__, error)
        raise
"""


def test_large_items_come_from_the_process_whose_turn_it_is(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "WORKER", TURNS)
    ended = run_two(tmp_path, "go on")
    assert [process.returncode for process in ended] == [0, 0], [process.stderr for process in ended]
    first, second = (torch.load(tmp_path / f"{rank}.pt") for rank in range(2))
    assert (first["made"], second["made"]) == ([0, 2, 4], [1, 3])
    for i, (one, two) in enumerate(zip(first["found"], second["found"], strict=True)):
        assert list(one) == list(two) == ["a", "flags", "n", "none", "T"]
        for name in one:
            assert torch.equal(one[name], two[name])
            assert one[name].dtype == two[name].dtype
        assert torch.equal(one["a"], torch.arange(i + 1.0, dtype=torch.float64).sin())
        assert torch.equal(one["flags"], one["a"] > 0)
        assert (int(one["n"]), one["none"].shape, one["T"].shape) == (i, (0, i), (3, 2))


def test_a_process_that_dies_at_its_turn_is_an_error_of_the_other(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "WORKER", TURNS)
    first, second = run_two(tmp_path, "die")
    assert second.returncode == 9
    assert first.returncode != 0
    assert first.stdout.startswith("WorkerError another process of this run is gone or does not answer")


def test_alone_items_are_all_its_own():
    assert [each["n"] for each in by_turns(3, lambda i: {"n": i})] == [0, 1, 2]
