"""Verbs that write, as they are installed: odd names, a disk that is read-only or full, two on one output at once."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.comparison.test_diff import changed
from tests.profiles.exchange.test_ros_camera_info import CALIBRATOR
from tests.profiles.test_versions import written_in_version_2
from tests.toy_rigs import write_toy_rig
from udccal.profiles.profile import Profile
from udccal.profiles.store import load_profile, write_profile

pytestmark = pytest.mark.slow
Words = list[str | Path]


def verbs(given: Path, out: Path) -> dict[str, Words]:
    """Every verb that writes, and what it writes in ``out``."""
    return {
        "board": ["board", "--rig", given / "toy", "--out", out / "b.pdf"],
        "pack": ["profile", "pack", given / "p", out / "p.zip"],
        "unpack": ["profile", "unpack", given / "p.zip", out / "p"],
        "migrate": ["profile", "migrate", given / "old", "--out", out / "m"],
        "export": ["profile", "export", given / "p", "--to", "npz", "--out", out / "e.npz"],
        "import": [
            *("profile", "import", given / "camera.yaml", "--from", "ros-camera-info"),
            *("--rig", given / "toy", "--out", out / "i"),
        ],
        "diff": ["profile", "diff", given / "p", given / "b.zip", "--out", out / "d"],
    }


def refused_before_work(given: Path, out: Path) -> dict[str, Words]:
    """Verbs that take long, and look at the place of their results first."""
    return {
        "validate": ["profile", "validate", given / "p", "--session", given / "s", "--out", out / "v"],
        "check": ["check", "--profile", given / "p", "--out", out / "c"],
        "calibrate": [
            *("calibrate", "--rig", given / "toy", "--camera", "sim", "--practice"),
            *("--session", given / "s", "--profile", out / "p"),
        ],
    }


VERBS = tuple(verbs(Path(), Path()))
LONG = tuple(refused_before_work(Path(), Path()))
ENDS_WELL = {"diff": 3}


def start(words: Words) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "udccal.cli.main", *map(str, words), "--json"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    """The status, and the sentence of a refusal."""
    said, complained = process.communicate(timeout=400)
    assert "Traceback" not in complained
    return process.returncode, json.loads(said).get("error", "") if said else complained


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory, toy_profile: Profile) -> Path:
    """What the verbs read, under a name with a space, an accent and signs of other scripts."""
    folder = tmp_path_factory.mktemp("given à 用户 'x' $y")
    write_toy_rig(folder)
    write_profile(folder / "p", toy_profile)
    write_profile(folder / "p.zip", toy_profile)
    write_profile(folder / "b.zip", changed(toy_profile))
    written_in_version_2(folder / "old", toy_profile)
    (folder / "camera.yaml").write_text(CALIBRATOR.replace(": 96", ": 128").replace(": 64", ": 96"))
    return folder


@pytest.mark.parametrize("verb", [*VERBS, *LONG])
def test_a_read_only_disk_is_said_and_nothing_is_left(verb: str, given: Path, disk: Callable[[str], Path]) -> None:
    out = disk("ro,size=64k")
    words = verbs(given, out) | refused_before_work(given, out)
    status, sentence = ended(start(words[verb]))
    assert status == 1
    assert sentence.startswith(f"Expected to write the results to {out}"), sentence
    assert "Read-only file system" in sentence
    assert not (given / "s").exists()


@pytest.mark.parametrize("verb", VERBS)
def test_a_full_disk_is_said_and_nothing_is_left(verb: str, given: Path, nearly_full: Path) -> None:
    status, sentence = ended(start(verbs(given, nearly_full)[verb]))
    assert status == 1
    assert sentence.startswith(f"Expected to write the results to {nearly_full}"), sentence
    assert "No space left on device" in sentence
    assert [file.name for file in nearly_full.rglob("*") if file.is_file()] == ["other"]


@pytest.mark.parametrize("verb", VERBS)
def test_two_at_once_leave_one_whole_result(verb: str, given: Path, tmp_path: Path) -> None:
    out = tmp_path / "out à 'é' $x"
    both = [ended(process) for process in [start(verbs(given, out)[verb]) for _ in range(2)]]
    well = ENDS_WELL.get(verb, 0)
    assert well in {status for status, _ in both}, both
    assert {status for status, _ in both} <= {well, 1}
    assert all("found" in sentence for status, sentence in both if status == 1)
    left = [file for file in out.rglob("*") if file.is_file()]
    assert not [file for file in left if file.name.startswith(".")]
    match verb:
        case "pack" | "unpack" | "migrate" | "import":
            (whole,) = out.iterdir()
            load_profile(whole)
        case "diff":
            assert {file.name for file in left} == {"diff.json", "diff.html"}
            json.loads((out / "d" / "diff.json").read_text())
        case "export":
            assert {file.name for file in left} == {"e.npz", "e.npz.json"}
        case "board":
            assert (out / "b.pdf").read_bytes().rstrip().endswith(b"%%EOF")
