"""What a person sees when something goes wrong: one sentence, a non-zero exit status, no traceback without --debug."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import typer
from typer.main import get_command

from udccal.cameras.protocol import CameraIdentity
from udccal.cli.app import app
from udccal.cli.bench_options import BenchOptions, CameraKind, DisplayKind
from udccal.cli.jobs.plan import plan_captures
from udccal.cli.jobs.simulate import simulate_files
from udccal.cli.jobs.validate import validate_profile, validate_session
from udccal.cli.output import Output
from udccal.cli.run import run
from udccal.errors import UdccalError
from udccal.io.png import write_rgb8
from udccal.rig import load_rig
from udccal.sessions.writer import SessionWriter

PORTRAIT = str(Path(__file__).resolve().parents[2] / "udccal" / "data" / "portrait.jpg")


def udccal(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "udccal.cli.main", *words], capture_output=True, text=True, timeout=280
    )


def broken_session(folder: Path) -> Path:
    folder.mkdir()
    (folder / "session.json").write_text('{"format": "udccal-session", "version": 1')
    return folder


def nested_rig(folder: Path) -> Path:
    folder.mkdir()
    (folder / "rig.toml").write_text("name = " + "[" * 100_000)
    return folder


FAILURES = {
    "a rig of lists in lists": lambda tmp: (["rig", "check", str(nested_rig(tmp / "r"))], "rig"),
    "a name of 5000 letters": lambda tmp: (["rig", "check", "r" * 5000], "File name too long"),
    "a path of 5000 letters": lambda tmp: (["fit", "s" * 5000, "--profile", str(tmp / "p")], "File name too long"),
    "no session": lambda tmp: (["fit", str(tmp / "absent"), "--profile", str(tmp / "p")], "Expected"),
    "broken session": lambda tmp: (["fit", str(broken_session(tmp / "s")), "--profile", str(tmp / "p")], "session"),
    "no profile": lambda tmp: (["profile", "show", str(tmp / "absent")], "profile.json"),
    "nothing to prepare": lambda tmp: (["profile", "prepare", str(tmp / "absent")], "profile.json"),
    "no rig": lambda tmp: (
        ["calibrate", "--rig", "no-such-rig", "--session", str(tmp / "s"), "--profile", str(tmp / "p")],
        "lg55-reduced",
    ),
    "no photograph": lambda tmp: (
        ["simulate", str(tmp / "absent.jpg"), "--rig", "lg55-reduced", "--out", str(tmp / "o")],
        "absent.jpg",
    ),
}


@pytest.mark.parametrize("case", FAILURES, ids=str)
def test_a_failure_is_one_sentence(case: str, tmp_path: Path) -> None:
    words, said = FAILURES[case](tmp_path)
    done = udccal(*words)
    assert done.returncode == 1, done.stderr
    sentence = done.stderr.strip().splitlines()[-1]
    assert sentence.startswith("udccal: Expected")
    assert said in sentence
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert not (tmp_path / "p").exists()
    assert not (tmp_path / "o").exists()


@pytest.mark.medium
def test_with_json_the_failure_is_json_and_with_debug_there_is_a_traceback(tmp_path: Path) -> None:
    done = udccal("profile", "show", str(tmp_path), "--json", "--debug")
    assert done.returncode == 1
    assert "profile.json" in json.loads(done.stdout)["error"]
    assert "Traceback" in done.stderr


def test_with_events_the_failure_is_the_last_event(tmp_path: Path) -> None:
    places = ["--session", str(tmp_path / "s"), "--profile", str(tmp_path / "p")]
    done = udccal("calibrate", "--rig", "no-such-rig", *places, "--practice", "--json-events")
    assert done.returncode == 1
    assert "no-such-rig" in json.loads(done.stdout.splitlines()[-1])["error"]


@pytest.mark.parametrize("words", [["restore"], ["calibrate", "--rig", "lg55-reduced"], ["nonsense"]], ids=str)
def test_wrong_words_leave_with_status_2(words: list[str]) -> None:
    done = udccal(*words)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr


def test_wrong_words_are_an_object_for_a_program() -> None:
    done = udccal("profile", "diff", "lg55-reduced", "--json")
    assert done.returncode == 2
    assert "Missing argument" in json.loads(done.stdout)["error"]


def test_a_session_within_the_profile_is_refused(tmp_path: Path) -> None:
    places = ["--session", str(tmp_path / "p" / "s"), "--profile", str(tmp_path / "p")]
    assert udccal("calibrate", "--rig", "lg55-reduced", *places).returncode == 2
    assert not any(tmp_path.iterdir())


def test_profiles_are_not_written_into_a_session(tmp_path: Path) -> None:
    session, within = str(tmp_path / "s"), str(tmp_path / "s" / "p")
    new = str(tmp_path / "new")
    SessionWriter.create(tmp_path / "s", load_rig("lg55-reduced"), CameraIdentity("a", "b", "c", "d")).close()
    before = sorted(tmp_path.rglob("*"))
    for words, said in (
        (["fit", session, "--profile", within], "inside the session"),
        (["calibrate", "--rig", "lg55-reduced", "--session", session, "--profile", within], "inside the session"),
        (["calibrate", "--rig", "lg55-reduced", "--session", new, "--profile", f"{new}/p"], f"apart from {new}"),
        (["profile", "pack", "no-profile", f"{within}.zip"], "inside the session"),
        (["profile", "export", "no-profile", "--to", "csv", "--out", within], "inside the session"),
        (["profile", "import", "no-file", "--from", "mrcal", "--rig", "lg55-reduced", "--out", within], "the session"),
    ):
        done = udccal(*words)
        assert done.returncode == 1
        (sentence,) = done.stderr.strip().splitlines()  # no stage has run
        assert said in sentence
    assert sorted(tmp_path.rglob("*")) == before


SIMULATED = BenchOptions(CameraKind.sim, None, None, DisplayKind.manual, 0, 0)
REAL = replace(SIMULATED, camera=CameraKind.u3v)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        (replace(SIMULATED, files=Path("pictures")), "--files"),
        (replace(SIMULATED, serial="40012345"), "--serial"),
        (replace(SIMULATED, display=DisplayKind.window), "--display"),
        (replace(SIMULATED, monitor=7), "--monitor"),
        (replace(REAL, seed=3), "--seed"),
        (replace(REAL, noise_seed=0), "--noise-seed"),
    ],
)
def test_words_that_would_go_unheard_are_refused(options: BenchOptions, name: str) -> None:
    with pytest.raises(typer.BadParameter, match=f"{name} is for --camera .* found {options.camera}"):
        options.check_words({})


def test_words_of_every_camera_are_heard() -> None:
    for options in (
        replace(SIMULATED, seed=3, noise_seed=0),
        replace(REAL, serial="40012345", display=DisplayKind.window, monitor=7),
        replace(SIMULATED, camera=CameraKind.files, files=Path("pictures")),
    ):
        options.check_words({})


def test_photographs_of_one_name_are_refused(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    pictures = [tmp_path / "a.jpg", tmp_path / "b" / "a.jpeg"]
    with pytest.raises(UdccalError, match=r"a-mosaic\.png for .*a\.jpeg is taken by"):
        simulate_files(Output(), pictures, "lg55-reduced", tmp_path / "out", None, 0)
    assert not (tmp_path / "out").exists()


def test_photographs_are_read_before_any_is_simulated(tmp_path: Path) -> None:
    write_rgb8(tmp_path / "good.png", np.full((8, 8, 3), 90, np.uint8))
    (tmp_path / "bad.png").write_text("no picture")
    pictures = [tmp_path / "good.png", tmp_path / "bad.png"]
    with pytest.raises(UdccalError, match=r"bad\.png .* found another kind\. Convert it"):
        simulate_files(Output(), pictures, "lg55-reduced", tmp_path / "out", None, 0)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("option", "given"),
    [
        ("--serial", {"camera": CameraKind.files, "serial": "1"}),
        ("--seed", {"camera": CameraKind.files, "seed": 0}),
        ("--mirror-delay-ms", {"mirror_delay_ms": 25.0}),
        ("--hook-ms", {"hook_ms": 10.0}),
        ("--panel-picture", {"camera": CameraKind.u3v, "panel_picture": Path("a.png")}),
    ],
)
def test_options_of_run_without_effect_are_wrong_words(option: str, given: dict[str, Any]) -> None:
    with pytest.raises(typer.BadParameter, match="does nothing without") as refused:
        run(MagicMock(spec=typer.Context), Path("p"), "shm:a", **given)
    assert refused.value.param_hint == f"'{option}'"


@pytest.mark.parametrize(
    ("verb", "option", "value"),
    [
        ("restore", "--min-psnr", "nan"),
        ("restore", "--min-psnr", "-1"),
        ("restore", "--exposure-s", "inf"),
        ("run", "--exposure-s", "inf"),
    ],
)
def test_numbers_that_are_none_are_wrong_words(verb: str, option: str, value: str) -> None:
    command = vars(get_command(app))["commands"][verb]
    (parameter,) = (each for each in command.params if option in each.opts)
    with pytest.raises(typer.BadParameter):
        parameter.process_value(command.context_class(command), value)


def test_an_export_needs_a_name() -> None:
    done = udccal("profile", "export", "lg55-reduced", "--to", "csv", "--out", "/")
    assert done.returncode == 1
    assert "found that / exists" in done.stderr


def test_a_bug_asks_for_debug_and_shows_no_traceback() -> None:
    code = (
        "import udccal.cli.jobs.show as job\n"
        "def broken(*_): raise ZeroDivisionError('secret')\n"
        "job.show_profile = broken\n"
        "from udccal.cli.main import main\n"
        "main(['profile', 'show', 'anything'])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=280)
    assert done.returncode == 70
    assert "--debug" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("kind", ["profile", "session"])
def test_results_are_not_written_among_the_files_of_a_profile_or_a_session(tmp_path: Path, kind: str) -> None:
    out = tmp_path / "place"
    out.mkdir()
    (out / f"{kind}.json").write_text("{}")
    for work in (
        lambda: simulate_files(Output(), [], "lg55-reduced", out / "new", None, 0),
        lambda: validate_profile(Output(), Path("no-profile"), Path("no-session"), out),
        lambda: validate_session(Output(), Path("no-session"), Path("no-session"), out),
        lambda: plan_captures(Output(), "lg55-reduced", ["wire=0.05%"], None, out / "rig.toml"),
    ):
        with pytest.raises(UdccalError, match=f"inside the {kind} "):
            work()
    assert [file.name for file in out.iterdir()] == [f"{kind}.json"]
