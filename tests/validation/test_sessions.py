"""Two sessions of one toy rig against each other: of two days, and of a rig that changed in between."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import udccal
from tests.reports.widths import layouts
from tests.toy_rigs import change_rig, write_toy_rig
from udccal.benches.bench import simulated_bench
from udccal.errors import SessionError
from udccal.sessions.schema import TermName
from udccal.simulation.disturbances import Disturbances, knock
from udccal.simulation.truth import RigTruth, draw_truth
from udccal.simulation.world import SimulatedWorld

pytestmark = pytest.mark.slow
# The part of the panel that the camera sees, and few pictures of it: quick to draw.
_SMALLER = {
    "columns = 1920": "columns = 240",
    "rows = 1080": "rows = 136",
    "panel_x_px = { value = 960.0": "panel_x_px = { value = 120.0",
    "panel_y_px = { value = 300.0": "panel_y_px = { value = 60.0",
    "backscatter_pictures = 8": "backscatter_pictures = 2",
}


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> RigTruth:
    rig = write_toy_rig(tmp_path_factory.mktemp("rig"))
    change_rig(rig, _SMALLER)
    return draw_truth(udccal.load_rig(rig), 0)


def captured(
    folder: Path,
    truth: RigTruth,
    day: int,
    disturbances: Disturbances | None = None,
    terms: tuple[TermName, ...] = ("noise", "wire", "backscatter"),
) -> udccal.Session:
    with simulated_bench(SimulatedWorld(truth, disturbances, seed=day)) as bench:
        return udccal.capture(folder, bench, terms=terms)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("with a space, µ")


@pytest.fixture(scope="module")
def first(folder: Path, truth: RigTruth) -> udccal.Session:
    return captured(folder / "first", truth, 1)


def failed(found: udccal.SessionComparison) -> set[str]:
    return {check.name for check in found.checks if check.ok is False}


def test_another_day_shows_the_same_rig(folder: Path, truth: RigTruth, first: udccal.Session) -> None:
    captured(folder / "second", truth, 2)
    words = ("--session", folder / "second", "--against", folder / "first", "--out", folder / "out", "--json")
    done = validate(*words)
    assert done.returncode == 0, done.stdout + done.stderr
    document = json.loads(done.stdout)
    assert document == json.loads((folder / "out" / "validation.json").read_text(encoding="utf-8"))
    assert (document["format"], document["ok"]) == ("udccal-session-comparison", True)
    assert all(check["what"].endswith(".") for check in document["checks"])
    # On a simulated rig the light is the same, so that noise explains everything.
    told = [check["value"] for check in document["checks"] if check["name"] == "chi-squared"]
    assert told == pytest.approx([1.0, 1.0], abs=0.15)
    page = (folder / "out" / "validation.html").read_text(encoding="utf-8")
    assert document["advice"] in page
    for layout in layouts(page, folder):
        assert not layout.sideways


def dimmed(truth: RigTruth) -> RigTruth:
    panel = truth.panel
    light = {name: 0.9 * getattr(panel, name) for name in ("leak_e_per_s", "reflection_e_per_s")}
    return replace(truth, panel=replace(panel, **light))


def amplified(truth: RigTruth) -> RigTruth:
    return replace(truth, sensor=replace(truth.sensor, K_DN_per_e=1.1 * truth.sensor.K_DN_per_e))


@pytest.mark.parametrize(
    ("term", "change", "disturbances", "check"),
    [
        ("wire", lambda truth: knock(truth, (0.0, 0.1, 0.0)), None, "flats, RMS"),
        (
            "wire",
            lambda truth: truth,
            Disturbances(smudge_fraction=0.05, smudge_px=(40.0, 50.0, 8.0)),
            "worst part of the sensor",
        ),
        ("backscatter", dimmed, None, "panel's brightness"),
        ("noise", amplified, None, "gain"),
    ],
    ids=["knocked", "smudged", "dimmed", "amplified"],
)
def test_a_changed_rig_fails_the_check_of_what_changed(
    tmp_path: Path,
    truth: RigTruth,
    first: udccal.Session,
    term: TermName,
    change: Callable[[RigTruth], RigTruth],
    disturbances: Disturbances | None,
    check: str,
) -> None:
    later = captured(tmp_path / "later", change(truth), 3, disturbances, (term,))
    found = udccal.compare_sessions(later, first)
    assert not found.ok
    assert check in failed(found), failed(found)
    assert found.advice.startswith("Calibrate the rig again")


def test_a_session_that_was_interrupted_is_compared_by_what_it_has(
    tmp_path: Path, truth: RigTruth, first: udccal.Session
) -> None:
    later = captured(tmp_path / "later", truth, 4, terms=("noise", "wire"))
    steps = tuple(step for step in later.manifest.steps if step.id != "wire/dark")
    interrupted = udccal.Session(later.path, later.manifest.model_copy(update={"steps": steps}))
    for found in (udccal.compare_sessions(interrupted, first), udccal.compare_sessions(first, interrupted)):
        assert found.ok
        assert {check.term for check in found.checks if check.ok} == {"noise"}
        (wire,) = (check for check in found.checks if check.term == "wire")
        assert (wire.name, wire.ok) == ("NOT_CAPTURED", None)
        assert wire.what.startswith("One of the sessions has captures of a part of this term.")
        assert "'wire/dark'" in wire.what


def test_the_same_session_twice_confirms_nothing(first: udccal.Session) -> None:
    with pytest.raises(SessionError, match="found the same one twice"):
        udccal.compare_sessions(first, first)


def test_another_specimen_is_refused(tmp_path: Path, truth: RigTruth, first: udccal.Session) -> None:
    with simulated_bench(SimulatedWorld(draw_truth(truth.description, 1))) as bench:
        other = udccal.capture(tmp_path / "other", bench, terms=("noise",))
    with pytest.raises(SessionError, match="found another camera"):
        udccal.compare_sessions(other, first)


def test_a_profile_and_another_session_together_are_refused(folder: Path) -> None:
    done = validate("lg55-reduced", "--session", folder, "--against", folder)
    assert done.returncode == 2
    assert "not both" in " ".join(done.stderr.replace("│", " ").split())


def validate(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "udccal.cli.main", "profile", "validate", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600)
