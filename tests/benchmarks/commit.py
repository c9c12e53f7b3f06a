"""The commit that a table was measured at, as a sentence that stands below the table."""

from __future__ import annotations

import functools
import subprocess
from collections.abc import Iterable
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[2]
_CHANGED = " with changes"


def commit_of(root: Path) -> str:
    """Short hash of a checkout's commit, and "with changes" where its files differ from it.

    Pages (``*.md``) do not count: the commands write their tables into them.

    Raises:
        RuntimeError: when the folder is in no checkout of git.
    """
    hash_ = _git(root, "rev-parse", "--short", "HEAD").strip()
    return hash_ + (_CHANGED if _git(root, "status", "--porcelain", "--", ".", ":(exclude)*.md") else "")


@functools.cache
def this_commit() -> str:
    """Of this source tree, as it was when the process first asked."""
    return commit_of(_ROOT)


def is_clean(commit: str) -> bool:
    """Whether a text of ``commit_of`` names the measured code completely."""
    return not commit.endswith(_CHANGED)


def stamped(table: str, commits: Iterable[str] | None = None) -> str:
    """``table`` and the commits that it was measured at: by default that of this source tree."""
    named = sorted(set([this_commit()] if commits is None else commits))
    if not named:
        raise ValueError("Expected the commit of a table, found none. Measure it again.")
    return f"{table.rstrip()}\n\nMeasured at commit {', '.join(named)}."


def note_commit(made: Path) -> None:
    """Write this commit beside what a later run takes from its folder."""
    _beside(made).write_text(this_commit(), encoding="utf-8")


def noted_commit(made: Path) -> str:
    """The commit that made what a run took from its folder."""
    return _beside(made).read_text(encoding="utf-8")


def _beside(made: Path) -> Path:
    return made.with_name(f"{made.name}.commit")


def _git(root: Path, *arguments: str) -> str:
    try:
        done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise RuntimeError(f"Expected {root} to be a checkout of git, found: {error}. Measure in a clone.") from error
    return done.stdout
