"""Verbs one after the other on a toy rig of which only the noise is captured: the other terms are absent."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.reports.widths import layouts
from tests.toy_rigs import write_toy_rig
from udccal.io.exr import read_rgb_exr
from udccal.io.png import read_png16, read_rgb8, write_png16
from udccal.profiles.provenance import profile_sha256

PORTRAIT = Path(__file__).resolve().parents[2] / "udccal" / "data" / "portrait.jpg"
pytestmark = pytest.mark.slow


def udccal(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "udccal.cli.main", *map(str, words), "--json"]
    return subprocess.run(command, capture_output=True, text=True, timeout=800)


def headline(report: str) -> str:
    return report.partition('<h2 class="verdict">')[2].partition("</h2>")[0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a toy rig, its session and its profile."""
    folder = tmp_path_factory.mktemp("verbs")
    rig = write_toy_rig(folder)
    done = udccal(
        "calibrate", "--rig", rig, "--session", folder / "session", "--profile", folder / "profile", "--term", "noise"
    )
    assert done.returncode == 0, done.stderr
    status = {term["term"]: term["status"] for term in json.loads(done.stdout)["terms"]}
    assert status.pop("noise") == "CONVERGED"
    assert set(status.values()) == {"NOT_CAPTURED"}
    report = (folder / "profile-report.html").read_text(encoding="utf-8")
    counted = "1 of 5 terms measured, and can be used: noise. Not captured: geometry, wire, psf, backscatter."
    assert headline(report) == counted
    assert counted in done.stderr
    assert "no sign of this term" not in report
    assert report.count("Nobody looked") == 4
    return folder


@pytest.fixture(scope="module")
def mosaic(folder: Path) -> tuple[Path, float]:
    """A simulated frame of the toy rig, and its exposure."""
    done = udccal("simulate", PORTRAIT, "--rig", folder / "toy", "--out", folder / "simulated")
    assert done.returncode == 0, done.stderr
    (made,) = json.loads(done.stdout)["files"]
    assert read_rgb8(Path(made["ideal"])).shape == (68, 120, 3)
    assert read_rgb8(Path(made["preview"])).shape == (48, 64, 3)
    return Path(made["mosaic"]), made["exposure_s"]


def test_the_reports_tables_stay_in_their_cards(folder: Path, tmp_path: Path) -> None:
    for layout in layouts((folder / "profile-report.html").read_text(encoding="utf-8"), tmp_path):
        assert not layout.sideways
        assert layout.outside == ()


def test_restore_writes_display_and_linear_pictures(folder: Path, mosaic: tuple[Path, float]) -> None:
    path, exposure_s = mosaic
    words = ["restore", path, "--profile", folder / "profile", "--out", folder / "out", "--exposure-s", str(exposure_s)]
    for kind in ("png", "exr"):
        done = udccal(*words, "--format", kind)
        assert done.returncode == 0, done.stderr
    shown = read_rgb8(folder / "out" / f"{path.stem}.png")
    linear = read_rgb_exr(folder / "out" / f"{path.stem}.exr")
    assert shown.shape == linear.shape == (68, 120, 3)
    assert shown.std() > 20
    assert linear.mean() > 1e4  # e-/s


def test_frames_that_do_not_fit_are_refused(folder: Path, mosaic: tuple[Path, float]) -> None:
    path, exposure_s = mosaic
    small, bright = folder / "small.png", folder / "bright.png"
    write_png16(small, read_png16(path)[::2, ::2].copy())
    write_png16(bright, np.full((96, 128), 5000, np.uint16))
    common = ["--profile", folder / "profile", "--out", folder / "refused"]
    for words, said in (
        ([small, "--exposure-s", str(exposure_s)], "128 x 96"),
        ([bright, "--exposure-s", str(exposure_s)], "4095"),
        ([path], "--exposure-s"),
        ([path, small, "--exposure-s", str(exposure_s)], "128 x 96"),
    ):
        done = udccal("restore", *words, *common)
        assert done.returncode == 1
        assert said in json.loads(done.stdout)["error"]
        assert not (folder / "refused").exists()


def test_profile_show_lists_what_was_measured(folder: Path) -> None:
    done = udccal("profile", "show", folder / "profile")
    shown = json.loads(done.stdout)
    assert shown["rig"] == "toy"
    assert "K_DN_per_e" in {estimate["name"] for estimate in shown["estimates"]}
    assert [term["status"] for term in shown["terms"]] == ["CONVERGED", *(4 * ["NOT_CAPTURED"])]
    assert done.stderr.count(": Nobody looked: the session has no captures of this term, or too few.") == 4
    noise = shown["terms"][0]
    assert (len(noise["captures"]["sha256"]), noise["effort"]) == (64, "full")
    assert noise["captures"]["frames"] >= noise["captures"]["files"] > 0
    assert noise["captures"]["temperature_C"] == [35.0, 35.0]
    assert "The noise fit used" in done.stderr
    assert " dB at 35 °C, captured" in " ".join(done.stderr.split())
    assert shown["estimates"][0]["what"] == "Digital numbers per electron (EMVA 1288: K)."
    assert (shown["rig_state"]["terms"], len(shown["rig_state"]["estimates"])) == ([], 11)


def test_a_profile_from_before_that_status_is_read_as_what_it_says(folder: Path) -> None:
    """A term without captures was called ABSENT, with a note that says why; a term that was looked for stays absent."""
    old = Path(shutil.copytree(folder / "profile", folder / "old"))
    stored = json.loads((old / "profile.json").read_text())
    for name in ("wire", "psf"):
        stored["terms"][name]["fit"]["status"] = "ABSENT"
    stored["terms"]["wire"]["fit"]["notes"] = ["The session has no wire steps; the term has the rig's nominal values."]
    stored["terms"]["psf"]["fit"]["notes"] = ["No modulation by rows is visible."]
    (old / "profile.json").write_text(json.dumps(stored))
    shown = {term["term"]: term["status"] for term in json.loads(udccal("profile", "show", old).stdout)["terms"]}
    assert shown["wire"] == "NOT_CAPTURED"
    assert shown["psf"] == "ABSENT"
    stored["terms"]["wire"]["fit"]["status"] = "NOBODY_CAME"
    (old / "profile.json").write_text(json.dumps(stored))
    refused = udccal("profile", "show", old)
    assert refused.returncode == 1
    assert "found 'NOBODY_CAME'" in json.loads(refused.stdout)["error"]


def test_one_term_is_fitted_again_and_the_others_are_kept(folder: Path) -> None:
    before = json.loads((folder / "profile" / "profile.json").read_text())
    parent = profile_sha256(folder / "profile")
    done = udccal("fit", folder / "session", "--profile", folder / "profile", "--term", "wire", "--term", "psf")
    assert done.returncode == 0, done.stderr
    terms = {term["term"]: term for term in json.loads(done.stdout)["terms"]}
    assert terms["noise"]["status"] == "CONVERGED"
    assert "Fitted with an earlier wire term." in terms["backscatter"]["notes"]
    after = json.loads((folder / "profile" / "profile.json").read_text())
    assert after["terms"]["noise"] == before["terms"]["noise"]
    assert (before["lineage"]["parent"], after["lineage"]["parent"]) == (None, parent)
    strange = json.loads((folder / "session" / "session.json").read_text())
    other = Path(shutil.copytree(folder / "session", folder / "other"))
    del strange["manifest_sha256"]
    (other / "session.json").write_text(json.dumps(strange))
    refused = udccal("fit", other, "--profile", folder / "profile", "--term", "wire")
    assert refused.returncode == 1
    assert "another session" in json.loads(refused.stdout)["error"]
    assert json.loads((folder / "profile" / "profile.json").read_text()) == after


def test_a_damaged_session_leaves_the_profile_as_it_was(folder: Path) -> None:
    before = (folder / "profile" / "profile.json").read_bytes()
    (folder / "session" / "noise" / "flat_0_0.png").write_bytes(b"broken")
    done = udccal("fit", folder / "session", "--profile", folder / "profile")
    assert done.returncode == 1
    assert "SHA-256" in json.loads(done.stdout)["error"]
    assert (folder / "profile" / "profile.json").read_bytes() == before
