from __future__ import annotations

import pytest

from tests.benchmarks.peers.lines import Line, table

_LINES = [
    Line.read('{"work": "hdr", "peer": "udccal", "version": "1", "seconds": 0.2, "full": {"ratio": [1.01, 1.0]}}'),
    Line.read('{"work": "noise", "peer": "a", "version": "2", "seconds": 3, "rel_err_rms": {"K": 0.0003}}'),
    Line.failure("noise", "b", "no such file"),
]


def test_each_work_has_a_table_with_what_was_measured() -> None:
    noise, hdr = table("noise", _LINES), table("hdr", _LINES)
    assert "| a 2 | 0.03 |" in noise
    assert "1.01, 1" in hdr
    assert "| a 2" not in hdr


def test_what_did_not_run_says_why() -> None:
    assert "| b | did not run here: no such file |" in table("noise", _LINES)


def test_missing_and_wrong_numbers_are_dashes() -> None:
    line = Line.read('{"work": "noise", "peer": "a", "seconds": "fast", "ok": true}')
    assert line.number("seconds") is None
    assert line.number("ok") is None
    assert line.number("rel_err_rms", "K") is None


def test_lines_survive_being_written() -> None:
    assert [Line.read(line.text()) for line in _LINES] == _LINES


def test_one_picture_is_compared_with_one() -> None:
    many = Line.read('{"work": "hdr", "peer": "u", "ratio_many_pictures": [7.0], "full": {"ratio": [1.5]}}')
    assert "| 1.5 |" in table("hdr", [many])
    assert "7" not in table("hdr", [many])


def test_lines_say_the_commit_that_they_were_measured_beside() -> None:
    measured = [line.measured_at("abc1234") for line in _LINES]
    assert {line.commit for line in measured} == {"abc1234"}
    assert Line.read(measured[0].text()) == measured[0]
    assert _LINES[0].commit == "unknown"


def test_a_line_without_a_work_is_refused() -> None:
    with pytest.raises(KeyError):
        Line.read('{"peer": "a"}')
