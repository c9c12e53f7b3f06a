"""``udccal profile diff`` as it is installed: its status, its sentences, and the files that it writes."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.comparison.test_diff import changed
from udccal.profiles.profile import Profile
from udccal.profiles.provenance import PROFILE_NAME
from udccal.profiles.store import write_profile

pytestmark = pytest.mark.medium


def diff(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "udccal.cli.main", "profile", "diff", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, toy: Profile) -> Path:
    folder = tmp_path_factory.mktemp("with a space, µ")
    write_profile(folder / "a", toy)
    write_profile(folder / "b.zip", changed(toy))
    return folder


def test_the_same_profile_twice_has_status_0(folder: Path) -> None:
    done = diff(folder / "a", folder / "a")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("Go on with either profile: they agree within their error bars.\n")
    (said,) = (line for line in done.stderr.splitlines() if "no number of this term" in line)
    assert said.startswith("wire, psf, backscatter: ")


def test_a_change_has_status_3_and_is_written(folder: Path) -> None:
    out = folder / "out" / "deep"
    done = diff(folder / "a", folder / "b.zip", "--out", out, "--json")
    assert done.returncode == 3, done.stderr
    document = json.loads(done.stdout)
    assert document == json.loads((out / "diff.json").read_text())
    assert document["verdict"] == "changed"
    assert {item.name for item in out.iterdir()} == {"diff.json", "diff.html"}
    page = (out / "diff.html").read_text()
    assert document["advice"].split(":")[0] in page
    assert not re.findall(r"(?:src|href)=\"(?!data:|#)", page)
    assert page.count("<img ") == 2


def refused(*words: str | Path) -> str:
    done = diff(*words, "--json")
    assert done.returncode == 1, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return str(json.loads(done.stdout)["error"])


def test_what_cannot_be_compared_is_refused_in_a_sentence(folder: Path) -> None:
    assert "found another size of the sensor" in refused("lg55-reduced", folder / "a")
    assert "found none" in refused(folder / "a", folder / "missing")
    document = json.loads((folder / "a" / PROFILE_NAME).read_text())
    cov = document["terms"]["geometry"]["fit"]["covariance"]
    cov["value"] = [-value for value in cov["value"]]
    broken = folder / "broken"
    broken.mkdir()
    for file in (folder / "a").iterdir():
        (broken / file.name).write_bytes(file.read_bytes())
    (broken / PROFILE_NAME).write_text(json.dumps(document))
    assert "Expected a covariance of the geometry estimates" in refused(folder / "a", broken)
    assert "Choose another folder" in refused(folder / "a", folder / "a", "--out", folder / "b.zip" / "out")
    before = sorted((folder / "a").iterdir())
    assert "inside the profile" in refused(folder / "a", folder / "b.zip", "--out", folder / "a")
    assert sorted((folder / "a").iterdir()) == before
