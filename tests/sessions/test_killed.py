from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.sessions.killed_captures import Work, capture_once, contents, small_rig
from udccal.benches.bench import simulated_rig

ROOT = Path(__file__).resolve().parents[2]


def _killed(folder: Path, *options: str) -> int:
    """Run the killer; returns how often it killed."""
    command = [sys.executable, "-m", "tests.sessions.killed_captures", str(folder), *options]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=1700)
    assert done.returncode == 0, done.stderr[-2000:]
    print(done.stdout)
    return int(re.match(r"(\d+) kills", done.stdout).group(1))


@pytest.mark.medium
def test_a_capture_killed_a_few_times_gives_the_same_session(tmp_path: Path) -> None:
    options = ("--kills", "5", "--coarser", "8", "--within-s", "0.15", "--term", "noise", "--term", "wire")
    assert _killed(tmp_path, *options) >= 5


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_capture_killed_a_hundred_times_gives_the_same_session(tmp_path: Path) -> None:
    assert _killed(tmp_path) >= 100


def test_a_session_of_another_seed_is_noticed(tmp_path: Path) -> None:
    rig = small_rig(coarser=8)
    for seed in (3, 4):
        capture_once(Work(rig, simulated_rig(rig, seed), ("wire",)), tmp_path / str(seed))
    first, second = contents(tmp_path / "3"), contents(tmp_path / "4")
    assert first.keys() == second.keys()
    assert first["wire/flat_0.exr"] != second["wire/flat_0.exr"]
