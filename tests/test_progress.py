"""Progress on a terminal and elsewhere."""

import io
import time

import pytest

from reflectsep import progress, terminal
from reflectsep.estimate import Part


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_one_line_for_every_stage_however_many_steps():
    stream = io.StringIO()
    with progress.shown(lines=True, stream=stream) as show:
        for done in range(1, 51):
            show("sweep L1", done, 50)
        show("fit", 0, 100)
        show("fit", 7, 100)  # converged early: its line comes all the same
    lines = stream.getvalue().splitlines()
    assert [line.split(":")[0] for line in lines] == ["sweep L1", "fit"]


def test_a_second_end_of_a_stage_shows_nothing_and_a_second_run_does():
    stream = io.StringIO()
    with progress.shown(lines=True, stream=stream) as show:
        for done in (1, 2, 2):
            show("joint fit", done, 2)
        for done in (1, 2):
            show("joint fit", done, 2)
    assert [line.split(":")[0] for line in stream.getvalue().splitlines()] == ["joint fit", "joint fit"]


def test_time_before_the_first_report_belongs_to_the_stage(monkeypatch):
    stream, now_s = io.StringIO(), [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now_s[0])
    with progress.shown(lines=True, stream=stream) as show:
        for stage, done, at_s in [("a", 0, 1.0), ("a", 1, 3.0), ("b", 1, 7.0), ("c", 0, 9.0), ("c", 1, 10.0)]:
            now_s[0] = at_s
            show(stage, done, 1)
    assert stream.getvalue().splitlines() == ["a: 2.0 s", "b: 4.0 s", "c: 1.0 s"]


def test_prefix_tells_runs_apart():
    stream = io.StringIO()
    with progress.shown("object=wax: ", lines=True, stream=stream) as show:
        show("fit", 1, 1)
    assert stream.getvalue().startswith("object=wax: fit: ")


def test_failed_stage_writes_no_line():
    stream = io.StringIO()

    def fail():
        with progress.shown(lines=True, stream=stream) as show:
            show("fit", 1, 9)
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        fail()
    assert stream.getvalue() == ""


def test_bars_know_their_end():
    stream = Terminal()
    with progress.shown(stream=stream) as show:
        show("sweep L1", 3, 60)
        show("sweep L1", 60, 60)
    assert "60/60" in stream.getvalue()


def test_bar_of_a_stage_that_ended_early_is_full():
    stream = Terminal()
    with progress.shown(stream=stream) as show:
        show("fit", 7, 60)
        show("write", 1, 1)
    assert "7/7" in stream.getvalue()


def test_bar_of_a_stage_that_is_done_again_may_end_early():
    stream = Terminal()
    with progress.shown(stream=stream) as show:
        show("fit", 60, 60)
        show("fit", 7, 60)
        show("write", 1, 1)
    assert "7/7" in stream.getvalue()


def test_what_is_to_come_is_listed_and_what_is_left_out_goes():
    stream = Terminal()
    ahead = [Part(name=name, label=name, expected_s=100.0) for name in ("first", "never", "next", "last")]
    with terminal.stage_list(stream) as show:
        show.expect(ahead)
        assert show.lines() == ["first", "never", "next", "last"]
        show("first", 1, 2)
        time.sleep(0.4)  # the display draws itself ten times a second
        show("first", 2, 2)
        show("next", 0, 1)
        assert show.lines() == ["first", "next", "last"]
        show("last", 0, 1)
        assert show.lines() == ["first", "next", "last"]
        show("last", 1, 1)
        for names in (("a", "b"), ("c",), ("d", "a")):  # announced anew, as more is known
            show.expect([Part(name=name, label=name, expected_s=1.0) for name in names])
            assert show.lines() == ["first", "next", "last", *names]
    assert "min left" in stream.getvalue()


def test_rounds_of_a_stage_share_a_line():
    stream = Terminal()
    rounds = [Part(name="round", label="rounds", expected_s=10.0)] * 3
    with terminal.stage_list(stream) as show:
        show.expect(rounds)
        for k in (1, 2):
            show(f"round {k} of 2", 5, 5)
        assert show.lines() == ["rounds"]
    assert "2 of 2: 5/5" in stream.getvalue()


def test_nothing_is_shown_off_a_terminal_unless_asked_for():
    stream = io.StringIO()
    with progress.shown(stream=stream) as show:
        show("fit", 1, 1)
    assert stream.getvalue() == ""


def test_an_announcement_goes_through_a_journal_with_what_follows():
    told = []

    class Display:
        def expect(self, parts):
            told.extend(part.name for part in parts)

        def __call__(self, stage, done, total):
            pass

    a, b = (Part(name=name, label=name, expected_s=1.0) for name in "ab")
    progress.expect(progress.Journal(Display(), after=[b]), [a])
    assert told == ["a", "b"]
    progress.expect(progress.silent, [a])  # who does not want to know is not told


def test_a_run_within_a_run_goes_under_its_title():
    handed, told = [], []

    class Display:
        def expect(self, parts):
            told.append(parts)

        def __call__(self, *step):
            handed.append(step)

    within = progress.Titled(Display(), "beside")
    progress.expect(within, [Part(name="globals", label="globals", expected_s=1.0)])
    within("globals", 1, 2)
    assert handed == [("beside: globals", 1, 2)]
    assert told == []  # what was announced before stays
    (part,) = progress.titled([Part(name="globals", label="globals", expected_s=3.0)], "beside")
    assert (part.name, part.label, part.expected_s) == ("beside: globals", "beside", 3.0)


def test_parallel_runs_share_a_terminal_by_lines():
    stream = Terminal()
    with progress.shown("a: ", parallel=True, stream=stream) as show:
        show("fit", 1, 1)
    assert "\x1b" not in stream.getvalue()
    assert stream.getvalue().startswith("a: fit: ")


def test_a_journal_hands_everything_on_and_keeps_a_line_a_stage():
    handed = []
    journal = progress.Journal(lambda *step: handed.append(step))
    steps = [("a", 0, 2), ("a", 2, 2), ("b", 1, 9), ("c", 0, 1), ("c", 1, 1)]
    for step in steps:
        journal(*step)
    assert handed == steps
    lines = journal.text().splitlines()
    assert [line.split(":")[0] for line in lines] == ["a", "b", "c"]
    assert all(line.endswith(" s") for line in lines)
