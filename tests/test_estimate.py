"""The time left of a run: by a scripted clock, by stages of runs that were timed, and by a real fit."""

import itertools
import time
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.config import FitJob, ObjectSettings, SimulateJob
from reflectsep.estimate import TRUST, Part, Steps, TimeLeft, words
from reflectsep.fit.options import FitOptions
from reflectsep.pipeline import run_fit, run_simulate
from reflectsep.workload import Counts, reading, reporting, solving


class Clock:
    def __init__(self):
        self.at_s = 0.0

    def __call__(self):
        return self.at_s


def parts(*seconds, steps: Steps = "limit"):
    return [Part(name=f"part {'abcdef'[i]}", label="x", expected_s=s, steps=steps) for i, s in enumerate(seconds)]


def test_before_the_first_report_it_is_what_was_expected():
    clock = Clock()
    left = TimeLeft(clock)
    assert left.left_s() is None
    left.expect(parts(10.0, 30.0))
    assert left.left_s() == pytest.approx(40.0)
    clock.at_s = 4.0
    assert left.left_s() == pytest.approx(36.0)


def test_a_machine_of_half_the_speed_is_found_out():
    clock = Clock()
    left = TimeLeft(clock)
    left.expect(parts(100.0, 100.0, 100.0))
    clock.at_s = 200.0
    left("part a", 1, 1)
    trust = TRUST * 300.0  # stands against the 100 s that took 200
    assert left.left_s() == pytest.approx(200.0 * (200 + trust) / (100 + trust))


def test_even_steps_tell_the_time_left_of_their_part():
    clock = Clock()
    left = TimeLeft(clock)
    left.expect([*parts(10.0, steps="even"), Part(name="solve", label="y", expected_s=50.0)])
    left("part a", 0, 100)
    clock.at_s = 20.0
    left("part a", 25, 100)
    trust = TRUST * 60.0  # stands against a quarter of the 10 s, which took 20
    assert left.left_s() == pytest.approx(60.0 + 50.0 * (20 + trust) / (2.5 + trust))


def test_an_iteration_may_end_early_but_not_late():
    clock = Clock()
    left = TimeLeft(clock)
    left.expect(parts(100.0))
    clock.at_s = 40.0
    left("part a", 10, 20)
    assert left.left_s() == pytest.approx(40.0)  # not 60: the other ten steps are the most that can come
    clock.at_s = 45.0
    left("part a", 20, 20)
    assert left.left_s() is None


def test_parts_that_are_left_out_are_not_waited_for():
    clock = Clock()
    left = TimeLeft(clock)
    left.expect(parts(10.0, 1000.0, 10.0))
    clock.at_s = 10.0
    left("part a", 1, 1)
    left("part c", 0, 1)
    assert left.left_s() == pytest.approx(10.0)


def test_a_stage_says_how_many_rounds_it_has():
    left = TimeLeft(Clock())
    left.expect([Part(name="round", label="round", expected_s=10.0)] * 6 + parts(5.0))
    left("round 1 of 3", 0, 1)
    assert [part.name for part in left.ahead] == ["round", "round", "part a"]
    left("round 1 of 3", 1, 1)
    left("round 2 of 3", 0, 1)
    assert len(left.ahead) == 2


def test_a_name_that_begins_alike_is_another_stage():
    left = TimeLeft(Clock())
    left.expect([Part(name=name, label=name, expected_s=1.0) for name in ("alignment", "alignment L1 x")])
    left("alignment", 1, 1)
    assert left("alignment L1 x", 1, 2).name == "alignment L1 x"
    assert left.ahead == ()


@given(st.lists(st.floats(0.1, 1e3), min_size=1, max_size=6), st.floats(0.1, 10))
def test_a_run_that_goes_as_expected_is_told_exactly(seconds, slowness):
    """Whatever the parts are, as long as the machine's speed is the expected one; and it is never negative."""
    clock = Clock()
    left = TimeLeft(clock)
    left.expect(parts(*seconds))
    for i, part in enumerate(parts(*seconds)):
        left(part.name, 0, 1)
        assert left.left_s() == pytest.approx(sum(seconds[i:]), rel=1e-6)
        clock.at_s += seconds[i]
        left(part.name, 1, 1)
    clock, left = Clock(), TimeLeft(clock)
    left.expect(parts(*seconds))
    for i, part in enumerate(parts(*seconds)):
        left(part.name, 0, 1)
        clock.at_s += slowness * seconds[i]
        assert (left.left_s() or 0.0) >= 0.0
        left(part.name, 1, 1)


def within_two(seen, *, skip_s=0.0):
    """Share of (time, estimate) pairs, weighed alike over the run's time, that are right within a factor of two."""
    end_s = seen[-1][0]
    good = total = 0.0
    for (at_s, said), (next_s, _) in itertools.pairwise(seen):
        true = end_s - at_s
        if said is None or true <= skip_s:
            continue
        total += next_s - at_s
        good += (next_s - at_s) * (0.5 <= said / true <= 2.0)
    return good / total


# Fits as they were timed, at various loads: counts, sweeps and their frames, seconds of the alignment, of both passes
# over the sweeps, and of the stages that follow.
RUNS = {
    "grey, 96 x 96": (
        Counts(size=9216, pixels=5211, lights=6, channels=1),
        (3, 44),
        (5.5, 0.1, 0.2),
        [4.2, 3.3, 1.4, 1.0, 1.5, 1.2, 0.7, 0.8, 0.5, 0.4, 10.3],
    ),
    "photographs": (
        Counts(size=174080, pixels=36528, lights=8, channels=3),
        (0, 0),
        (15.7, 0, 0),
        [11.1, 14.5, 11.7, 18.9, 11.7, 6.4, 5.9, 5.1, 4.8, 4.9, 19.2],
    ),
    "colour, 512 x 512, on a busy machine": (
        Counts(size=262144, pixels=143007, lights=6, channels=3),
        (3, 60),
        (47.5, 5.1, 8.2),
        [18.8, 9.6, 125.2, 65.6, 112.8, 51.7, 45.2, 68.5, 28.6, 21.6, 56.2],
    ),
}


@pytest.mark.parametrize("slowness", [1.0, 0.3, 3.0])
@pytest.mark.parametrize("name", RUNS)
def test_runs_that_were_timed_are_told_within_a_factor_of_two(name, slowness):
    counts, (sweeps, frames), (alignment_s, passages_s, scattering_s), took = RUNS[name]
    lights = [f"L{i + 1}" for i in range(sweeps)]
    capture: Any = SimpleNamespace(
        names=lights, sweeps=[SimpleNamespace(light=name, direction="x", count=frames) for name in lights]
    )
    names = ["globals", "globals", "pixels", "joint fit"]
    names += ["shadow edges", "neighbourhood 1 of 2", "neighbourhood 2 of 2"] if sweeps else []
    rounds = len(took) - len(names) - 1
    names += [f"smooth lobes {i + 1} of {rounds}" for i in range(rounds)] + ["report"]
    before = [("alignment", 0.9 * alignment_s)]
    before += [(f"alignment {light} x", 0.1 * alignment_s / sweeps) for light in lights] + [("pictures", 0.5)]
    before += [(f"sweep {light} x: passage", passages_s / sweeps) for light in lights]
    before += [(f"sweep {light} x: scattering", scattering_s / sweeps) for light in lights]
    clock = Clock()
    left = TimeLeft(clock)
    ahead = reading(capture, counts, aligned=True, swept=sweeps > 0)
    left.expect([*ahead, *solving(counts, FitOptions(), swept=sweeps > 0), *reporting(counts, sweeps)])
    seen = []
    for stage, seconds in [*before, *zip(names, took, strict=True)]:
        even = (stage, seconds) in before or stage == "globals"
        for step in range(20):
            # An iteration is said to have twenty steps at most and converges after seven.
            left(stage, step if even else step * 7 // 20, 20)
            seen.append((clock.at_s, left.left_s()))
            clock.at_s += slowness * seconds / 20
        left(stage, 20, 20)
        seen.append((clock.at_s, left.left_s()))
    begun_s = 0.1 * clock.at_s if slowness != 1.0 else 0.0  # another machine's speed shows as the run goes
    share = within_two([pair for pair in seen if pair[0] >= begun_s])
    print(f"{name}, slowness {slowness:g}: within a factor of two for {100 * share:.0f} % of the time")
    assert share >= (0.95 if slowness == 1.0 else 0.75)


@pytest.mark.slow
def test_time_left_of_a_real_fit(tmp_path):
    """By processor time, since other work on the machine is none of the estimate's.

    The last tenth of it is not asked about: what is left then is within a second.
    """
    # Threads that wait for each other are processor time, too, on a busy machine three times that of the work.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    run_simulate(SimulateJob(object=ObjectSettings(name="wax", size_px=96), out=str(tmp_path / "capture")))
    left, seen, began_s = TimeLeft(time.process_time), [], time.process_time()

    class Watch:
        def expect(self, ahead):
            left.expect(ahead)

        def __call__(self, stage, done, total):
            left(stage, done, total)
            seen.append((time.process_time() - began_s, left.left_s()))

    try:
        run_fit(FitJob(capture=str(tmp_path / "capture"), out=str(tmp_path / "result")), Watch())
    finally:
        torch.set_num_threads(threads)
    seen.append((time.process_time() - began_s, None))
    begun_s = 0.1 * seen[-1][0]
    share = within_two([pair for pair in seen if pair[0] >= begun_s], skip_s=0.1 * seen[-1][0])
    print(f"{seen[-1][0]:.0f} s: within a factor of two for {100 * share:.0f} % of the time")
    assert share >= 0.9


def test_words_of_a_time_left():
    assert [words(s) for s in (None, 3.0, 34.0, 100.0, 3000.0, 4000.0)] == [
        "",
        "a few seconds left",
        "about 30 s left",
        "about 2 min left",
        "about 50 min left",
        "about 1 h 07 min left",
    ]
