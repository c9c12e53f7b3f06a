"""``udccal plan``, word by word as it is called."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from udccal.rig import load_rig


def udccal(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "udccal.cli.main", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=280)


@pytest.mark.medium
def test_a_plan_and_the_rig_it_writes(tmp_path: Path) -> None:
    out = tmp_path / "planned" / "rig.toml"
    words = ["plan", "--rig", "lg55-reduced", "--target", "noise=0.06%", "geometry=0.001px", "--out", out, "--json"]
    done = udccal(*words)
    # The geometry's target is out of reach.
    assert done.returncode == 1, done.stderr
    made = json.loads(done.stdout)
    noise, geometry = made["terms"][0], made["terms"][1]
    assert (noise["term"], noise["reached"]) == ("noise", True)
    assert 0.03 < noise["sigma"] <= 0.06
    assert (geometry["term"], geometry["reached"]) == ("geometry", False)
    assert geometry["floor"] > 0.001
    assert made["untouched"] == ["wire", "psf", "backscatter"]
    assert made["cost"]["frames"] > 300
    assert "no number of captures reaches 0.001 px" in done.stderr
    assert "on the jig" in done.stderr
    planned, before = load_rig(out.parent).captures, load_rig("lg55-reduced").captures
    levels = next(one["planned"] for one in noise["settings"] if one["name"] == "noise_levels")
    assert planned == before.model_copy(update={"noise_levels": levels, "noise_stack": 8})
    # Once more: what was written stays.
    again = udccal(*words)
    assert again.returncode == 1
    assert "Expected nothing at" in json.loads(again.stdout)["error"]


@pytest.mark.medium
def test_a_table_for_people() -> None:
    done = udccal("plan", "--rig", "lg55-reduced", "--target", "noise=1%")
    assert done.returncode == 0, done.stderr
    for said in ("Planned captures", "noise_levels 5 (now 10)", "Effect of one further addition"):
        assert said in done.stdout
    assert "All 5 terms" in done.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--rig", "lg55-reduced", "--target", "focus=1%"], "found one for 'focus'"),
        (["--rig", "lg55-reduced", "--target", "wire=1%", "psf=0%"], "above zero"),
        (["--rig", "lg55-reduced", "--target", "wire=1px"], "the unit 'px'"),
        (["--rig", "no-such-rig", "--target", "wire=1%"], "lg55-reduced"),
        (["--rig", "lg55-reduced", "--target", "noise=1%", "--profile", "/no/such/profile"], "profile.json"),
    ],
    ids=str,
)
@pytest.mark.medium
def test_wrong_words_are_answered_with_a_sentence(words: list[str], said: str) -> None:
    done = udccal("plan", *words)
    assert done.returncode == 1
    sentence = done.stderr.strip().splitlines()[-1]
    assert sentence.startswith("udccal: Expected")
    assert said in sentence
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
