"""Tables for people, JSON for machines, each on its own stream."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from udccal.cli.output import Output, plain
from udccal.reports.tables import Table
from udccal.result import FitStatus


@dataclass(frozen=True)
class Inner:
    path: Path
    status: FitStatus


@dataclass(frozen=True)
class Outer:
    inner: tuple[Inner, ...]
    value: float
    missing: float | None


RESULT = Outer((Inner(Path("a/b"), FitStatus.CONVERGED),), float("nan"), None)
TABLE = Table("Fits", ("term", "value"), (("noise", "[bold]1.0[/bold]"),), frozenset({1}))


def test_a_result_becomes_strict_json(capsys: pytest.CaptureFixture[str]) -> None:
    output = Output(as_json=True)
    with output.stage("working") as stage:
        stage.update(1, 2, "half way")
    output.table(TABLE)
    output.say("a sentence")
    output.result(RESULT)
    out, err = capsys.readouterr()
    assert json.loads(out) == {"inner": [{"path": "a/b", "status": "CONVERGED"}], "value": None, "missing": None}
    assert "a sentence" in err
    assert output.times[0].stage == "working"


def test_people_get_the_table_and_no_json(capsys: pytest.CaptureFixture[str]) -> None:
    output = Output()
    output.table(TABLE)
    output.result(RESULT)
    out, _ = capsys.readouterr()
    assert "noise" in out
    assert "[bold]" in out  # text is shown as it is
    assert "{" not in out


def test_what_a_file_says_does_not_steer_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    output, text = Output(), "a\x1b]0;title\x07\x1b[2J\x9b31m\rb\tc"
    output.say(text)
    output.answer(text)
    output.table(Table("Notes", ("note",), ((text,),)))
    out, err = capsys.readouterr()
    assert not any(letter in out + err for letter in "\x1b\x07\x9b\r")
    assert err.startswith("a?]0;title??[2J?31m?b")


def test_what_json_cannot_hold_is_refused() -> None:
    with pytest.raises(TypeError, match="ndarray"):
        plain(np.zeros(3))
