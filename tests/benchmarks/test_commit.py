"""A table says at which commit it was measured."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tests.benchmarks.commit import commit_of, is_clean, note_commit, noted_commit, stamped, this_commit


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    def git(*arguments: str) -> None:
        identity = ("-c", "user.name=a", "-c", "user.email=a@b")
        subprocess.run(["git", "-C", str(tmp_path), *identity, *arguments], check=True, capture_output=True)

    git("init")
    for name in ("code.py", "page.md"):
        (tmp_path / name).write_text("1")
    git("add", ".")
    git("commit", "-m", "first")
    return tmp_path


def test_a_clean_checkout_is_its_short_hash(checkout: Path) -> None:
    found = commit_of(checkout)
    assert len(found) >= 7
    assert set(found) <= set("0123456789abcdef")
    assert is_clean(found)


@pytest.mark.parametrize("name", ["code.py", "new.py"])
def test_changed_and_new_files_are_said(checkout: Path, name: str) -> None:
    (checkout / name).write_text("2")
    found = commit_of(checkout)
    assert found.endswith(" with changes")
    assert not is_clean(found)


def test_tables_put_into_pages_are_no_changes(checkout: Path) -> None:
    (checkout / "page.md").write_text("2")
    assert is_clean(commit_of(checkout))


def test_a_folder_without_git_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="checkout"):
        commit_of(tmp_path / "absent")


def test_every_commit_of_a_merged_table_is_named_once() -> None:
    text = stamped("| a |\n", ["b2", "a1 with changes", "b2"])
    assert text == "| a |\n\nMeasured at commit a1 with changes, b2."
    with pytest.raises(ValueError, match="commit"):
        stamped("| a |", [])


def test_what_a_run_keeps_has_the_commit_that_made_it(tmp_path: Path) -> None:
    note_commit(tmp_path / "profile")
    assert noted_commit(tmp_path / "profile") == this_commit()
    with pytest.raises(FileNotFoundError):
        noted_commit(tmp_path / "other")
