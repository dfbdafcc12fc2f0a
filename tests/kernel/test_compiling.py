from __future__ import annotations

import threading
import time

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.kernel import compiling
from reflectsep.kernel.compiling import LEAST_PART, WORTH_COMPILING, Speed, side_by_side
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


def test_a_compiler_that_fails_is_as_good_as_none_and_says_why_once(scene, monkeypatch, capsys):
    def broken(function, form):
        raise RuntimeError(
            "CppCompileError: C++ compile error\n  kernel.cpp:2:10: fatal error: Python.h: no such file\n"
        )

    compiling.has_compiler.cache_clear()
    monkeypatch.setattr(compiling.shutil, "which", lambda name: "/usr/bin/g++")
    monkeypatch.setattr(compiling, "compiled", broken)
    made = scene(200, sigma=0.01)
    for _ in range(2):
        found = solve_pixels(made.problem, made.start, made.lobe, speed=Speed(compile="always"))
    compiling.has_compiler.cache_clear()
    plain = solve_pixels(made.problem, made.start, made.lobe, speed=Speed(compile="never"))
    assert torch.equal(found.local, plain.local)
    said = capsys.readouterr().err
    assert said.count("nothing can be compiled") == said.count("kernel.cpp:2:10: fatal error: Python.h") == 1


def test_small_problems_are_never_compiled(monkeypatch):
    monkeypatch.setattr(compiling, "has_compiler", lambda: True)
    like = torch.zeros(1)
    assert not Speed().compiles(64 * 64, like)
    assert Speed().compiles(WORTH_COMPILING, like)
    assert Speed(compile="always").compiles(10, like)
    assert not Speed(compile="never").compiles(1 << 30, like)


@given(st.integers(1, 3_000_000), st.integers(1, 9), st.one_of(st.none(), st.integers(LEAST_PART, 1_000_000)))
def test_parts_cover_the_pixels_once(pixels, cores, most):
    parts = Speed(cores=cores).parts(pixels, most)
    assert [0, *(part.stop for part in parts)] == [*(part.start for part in parts), pixels]
    assert all(part.stop - part.start > 0 for part in parts)
    assert all(part.start % LEAST_PART == 0 for part in parts)


def test_every_core_gets_a_part_and_all_together_no_more_than_allowed():
    assert Speed(cores=2).parts(100_000) == [slice(0, 3 * LEAST_PART), slice(3 * LEAST_PART, 100_000)]
    assert Speed(cores=8).parts(100) == [slice(0, 100)]
    parts = Speed(cores=2).parts(40 * LEAST_PART, 10 * LEAST_PART)
    assert {part.stop - part.start for part in parts} == {5 * LEAST_PART}


def test_of_many_parts_no_more_than_there_are_workers_run_at_a_time():
    running, most, lock = 0, 0, threading.Lock()

    def work(part):
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        time.sleep(0.01)
        with lock:
            running -= 1
        return part.start

    assert side_by_side(work, [slice(i, i + 1) for i in range(8)], 2) == list(range(8))
    assert most == 2


def test_torch_counts_the_compilations_of_every_form_on_its_own():
    kernels = [compiling.compiled(torch.add, (float(i),)) for i in range(2)]
    one, other = (kernel._torchdynamo_orig_callable.__code__ for kernel in kernels)
    assert one is not other
    assert compiling.compiled(torch.add, (0.0,)) is kernels[0]


def test_a_failure_on_one_core_is_the_callers(monkeypatch):
    threads = torch.get_num_threads()

    def work(part):
        if part.start:
            raise ValueError("this one fails")
        return 1

    with pytest.raises(ValueError, match="this one fails"):
        side_by_side(work, [slice(0, 5), slice(5, 9)])
    assert torch.get_num_threads() == threads
