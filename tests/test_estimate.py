"""The time left of a run: by a scripted clock and by stages of runs that were timed."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.data import Learnt
from reflectsep.estimate import TRUST, Part, Steps, TimeLeft, words
from reflectsep.fit.options import FitOptions
from reflectsep.workload import Counts, reading, reporting, solving

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

from time_left import within_two

LEARNT = Learnt(shared=(0.0,) * 8, order=(), covariance=(), noise=0.01)


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


@pytest.mark.parametrize("held", [None, LEARNT])
def test_more_pixels_values_and_stages_are_expected_to_take_longer(held):
    small = Counts(size=10_000, pixels=5_000, lights=6, channels=1)
    large = Counts(size=40_000, pixels=20_000, lights=6, channels=1)
    coloured = Counts(size=10_000, pixels=5_000, lights=6, channels=3)
    seconds = lambda counts: sum(p.expected_s for p in solving(counts, FitOptions(given=held), swept=True))  # noqa: E731
    assert seconds(small) < seconds(large)
    assert seconds(small) < seconds(coloured)
    names = [part.name for part in solving(small, FitOptions(given=held), swept=True)]
    assert names == (["globals", "pixels"] if held is None else ["pixels"])
    assert reporting(small, 0)[0].expected_s < reporting(large, 3)[0].expected_s


def test_what_comes_before_a_fit_is_its_drift_its_pictures_and_its_sweeps():
    sweeps = [SimpleNamespace(light=name, direction="x", count=30) for name in ("L1", "L2", "L9")]
    capture: Any = SimpleNamespace(names=["L1", "L2"], sweeps=sweeps)
    counts = Counts(size=10_000, pixels=5_000, lights=2, channels=1)
    names = [part.name for part in reading(capture, counts, aligned=True, swept=True)]
    assert names == [
        "alignment",
        "alignment L1 x",
        "alignment L2 x",
        "pictures",
        "sweep L1 x: passage",
        "sweep L2 x: passage",
        "sweep L1 x: scattering",
        "sweep L2 x: scattering",
    ]
    assert [part.name for part in reading(capture, counts, aligned=False, swept=False)] == ["pictures"]


def test_share_that_is_right_within_a_factor_of_two():
    """By hand: of what was said at 0, 10 and 20 s of 40 s the first is 1.9 times, the second 3 times too much."""
    said = [(0.0, 76.0), (10.0, 90.0), (20.0, 10.0), (39.0, 30.0), (40.0, None)]
    assert within_two(said) == pytest.approx(29 / 40)
    assert within_two(said, from_s=5.0) == pytest.approx(19 / 30)
    assert within_two(said, skip_s=5.0) == pytest.approx(29 / 39)


def test_words_of_a_time_left():
    assert [words(s) for s in (None, 3.0, 34.0, 100.0, 3000.0, 4000.0)] == [
        "",
        "a few seconds left",
        "about 30 s left",
        "about 2 min left",
        "about 50 min left",
        "about 1 h 07 min left",
    ]
