"""The commit that measured tables were made at."""

from __future__ import annotations

import subprocess
from pathlib import Path


def commit() -> str:
    """Its short name; "+" where the working tree differs from it."""
    return _git("rev-parse", "--short", "HEAD") + ("+" if _git("status", "--porcelain", "udccal", "tests") else "")


def _git(*words: str) -> str:
    folder = Path(__file__).parents[2]
    return subprocess.run(["git", *words], cwd=folder, check=True, capture_output=True, text=True).stdout.strip()
