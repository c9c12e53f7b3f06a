"""A check of a simulated rig by a person who leads a simulated hand, and does wrong at first."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.toy_rigs import write_five_term_rig

_PATIENCE_S = 900.0


def run(*words: str | Path, typed: str | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "udccal.cli.main", *map(str, words)]
    return subprocess.run(command, input=typed, capture_output=True, text=True, timeout=_PATIENCE_S)


@pytest.mark.slow
def test_a_mistake_is_told_and_the_check_is_that_of_a_rig_without_it(tmp_path: Path) -> None:
    rig, profile = write_five_term_rig(tmp_path), tmp_path / "p"
    terms = (word for term in ("noise", "wire", "backscatter") for word in ("--term", term))
    made = run("calibrate", "--rig", rig, "--session", tmp_path / "s", "--profile", profile, *terms)
    assert made.returncode in (0, 3), made.stderr
    day = ("check", "--profile", profile, "--noise-seed", "3", "--json")
    alone = run(*day, "--out", tmp_path / "alone")
    practice = (*day, "--practice", "--out", tmp_path / "led")
    # No light, which is captured and refused, and tried again with light; the darkness is left out; the blackout.
    first = run(*practice, typed="wrong\n\n\n\n\nskip\n\n\n")
    assert first.returncode == 1
    said = " ".join(first.stderr.split())
    for words in ("Step 1 of 3", "Little light is seen", "✗ Step wire/flat: Expected", "without wire/dark"):
        assert words in said
    assert "Expected the step 'wire/dark'" in json.loads(first.stdout)["error"]
    # What was captured stays, and the step that was left out is offered alone.
    second = run(*practice, typed="\n\n")
    assert second.returncode == alone.returncode == 0, second.stderr
    assert "Step 1 of 3" not in second.stderr
    assert "Step 2 of 3" in second.stderr
    # The numbers of the frames go on after the mistake, so that noise alone tells the two days apart.
    mine, theirs = json.loads(second.stdout), json.loads(alone.stdout)
    assert (mine["verdict"], mine["changed"]) == (theirs["verdict"], theirs["changed"]) == ("same", [])
    for one, other in zip(mine["changes"], theirs["changes"], strict=True):
        assert abs(one["value"] - other["value"]) < one["sigma"], one["name"]


@pytest.mark.medium
def test_a_practice_is_stopped_by_quit_and_nothing_is_compared(tmp_path: Path) -> None:
    done = run("check", "--profile", "lg55-reduced", "--practice", "--out", tmp_path / "out", typed="quit\n")
    assert done.returncode == 130, done.stderr
    assert not (tmp_path / "out" / "check.json").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--practice", "--camera", "files"), "--practice is for the simulated rig"),
        (("--yes",), "--yes is for --camera u3v or pylon"),
    ],
    ids=str,
)
def test_words_that_do_not_go_together_are_refused(words: tuple[str, ...], said: str, tmp_path: Path) -> None:
    done = run("check", "--profile", "lg55-reduced", "--out", tmp_path / "out", *words)
    assert done.returncode == 2
    assert said in done.stderr.replace("\n", " ")
    assert not (tmp_path / "out").exists()
