"""What a person sees when something goes wrong: one sentence, a non-zero exit status, no traceback without --debug."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

PORTRAIT = str(Path(__file__).resolve().parents[2] / "udccal" / "data" / "portrait.jpg")


def udccal(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "udccal.cli.main", *words], capture_output=True, text=True, timeout=280
    )


def broken_session(folder: Path) -> Path:
    folder.mkdir()
    (folder / "session.json").write_text('{"format": "udccal-session", "version": 1')
    return folder


def nested_rig(folder: Path) -> Path:
    folder.mkdir()
    (folder / "rig.toml").write_text("name = " + "[" * 100_000)
    return folder


FAILURES = {
    "a rig of lists in lists": lambda tmp: (["rig", "check", str(nested_rig(tmp / "r"))], "rig"),
    "a name of 5000 letters": lambda tmp: (["rig", "check", "r" * 5000], "File name too long"),
    "a path of 5000 letters": lambda tmp: (["fit", "s" * 5000, "--profile", str(tmp / "p")], "File name too long"),
    "no session": lambda tmp: (["fit", str(tmp / "absent"), "--profile", str(tmp / "p")], "Expected"),
    "broken session": lambda tmp: (["fit", str(broken_session(tmp / "s")), "--profile", str(tmp / "p")], "session"),
    "no profile": lambda tmp: (["profile", "show", str(tmp / "absent")], "profile.json"),
    "nothing to prepare": lambda tmp: (["profile", "prepare", str(tmp / "absent")], "profile.json"),
    "no rig": lambda tmp: (
        ["calibrate", "--rig", "no-such-rig", "--session", str(tmp / "s"), "--profile", str(tmp / "p")],
        "lg55-reduced",
    ),
    "no photograph": lambda tmp: (
        ["simulate", str(tmp / "absent.jpg"), "--rig", "lg55-reduced", "--out", str(tmp / "o")],
        "absent.jpg",
    ),
}


@pytest.mark.parametrize("case", FAILURES, ids=str)
def test_a_failure_is_one_sentence(case: str, tmp_path: Path) -> None:
    words, said = FAILURES[case](tmp_path)
    done = udccal(*words)
    assert done.returncode == 1, done.stderr
    sentence = done.stderr.strip().splitlines()[-1]
    assert sentence.startswith("udccal: Expected")
    assert said in sentence
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert not (tmp_path / "p").exists()
    assert not (tmp_path / "o").exists()


@pytest.mark.medium
def test_with_json_the_failure_is_json_and_with_debug_there_is_a_traceback(tmp_path: Path) -> None:
    done = udccal("profile", "show", str(tmp_path), "--json", "--debug")
    assert done.returncode == 1
    assert "profile.json" in json.loads(done.stdout)["error"]
    assert "Traceback" in done.stderr


def test_with_events_the_failure_is_the_last_event(tmp_path: Path) -> None:
    places = ["--session", str(tmp_path / "s"), "--profile", str(tmp_path / "p")]
    done = udccal("calibrate", "--rig", "no-such-rig", *places, "--practice", "--json-events")
    assert done.returncode == 1
    assert "no-such-rig" in json.loads(done.stdout.splitlines()[-1])["error"]


@pytest.mark.parametrize("words", [["restore"], ["calibrate", "--rig", "lg55-reduced"], ["nonsense"]], ids=str)
def test_wrong_words_leave_with_status_2(words: list[str]) -> None:
    done = udccal(*words)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr


def test_a_bug_asks_for_debug_and_shows_no_traceback() -> None:
    code = (
        "import udccal.cli.jobs.show as job\n"
        "def broken(*_): raise ZeroDivisionError('secret')\n"
        "job.show_profile = broken\n"
        "from udccal.cli.main import main\n"
        "main(['profile', 'show', 'anything'])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=280)
    assert done.returncode == 70
    assert "--debug" in done.stderr
    assert "Traceback" not in done.stderr
