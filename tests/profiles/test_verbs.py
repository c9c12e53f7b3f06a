"""``udccal profile log``, ``pack``, ``unpack``, ``migrate``, ``export`` and ``import`` as they are installed."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.profiles.exchange.test_ros_camera_info import CALIBRATOR
from tests.profiles.test_versions import written_in_version_2
from tests.toy_rigs import write_toy_rig
from udccal.profiles.profile import Profile
from udccal.profiles.schema import VERSION
from udccal.profiles.store import write_profile

pytestmark = pytest.mark.medium


def profile(*words: str | Path, status: int = 0) -> dict[str, Any]:
    """What the command prints as JSON; its status is checked."""
    command = [sys.executable, "-m", "udccal.cli.main", "profile", *map(str, words), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == status, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return dict(json.loads(done.stdout))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "with a space, µ"
    folder.mkdir()
    return folder


def test_an_old_profile_is_migrated_packed_and_unpacked_and_tells_so(folder: Path, toy_profile: Profile) -> None:
    written_in_version_2(folder / "old", toy_profile)
    migrated = profile("migrate", folder / "old", "--out", folder / "new")
    assert migrated["version"] == VERSION
    packed = profile("pack", folder / "new", folder / "new.zip")
    unpacked = profile("unpack", folder / "new.zip", folder / "again")
    assert packed["sha256"] == unpacked["sha256"] == migrated["sha256"]
    new, old = profile("log", folder / "again")["history"]
    assert (new["identity"]["version"], old["identity"]["version"]) == (VERSION, 2)
    assert new["parent"] == old["identity"]["sha256"]
    assert new["provenance"]["created_at"] == old["provenance"]["created_at"]
    assert not any(term["changed"] for term in new["terms"])


def test_an_exported_lens_is_imported(folder: Path) -> None:
    rig = write_toy_rig(folder)
    (folder / "camera.yaml").write_text(CALIBRATOR.replace(": 96", ": 128").replace(": 64", ": 96"))
    words = ["import", folder / "camera.yaml", "--from", "ros-camera-info", "--rig", rig, "--out", folder / "p"]
    assert "nominal" in profile(*words)["notes"][0]
    for to in ("opencv-yaml", "mrcal", "npz", "csv"):
        exported = profile("export", folder / "p", "--to", to, "--out", folder / "out" / to)
        assert Path(exported["file"]).is_file()
        assert Path(exported["covariance"]).is_file()
        assert exported["not_held"]
    shown = profile("show", folder / "p")
    assert [term["status"] for term in shown["terms"]] == ["NOT_CAPTURED", "IMPORTED", *["NOT_CAPTURED"] * 3]
    assert {one["name"]: one["value"] for one in shown["imported"]}.items() >= {"fx": 80.5, "fy": 81.0}.items()


def test_what_cannot_be_done_is_a_sentence(folder: Path, toy_profile: Profile) -> None:
    write_profile(folder.parent / "present", toy_profile)
    (folder / "letter.txt").write_text("Dear all")
    out = folder / "p"
    for words, sentence in (
        (("migrate", folder.parent / "present", "--out", out), "nothing to migrate"),
        (("pack", folder.parent / "present", folder / "letter.txt"), "ends in .zip"),
        (("pack", folder.parent / "present", folder / "letter.txt" / "p.zip"), "Choose another folder"),
        (("unpack", folder / "letter.txt", out), "whole zip file"),
        (("log", folder / "letter.txt"), "whole zip file"),
        (("export", folder.parent / "present", "--to", "csv", "--out", folder / "letter.txt"), "exists"),
        (("import", folder / "letter.txt", "--from", "mrcal", "--rig", "lg55-reduced", "--out", out), "camera model"),
        (("import", folder / "none", "--from", "mrcal", "--rig", "lg55-reduced", "--out", out), "found none"),
        (("import", folder / "letter.txt", "--from", "mrcal", "--rig", "lg55", "--out", out), "shipped rigs"),
    ):
        assert sentence in profile(*words, status=1)["error"], words
    assert [item.name for item in folder.iterdir()] == ["letter.txt"]
    assert (folder / "letter.txt").read_text() == "Dear all"
