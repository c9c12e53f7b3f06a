"""Steps whose pictures lie in folders: those that cannot be right are refused, and captured steps captured once more.

The last step has no pictures, so that the command ends before it fits; a fit can do without that step.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from itertools import islice
from pathlib import Path
from typing import Any

import pytest

from tests.cli.step_pictures import photograph_steps
from tests.toy_rigs import RIGS, write_toy_rig
from udccal.plugins import find_procedure
from udccal.rig import load_rig
from udccal.sessions.schema import StoredStep
from udccal.sessions.store import Session

LAST = "noise/dark_7"
pytestmark = pytest.mark.medium


@pytest.fixture(scope="module")
def photographed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A toy rig, and the pictures of its noise term but for the last step."""
    folder = tmp_path_factory.mktemp("photographed")
    photograph_steps(load_rig(write_toy_rig(folder)), folder / "pictures")
    shutil.rmtree(folder / "pictures" / LAST)
    return folder


@pytest.fixture
def folder(photographed: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(photographed, tmp_path / "rig and pictures"))


def refused(folder: Path, *words: str, term: str = "noise") -> str:
    """Run the command, which fails at the last step at the latest, and return its sentence."""
    command = [
        "calibrate",
        "--rig",
        folder / "toy",
        "--camera",
        "files",
        "--files",
        folder / "pictures",
        "--term",
        term,
    ]
    command += ["--session", folder / "session", "--profile", folder / "profile", "--json", *words]
    done = subprocess.run(
        [sys.executable, "-m", "udccal.cli.main", *map(str, command)], capture_output=True, text=True, timeout=280
    )
    assert done.returncode == 1, done.stderr
    return json.loads(done.stdout)["error"]


def steps(folder: Path) -> dict[str, StoredStep]:
    return {step.id: step for step in Session.open(folder / "session").manifest.steps}


def times(table: Path, factor: float) -> None:
    """Multiply the exposures in a ``frames.csv``."""
    head, *lines = table.read_text().splitlines()
    changed = [f"{name},{factor * float(exposure_s)!r}" for name, exposure_s in (line.split(",") for line in lines)]
    table.write_text("\n".join((head, *changed)) + "\n")


def test_milliseconds_for_seconds_are_refused_at_their_step(folder: Path) -> None:
    table = folder / "pictures" / "noise" / "flat_2" / "frames.csv"
    times(table, 1000.0)
    sentence = refused(folder)
    assert sentence.startswith("Step noise/flat_2: Expected an exposure near 0.0051 s")
    assert "found 5.1 s: 1000 times too long" in sentence
    assert "milliseconds (ms)" in sentence
    assert list(steps(folder)) == ["noise/flat_stack", "noise/flat_0", "noise/flat_1"]
    times(table, 1e-3)
    assert f"the step {LAST}" in refused(folder)


def test_a_first_step_in_milliseconds_is_refused_though_nothing_came_before(folder: Path) -> None:
    table = folder / "pictures" / "noise" / "flat_stack" / "frames.csv"
    times(table, 1000.0)
    sentence = refused(folder)
    assert sentence.startswith("Step noise/flat_stack: Expected an exposure near 0.005 s, as follows from the light")
    assert "found 4.4 s: 880 times too long" in sentence
    assert not steps(folder)
    times(table, 1e-3)
    assert f"the step {LAST}" in refused(folder)


@pytest.mark.parametrize(("term", "missing"), [("psf", "psf/p00_s2"), ("geometry", "geometry/view_1")])
def test_milliseconds_at_an_led_or_a_board_are_refused(term: str, missing: str, tmp_path: Path) -> None:
    # The toy rig has too few pixels for a board.
    folder = write_toy_rig(tmp_path) if term == "psf" else shutil.copytree(RIGS / "lg55-reduced", tmp_path / "toy")
    rig = load_rig(folder)
    planned = list(islice(find_procedure(term)().steps(rig), 2))
    photograph_steps(rig, tmp_path / "pictures", planned)
    tables = [tmp_path / "pictures" / step.id / "frames.csv" for step in planned]
    for step, table in zip(planned, tables, strict=True):
        times(table, 1000.0)
        sentence = refused(tmp_path, term=term)
        assert sentence.startswith(f"Step {step.id}: Expected an exposure near "), sentence
        assert "times too long. Exposures are in seconds" in sentence
        assert step.id not in (steps(tmp_path) if (tmp_path / "session").exists() else {})
        times(table, 1e-3)
    for table in tables:  # a light twenty times fainter than usual is accepted
        times(table, 20.0)
    assert f"the step {missing}" in refused(tmp_path, term=term)
    assert list(steps(tmp_path)) == [step.id for step in planned]


def test_a_first_step_captured_again_takes_along_what_followed_from_it(folder: Path) -> None:
    assert f"the step {LAST}" in refused(folder)
    # Of another exposure than before, so that the steps at multiples of it are captured anew.
    before = steps(folder)
    for name in (
        "flat_stack",
        *(f"flat_{index}" for index in range(5)),
        "dark_stack",
        *(f"dark_{i}" for i in range(5)),
    ):
        times(folder / "pictures" / "noise" / name / "frames.csv", 1.5)
    assert f"the step {LAST}" in refused(folder, "--again", "noise/flat_stack")
    after = steps(folder)
    assert set(after) == set(before)
    changed = {name for name in after if after[name].captures[0].exposure_s != before[name].captures[0].exposure_s}
    assert changed == {name for name in after if name not in ("noise/dark_5", "noise/dark_6")}


def test_a_captured_step_is_captured_again_alone(folder: Path) -> None:
    assert f"the step {LAST}" in refused(folder)
    before, pictures = steps(folder), folder / "pictures" / "noise"
    first, second, *_ = sorted((pictures / "flat_3").glob("*.png"))
    shutil.copy(second, first)
    assert f"the step {LAST}" in refused(folder, "--again", "noise/flat_3")
    after = steps(folder)
    assert list(after) == list(before)
    assert [name for name in after if after[name] != before[name]] == ["noise/flat_3"]
    named = {capture.file for step in after.values() for capture in step.captures}
    assert {str(p.relative_to(folder / "session")) for p in (folder / "session" / "noise").iterdir()} == named
    assert f"the step {LAST}" in refused(folder)  # whole, and not asked for once more
    assert steps(folder) == after


def of_term(term: str, status: int, *words: object) -> dict[str, Any]:
    """Run a command that lists the terms of a profile, and return what it says of one."""
    command = [sys.executable, "-m", "udccal.cli.main", *map(str, words), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=280)
    assert done.returncode == status, done.stderr
    return next(each for each in json.loads(done.stdout)["terms"] if each["term"] == term)


@pytest.mark.slow
def test_a_step_that_a_fit_can_do_without_is_named_by_fit_report_and_profile(folder: Path) -> None:
    refused(folder)
    said = f"14 of 15 planned steps captured, without {LAST}."
    for words in (["fit", folder / "session", "--profile", folder / "p"], ["profile", "show", folder / "p"]):
        noise = of_term("noise", 0, *words)
        assert noise["status"] == "CONVERGED"
        assert said in noise["notes"]
    assert said in (folder / "p-report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_board_on_the_jig_alone_does_not_converge(tmp_path: Path) -> None:
    rig = load_rig(shutil.copytree(RIGS / "lg55-reduced", tmp_path / "toy"))
    photograph_steps(rig, tmp_path / "pictures", islice(find_procedure("geometry")().steps(rig), 1))
    assert "the step geometry/view_0" in refused(tmp_path, term="geometry")
    geometry = of_term("geometry", 3, "fit", tmp_path / "session", "--profile", tmp_path / "p")
    assert geometry["status"] == "TOO_FEW_DATA"
    assert any("Expected at least 3 usable views of the board held by hand, found 0" in n for n in geometry["notes"])
    assert any(n.startswith("1 of 7 planned steps captured, without geometry/view_0") for n in geometry["notes"])


def test_steps_that_cannot_be_captured_again_are_refused_and_change_nothing(folder: Path) -> None:
    assert "Expected a session" in refused(folder, "--again", "noise/flat_3")
    assert not (folder / "session").exists()
    refused(folder)
    before = (folder / "session" / "session.json").read_bytes()
    for step in (LAST, "../x"):
        assert f"Expected the step '{step}'" in refused(folder, "--again", step)
    assert "Did you mean noise/flat_3?" in refused(folder, "--again", "noise/flt_3")
    assert "Add --term noise" in refused(folder, "--again", "noise/flat_3", term="wire")
    assert (folder / "session" / "session.json").read_bytes() == before
    shutil.rmtree(folder / "pictures" / "noise" / "flat_3")
    assert "pictures of the step noise/flat_3" in refused(folder, "--again", "noise/flat_3")
    assert (folder / "session" / "session.json").read_bytes() == before
