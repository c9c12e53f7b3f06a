"""``udccal profile validate`` as it is installed, on a toy rig whose noise alone is captured, on two days."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

import udccal
from tests.comparison.perturbed import with_estimates, with_result
from tests.reports.widths import layouts
from tests.toy_rigs import write_toy_rig
from udccal.benches.bench import simulated_bench
from udccal.profiles.store import load_profile, write_profile
from udccal.result import FitStatus
from udccal.simulation.truth import draw_truth
from udccal.simulation.world import SimulatedWorld

pytestmark = pytest.mark.slow


def validate(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "udccal.cli.main", "profile", "validate", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A profile of the first day, and sessions of both days."""
    folder = tmp_path_factory.mktemp("with a space, µ")
    truth = draw_truth(udccal.load_rig(write_toy_rig(folder)), 0)
    for day in ("first", "second"):
        with simulated_bench(SimulatedWorld(truth, seed=len(day))) as bench:
            session = udccal.capture(folder / day, bench, terms=("noise",))
        if day == "first":
            udccal.calibrate(session).write(folder / "profile")
    profile = load_profile(folder / "profile")
    K = float(profile.noise.term.K_DN_per_e)
    more = replace(profile.noise.term, K_DN_per_e=1.1 * profile.noise.term.K_DN_per_e)
    wrong = with_estimates(with_result(profile, "noise", term=more), "noise", {"K_DN_per_e": 0.1 * K})
    write_profile(folder / "wrong", wrong)
    return folder


def test_another_day_is_predicted_and_terms_without_captures_are_not_counted(folder: Path) -> None:
    out = folder / "out" / "deep"
    done = validate(folder / "profile", "--session", folder / "second", "--out", out, "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document == json.loads((out / "validation.json").read_text(encoding="utf-8"))
    assert (document["ok"], document["own_terms"], document["partly_own_terms"]) == (True, [], [])
    for check in document["checks"]:
        assert list(check) == ["term", "name", "value", "limit", "unit", "ok", "what"]
        assert check["what"].endswith(".")
    named = {check["term"]: check["name"] for check in document["checks"] if check["ok"] is None}
    assert named == dict.fromkeys(("geometry", "wire", "psf", "backscatter"), "NOT_CAPTURED")
    page = (out / "validation.html").read_text(encoding="utf-8")
    assert document["advice"] in page.replace("&#39;", "'")
    assert not re.findall(r"(?:src|href)=\"(?!data:|#)", page)
    assert page.count("<img ") == 1
    for layout in layouts(page, folder):
        assert not layout.sideways


def test_a_gain_of_10_percent_more_has_status_3(folder: Path) -> None:
    done = validate(folder / "wrong", "--session", folder / "second")
    assert done.returncode == 3, done.stderr
    assert done.stdout.startswith("Do not rely on noise of this profile")
    grows = re.search(r"their mean ([\d.]+) times as fast", done.stdout)
    assert grows is not None, done.stdout
    assert float(grows[1]) == pytest.approx(1 / 1.1, abs=0.03)


def test_a_full_disk_is_said_and_nothing_is_left(folder: Path, nearly_full: Path) -> None:
    words = folder / "profile", "--session", folder / "second", "--out", nearly_full / "v"
    sentence = refused(*words)
    assert "No space left on device" in sentence
    assert [file.name for file in nearly_full.rglob("*") if file.is_file()] == ["other"]


def test_two_at_once_leave_one_whole_result(folder: Path, tmp_path: Path) -> None:
    words = folder / "profile", "--session", folder / "second", "--out", tmp_path / "v"
    with ThreadPoolExecutor(2) as pool:
        both = list(pool.map(lambda _: validate(*words), range(2)))
    assert {done.returncode for done in both} <= {0, 1}
    assert 0 in {done.returncode for done in both}
    assert sorted(file.name for file in (tmp_path / "v").iterdir()) == ["validation.html", "validation.json"]
    assert json.loads((tmp_path / "v" / "validation.json").read_text(encoding="utf-8"))["ok"]


def test_the_profiles_own_session_confirms_nothing(folder: Path) -> None:
    found = udccal.validate(load_profile(folder / "profile"), udccal.Session.open(folder / "first"))
    counted = {check.term for check in found.checks if check.ok is not None}
    assert set(found.own_terms) >= counted
    assert "capture others" in found.advice


def test_a_profile_that_names_no_captures_is_known_by_its_session(folder: Path) -> None:
    profile = with_result(load_profile(folder / "profile"), "noise", captures=None)
    first, second = (udccal.validate(profile, udccal.Session.open(folder / day)) for day in ("first", "second"))
    assert (first.own_terms, second.own_terms) == (("noise",), ())


def test_captures_stay_the_profiles_own_where_the_session_gains_others(folder: Path) -> None:
    profile, more = load_profile(folder / "profile"), folder / "first, and more"
    shutil.copytree(folder / "first", more)
    truth = draw_truth(profile.rig, 0)
    with simulated_bench(SimulatedWorld(truth, seed=len("first"))) as bench:
        session = udccal.capture(more, bench, terms=("noise", "wire"))
    assert len(session.steps("wire"))
    assert udccal.validate(profile, session).own_terms == ("noise",)


def test_a_session_with_one_step_captured_again_is_partly_the_profiles_own(folder: Path) -> None:
    profile = load_profile(folder / "profile")
    first, second = (udccal.Session.open(folder / day) for day in ("first", "second"))
    taken, other = first.steps("noise"), second.steps("noise")
    mixed = first.manifest.model_copy(update={"steps": (*taken[:-1], other[-1])})
    shutil.copytree(folder / "first", folder / "mixed")
    for capture in other[-1].captures:
        shutil.copy(second.path / capture.file, folder / "mixed" / capture.file)
    found = udccal.validate(profile, udccal.Session(folder / "mixed", mixed))
    assert (found.own_terms, found.partly_own_terms) == ((), ("noise",))
    (note,) = (check for check in found.checks if check.name == "captures of the profile's fit")
    assert f"fitted to {len(taken) - 1} of the {len(taken)} steps" in note.what
    assert note.ok is None
    assert "at least in part" in found.advice


def test_a_term_without_its_dark_frames_is_not_counted(folder: Path) -> None:
    profile = with_result(load_profile(folder / "profile"), "wire", status=FitStatus.CONVERGED)
    with simulated_bench(SimulatedWorld(draw_truth(profile.rig, 0), seed=7)) as bench:
        session = udccal.capture(folder / "third", bench, terms=("noise", "wire"))
    steps = tuple(step for step in session.manifest.steps if step.id != "wire/dark")
    assert len(steps) < len(session.manifest.steps)
    partial = udccal.Session(session.path, session.manifest.model_copy(update={"steps": steps}))
    found = udccal.validate(profile, partial)
    assert found.ok
    (wire,) = (check for check in found.checks if check.term == "wire")
    assert (wire.name, wire.ok) == ("NOT_CAPTURED", None)
    assert "Expected the step 'wire/dark'" in wire.what


def refused(*words: str | Path) -> str:
    done = validate(*words, "--json")
    assert done.returncode == 1, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return str(json.loads(done.stdout)["error"])


def test_what_cannot_be_compared_is_refused_in_a_sentence(folder: Path) -> None:
    session = ("--session", folder / "second")
    assert "found another rig: toy in the session, lg55-reduced in the profile" in refused("lg55-reduced", *session)
    assert "found none" in refused(folder / "missing", *session)
    assert "session" in refused(folder / "profile", "--session", folder / "missing")
    into = folder / "toy" / "rig.toml" / "out"
    assert "Choose another folder" in refused(folder / "profile", *session, "--out", into)
