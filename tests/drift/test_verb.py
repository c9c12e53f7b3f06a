"""``udccal check`` as it is installed, on the simulated rig whose profile ships."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from udccal.profiles.provenance import profile_sha256
from udccal.profiles.store import find_profile, load_profile, write_profile
from udccal.result import FitStatus


def check(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "udccal.cli.main", "check", "--profile", "lg55-reduced", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=900)


@pytest.mark.slow
def test_the_same_rig_on_another_day_is_the_same(tmp_path: Path) -> None:
    out = tmp_path / "with a space, µ"
    done = check("--noise-seed", "7", "--out", out, "--update", tmp_path / "new", "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document == json.loads((out / "check.json").read_text(encoding="utf-8"))
    assert (document["verdict"], document["changed"]) == ("same", [])
    names = [one["name"] for one in document["changes"]]
    assert names == ["moved", "tilted", "refocused", "smudge", "panel level", "gain"]
    sigma = {one["name"]: one["sigma"] for one in document["changes"]}
    assert sigma["moved"] < 0.01
    assert sigma["tilted"] < 0.02
    page = (out / "check.html").read_text(encoding="utf-8")
    assert document["advice"] in page
    assert not re.findall(r"(?:src|href)=\"(?!data:|#)", page)
    assert load_profile(tmp_path / "new").parent == profile_sha256(find_profile("lg55-reduced"))


@pytest.mark.medium
def test_another_camera_is_refused_before_it_captures(tmp_path: Path) -> None:
    done = check("--seed", "1", "--out", tmp_path / "out", "--json")
    assert done.returncode == 1, done.stdout
    assert "found another camera" in json.loads(done.stdout)["error"]
    assert not (tmp_path / "out" / "session").exists()


@pytest.mark.medium
def test_a_profile_without_the_terms_is_refused_before_it_captures(tmp_path: Path) -> None:
    whole = load_profile("lg55-reduced")
    lacking = replace(whole, wire=replace(whole.wire, status=FitStatus.NOT_CAPTURED))
    write_profile(tmp_path / "lacking", lacking)
    command = [sys.executable, "-m", "udccal.cli.main", "check", "--profile", str(tmp_path / "lacking")]
    done = subprocess.run([*command, "--out", str(tmp_path / "out")], capture_output=True, text=True, timeout=280)
    assert done.returncode == 1
    assert "found no wire" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_full_disk_is_said_and_leaves_no_half_result(nearly_full: Path) -> None:
    done = check("--out", nearly_full / "c", "--update", nearly_full / "p", "--json")
    assert done.returncode == 1, done.stdout
    assert "Traceback" not in done.stderr
    assert "No space left on device" in json.loads(done.stdout)["error"]
    # What was captured stays, as a session to go on with; of results there is nothing.
    assert sorted(item.name for item in nearly_full.iterdir()) == ["c", "other"]
    assert [item.name for item in (nearly_full / "c").iterdir()] == ["session"]


@pytest.mark.slow
def test_two_at_once_leave_one_whole_result(tmp_path: Path) -> None:
    with ThreadPoolExecutor(2) as pool:
        both = list(pool.map(lambda _: check("--out", tmp_path / "c", "--update", tmp_path / "p"), range(2)))
    assert {done.returncode for done in both} <= {0, 1}, [done.stderr for done in both]
    assert 0 in {done.returncode for done in both}
    assert sorted(file.name for file in (tmp_path / "c").iterdir()) == ["check.html", "check.json", "session"]
    assert json.loads((tmp_path / "c" / "check.json").read_text(encoding="utf-8"))["verdict"] == "same"
    assert load_profile(tmp_path / "p").parent == profile_sha256(find_profile("lg55-reduced"))
    assert sorted(item.name for item in tmp_path.iterdir()) == ["c", "p"]
