from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.benchmarks.readme_tables import between
from tests.benchmarks.rows import at_least, at_most, table, write_json


def test_limits_are_kept_or_missed() -> None:
    assert at_most("a", 1.0, 2.0, "%").ok
    assert not at_most("a", 2.1, 2.0, "%").ok
    assert not at_most("a", float("nan"), 2.0, "%").ok
    assert at_least("b", 10.5, 10.0, "dB").ok
    assert not at_least("b", 9.9, 10.0, "dB").ok


def test_a_missed_limit_shows_in_table_and_file(tmp_path: Path) -> None:
    rows = [at_most("good", 1.0, 2.0, "%"), at_most("bad", 3.0, 2.0, "%")]
    assert table(rows).count("**missed**") == 1
    write_json(rows, tmp_path / "accuracy.json")
    found = json.loads((tmp_path / "accuracy.json").read_text())
    assert [sorted(row) for row in found] == [["limit", "name", "ok", "unit", "value"]] * 2
    assert [row["ok"] for row in found] == [True, False]


def test_tables_replace_what_stood_between_their_markers() -> None:
    text = "a\n<!-- x -->\nold\n<!-- /x -->\nb\n"
    assert between(text, "x", "new") == "a\n<!-- x -->\nnew\n<!-- /x -->\nb\n"
    with pytest.raises(ValueError, match="markers"):
        between("no markers here", "x", "new")
