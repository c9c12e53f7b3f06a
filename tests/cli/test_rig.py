"""Rigs by name: list, begin and check them, and what a wrong name is told."""

from __future__ import annotations

import errno
import json
import subprocess
import sys
from pathlib import Path

import pytest

from udccal.cli.jobs.rigs import list_rigs, new_rig
from udccal.cli.output import Output
from udccal.errors import RigError, UdccalError
from udccal.rig import load_rig
from udccal.rig_folders import shipped_rig_folder

pytestmark = pytest.mark.medium


@pytest.fixture
def rigs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The person's own folder of rigs, which does not exist yet."""
    folder = tmp_path / "my rigs é"
    monkeypatch.setenv("UDCCAL_RIGS", str(folder))
    return folder


def udccal(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "udccal.cli.main", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=280)


def refused(*words: str | Path) -> str:
    done = udccal(*words, "--json")
    assert done.returncode == 1
    return json.loads(done.stdout)["error"]


def test_a_rig_is_begun_listed_and_checked(rigs: Path) -> None:
    assert udccal("rig", "new", "lobby", "--like", "lg55-reduced").returncode == 0
    assert load_rig("lobby").model_copy(update={"name": "lg55-reduced"}) == load_rig("lg55-reduced")
    listed = {rig["name"]: rig for rig in json.loads(udccal("rig", "list", "--json").stdout)["rigs"]}
    assert listed["lobby"]["own"]
    assert listed["lobby"]["problem"] == ""
    assert not listed["lg55-aca2040"]["own"]
    done = udccal("rig", "check", "lobby", "--json")
    assert done.returncode == 0
    follows = {one["what"]: (one["value"], one["unit"]) for one in json.loads(done.stdout)["consequences"]}
    assert follows["diameter of the entrance pupil"] == (pytest.approx(6 / 1.85), "mm")
    assert follows["field of view, across"] == (pytest.approx(60.98, abs=0.01), "deg")
    assert follows["level of a full pixel"] == (pytest.approx(3969), "DN")


@pytest.mark.parametrize("line", ['name\t= "other"', '  name="other"', '"name" = "other"'])
def test_a_new_rig_has_its_own_name_however_the_other_is_written(tmp_path: Path, rigs: Path, line: str) -> None:
    text = (shipped_rig_folder() / "lg55-reduced" / "rig.toml").read_text(encoding="utf-8")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "rig.toml").write_text(text.replace('name = "lg55-reduced"', line), encoding="utf-8")
    new_rig(Output(as_json=True), "lobby", str(tmp_path / "other"))
    assert load_rig("lobby").name == "lobby"


def test_names_that_are_taken_or_none_are_refused(rigs: Path) -> None:
    assert udccal("rig", "new", "lobby").returncode == 0
    before = (rigs / "lobby" / "rig.toml").read_bytes()
    for name in ("lobby", "lg55-reduced"):
        assert "Expected a name that is free" in refused("rig", "new", name)
    for name in ("../up", "Lobby", "a b", "", "lobby\n"):
        assert "Expected a name of at most 64" in refused("rig", "new", name)
    assert "found none for 'strange'" in refused("rig", "new", "other", "--like", "strange")
    assert (rigs / "lobby" / "rig.toml").read_bytes() == before
    assert [path.name for path in rigs.iterdir()] == ["lobby"]


def test_a_folder_without_a_description_is_no_rig(rigs: Path) -> None:
    (rigs / "lobby").mkdir(parents=True)
    new_rig(Output(as_json=True), "lobby", "lg55-reduced")
    assert load_rig("lobby").name == "lobby"


def test_a_rig_that_cannot_be_written_leaves_no_folder(rigs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, content: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("udccal.cli.jobs.rigs.write_atomically", full)
    (rigs / "entrance").mkdir(parents=True)
    for name in ("lobby", "entrance"):
        with pytest.raises(UdccalError, match="No space left"):
            new_rig(Output(as_json=True), name, "lg55-reduced")
    # What was there before stays.
    assert [path.name for path in rigs.iterdir()] == ["entrance"]


def test_a_wrong_description_is_told_of_all_its_mistakes(rigs: Path) -> None:
    assert udccal("rig", "new", "lobby").returncode == 0
    file = rigs / "lobby" / "rig.toml"
    good = file.read_text(encoding="utf-8")
    file.write_text(good.replace("bits = 12", "bits = 99").replace("gamma = {", "gama = {"), encoding="utf-8")
    sentence = refused("rig", "check", "lobby")
    for place in ("panel.gamma", "panel.gama", "camera.bits"):
        assert place in sentence
    (listed,) = [rig for rig in json.loads(udccal("rig", "list", "--json").stdout)["rigs"] if rig["own"]]
    assert listed["problem"] == sentence
    file.write_text(good.replace("max_exposure_s = 10.0", "max_exposure_s = 1e-6"), encoding="utf-8")
    assert "longer than the longest" in refused("rig", "check", "lobby")
    file.write_text(good.replace("columns = 2048", "columns = 2047"), encoding="utf-8")
    assert "Give 2046 x 1536" in refused("rig", "check", "lobby")


def test_a_description_that_cannot_be_read_is_listed_with_the_others(
    rigs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("lobby", "entrance"):
        new_rig(Output(as_json=True), name, "lg55-reduced")
    capsys.readouterr()
    read = Path.read_bytes

    def read_but_one(path: Path) -> bytes:
        if path.parent.name == "lobby":
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", read_but_one)
    list_rigs(Output(as_json=True))
    listed = {rig["name"]: rig["problem"] for rig in json.loads(capsys.readouterr().out)["rigs"]}
    assert {name for name, problem in listed.items() if problem} == {"lobby"}
    assert f"Expected to read {rigs / 'lobby' / 'rig.toml'}, found: Permission denied." in listed["lobby"]


def test_a_wrong_name_is_told_the_nearest_and_the_own_rigs(rigs: Path) -> None:
    for name in ("lobby", "entrance"):
        assert udccal("rig", "new", name).returncode == 0
    sentence = refused("calibrate", "--rig", "loby", "--session", rigs / "s", "--profile", rigs / "p")
    assert "found none for 'loby'. Did you mean lobby?" in sentence
    assert "one of your own (entrance, lobby)" in sentence
    assert "lg55-reduced" in sentence
    with pytest.raises(RigError, match=r"none for 'zzz'\. Give a path"):
        load_rig("zzz")
