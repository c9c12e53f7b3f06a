"""What a person at the rig is asked, with the camera that Basler's SDK emulates: 4096 x 4096 pixels."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.toy_rigs import write_emulated_rig, write_toy_rig

pytestmark = pytest.mark.medium


@pytest.fixture(autouse=True)
def _emulator(emulated_camera: None) -> None:
    """Every test has the emulated camera."""


def calibrate(folder: Path, rig: Path, typed: str) -> subprocess.CompletedProcess[str]:
    words = ["calibrate", "--rig", rig, "--camera", "pylon", "--session", folder / "s", "--profile", folder / "p"]
    command = [sys.executable, "-m", "udccal.cli.main", *map(str, words), "--term", "noise"]
    return subprocess.run(command, input=typed, capture_output=True, text=True, timeout=280)


def test_what_no_person_can_mend_is_not_asked_again(tmp_path: Path) -> None:
    done = calibrate(tmp_path, write_toy_rig(tmp_path), "\n\n\n\n")
    assert done.returncode == 1
    assert "Expected a camera of 128 x 96, RGGB, 12 bits as in the rig 'toy', found 4096 x 4096" in done.stderr
    assert "[Enter" not in done.stderr


def test_a_word_that_is_not_offered_is_never_yes(tmp_path: Path) -> None:
    done = calibrate(tmp_path, write_emulated_rig(tmp_path), "jump\n\njump\n\nquit\n")
    assert done.returncode == 130
    asked = done.stderr
    step = asked.index("Step 1 of 2")
    panel = asked.index("Switch the panel off, or let it show black only. Go on when it is done.")
    first = asked.index("'jump' is none of the answers: Enter, quit.")
    second = asked.index("'jump' is none of the answers: Enter, skip, back, quit.")
    refused = asked.index("✗ Step noise/flat_stack: Expected")
    assert step < panel < first < second < refused
    assert asked.strip().splitlines()[-1].startswith("udccal: Stopped.")


def test_no_is_no(tmp_path: Path) -> None:
    done = calibrate(tmp_path, write_emulated_rig(tmp_path), "n\nquit\nquit\n")
    assert done.returncode == 130
    assert "'n' is none of the answers: Enter, quit." in done.stderr
    assert "evenness" not in done.stderr
