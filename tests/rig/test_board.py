"""The simulated board itself, by the behaviour that was measured on the firmware."""

import numpy as np
import pytest

from reflectsep.rig.board import Board


def exchange(board, data, at_s, until_s):
    board.receive(data, at_s)
    return board.transmit(until_s).decode()


def booted(**options):
    board = Board(**options)
    board.power_on(0.0)
    assert board.transmit(1.5).decode().strip().startswith("Grbl 1.1h")
    return board


def test_board_is_deaf_while_it_boots():
    board = Board()
    board.power_on(0.0)
    assert exchange(board, b"G1 X-1 F60\n", 0.5, 3.0).count("ok") == 0


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        (b"G21 G91\n", "ok"),
        (b"FOO\n", "error:2"),
        (b"G1 X1\n", "error:22"),
        (b"$H\n", "error:5"),
        (b"$Q\n", "error:3"),
    ],
)
def test_board_answers_as_measured(line, answer):
    assert exchange(booted(), line, 2.0, 2.5).strip() == answer


def test_board_says_ok_to_a_motion_before_its_first_step_and_to_a_dwell_after_its_last():
    board = booted()
    assert exchange(board, b"G53 G1 X-2 F600\n", 2.0, 2.008).strip() == "ok"
    assert board.position(2.008)[0] == 0
    board.receive(b"G4 P0.01\n", 2.01)
    said = next(t for t in np.arange(2.02, 4, 0.001) if board.transmit(t))
    stopped = board.trace.end_s
    assert 0.08 < said - stopped < 0.1


def test_board_drops_what_overflows_its_buffer_without_a_word():
    board = booted()
    answers = exchange(board, b"G91\n" + b"G1 X-0.1 F60\n" * 60, 2.0, 60.0)
    assert answers.count("ok") < 30
    assert "error" not in answers
    assert board.position(60.0)[0] > -3.0


def test_board_runs_too_fast_below_its_slowest_step_rate():
    board = booted()
    board.receive(b"G1 X-10 F6\n", 2.0)
    speed = (board.position(22.0)[0] - board.position(12.0)[0]) / 10.0
    assert speed == pytest.approx(-30.5 / 250, rel=1e-6)


def test_board_is_dead_after_a_soft_limit_until_it_is_reset():
    board = booted(settings={20: 1, 22: 1})
    board.receive(b"$H\n", 1.6)
    board.transmit(30.0)
    assert "ALARM:2" in exchange(board, b"G53 G1 X5 F600\n", 31.0, 31.2)
    assert "Grbl" not in exchange(board, b"\x18", 31.3, 31.4), "a reset while the alarm blocks is forgotten"
    assert board.transmit(31.9).decode().strip() == "[MSG:Reset to continue]"
    assert exchange(board, b"?", 32.0, 33.0) == ""
    answers = exchange(board, b"\x18", 34.0, 35.0)
    assert "Grbl 1.1h" in answers
    assert answers.endswith("unlock]\r\nok\r\n")
    assert "<Alarm|" in exchange(board, b"?", 36.0, 36.1)


def test_board_keeps_its_position_over_a_hold_and_a_reset_and_loses_it_over_a_reset_alone():
    board = booted()
    board.receive(b"G53 G1 X-20 F600\n", 2.0)
    board.receive(b"!", 3.0)
    assert "Hold:0" in exchange(board, b"?", 3.5, 4.0)
    answers = exchange(board, b"\x18", 4.0, 5.0)
    assert "Grbl" in answers
    assert "ALARM" not in answers
    board.receive(b"G53 G1 X-20 F600\n", 6.0)
    assert "ALARM:3" in exchange(board, b"\x18", 6.5, 7.0)


def test_board_tells_offsets_and_overrides_only_now_and_then():
    board = booted()
    reports = [exchange(board, b"?", 2.0 + 0.2 * k, 2.1 + 0.2 * k) for k in range(22)]
    assert [k for k, text in enumerate(reports) if "WCO:" in text] == [0, 10, 20]
    assert [k for k, text in enumerate(reports) if "Ov:" in text] == [1, 11, 21]
    board.receive(b"\x92", 7.0)
    assert "Ov:90,100,100" in exchange(board, b"?", 7.1, 7.2)


def test_board_says_nothing_of_a_question_asked_while_an_alarm_blocks():
    board = booted()
    board.receive(b"G53 G1 X-20 F600\n", 2.0)
    assert "ALARM:3" in exchange(board, b"\x18", 3.0, 3.1)
    assert exchange(board, b"?", 3.2, 3.4) == ""
    assert "Grbl 1.1h" in board.transmit(3.6).decode()
    assert "<Alarm|" in exchange(board, b"?", 3.7, 3.8), "locked, with homing or without"
