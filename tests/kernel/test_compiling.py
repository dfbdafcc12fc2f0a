from __future__ import annotations

import pytest
import torch

from reflectsep.kernel import compiling
from reflectsep.kernel.compiling import WORTH_COMPILING, Speed, side_by_side
from reflectsep.kernel.local import solve_pixels


@pytest.fixture
def no_compiler(monkeypatch):
    compiling.has_compiler.cache_clear()
    monkeypatch.setattr(compiling.shutil, "which", lambda name: None)
    yield
    compiling.has_compiler.cache_clear()


def test_without_a_compiler_everything_runs_and_says_so_once(scene, no_compiler, capsys):
    made = scene(200, sigma=0.01)
    for _ in range(2):
        found = solve_pixels(made.problem, made.start, made.lobe, speed=Speed(compile="always"))
    plain = solve_pixels(made.problem, made.start, made.lobe, speed=Speed(compile="never"))
    assert torch.equal(found.local, plain.local)
    assert capsys.readouterr().err.count("no C++ compiler") == 1


def test_small_problems_are_never_compiled(monkeypatch):
    monkeypatch.setattr(compiling, "has_compiler", lambda: True)
    like = torch.zeros(1)
    assert not Speed().compiles(64 * 64, like)
    assert Speed().compiles(WORTH_COMPILING, like)
    assert Speed(compile="always").compiles(10, like)
    assert not Speed(compile="never").compiles(1 << 30, like)


def test_parts_cover_the_pixels_once():
    parts = Speed(cores=3).parts(100_000)
    assert len(parts) == 3
    assert [i for part in parts for i in (part.start, part.stop)] == [0, 33333, 33333, 66666, 66666, 100_000]
    assert Speed(cores=8).parts(100) == [slice(0, 100)]


def test_a_failure_on_one_core_is_the_callers(monkeypatch):
    threads = torch.get_num_threads()

    def work(part):
        if part.start:
            raise ValueError("this one fails")
        return 1

    with pytest.raises(ValueError, match="this one fails"):
        side_by_side(work, [slice(0, 5), slice(5, 9)])
    assert torch.get_num_threads() == threads
