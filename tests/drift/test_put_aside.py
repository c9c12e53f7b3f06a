"""A check into the folder of an earlier one does not judge the captures of then."""

from __future__ import annotations

from pathlib import Path

import pytest

from udccal.cli.jobs.check import _put_aside


@pytest.mark.parametrize("answered", [True, False])
def test_captures_of_an_answered_check_are_put_aside(tmp_path: Path, answered: bool) -> None:
    session, answer, page = tmp_path / "session", tmp_path / "check.json", tmp_path / "check.html"
    session.mkdir()
    (session / "session.json").write_text("{}")
    if answered:
        answer.write_text("{}")
        page.write_text("of then")
    for _ in range(2):
        _put_aside(session, answer, page)
        # One that was interrupted goes on, and so does the new one.
        assert session.exists() is not answered
        assert (tmp_path / "session-before" / "session.json").exists() is answered
        assert not answer.exists()
        assert not page.exists()
