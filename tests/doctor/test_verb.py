"""The whole verb: the table for people, JSON and exit status for scripts."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.doctor.trees import BASLER, CONTROL, add_device, set_usb_memory
from tests.toy_rigs import change_rig, write_emulated_rig
from udccal.cli.jobs import doctor as job
from udccal.cli.output import Output
from udccal.displays.window_messages import Monitor
from udccal.doctor import cameras
from udccal.doctor import examine as examining
from udccal.doctor.answers import Failure, JaxDevice, SeenCamera
from udccal.doctor.displays import monitor_finding
from udccal.doctor.examine import Wanted, examine
from udccal.doctor.finding import Finding, Status
from udccal.doctor.machine import Machine
from udccal.doctor.questions import Question

TOPICS = [
    "Python",
    "packages",
    "cameras by u3v",
    "pylon SDK",
    "cameras by pylon",
    "USB speed",
    "USB permission",
    "USB memory",
    "monitors",
    "GPU",
    "JAX devices",
    "disk",
]
FINDINGS = (
    Finding("cameras by u3v", Status.OK, "Basler ace 1"),
    Finding("USB memory", Status.NOTE, "16 MB", "More:\necho 1000 | sudo tee " + "/a/long/path" * 20),
    Finding("disk", Status.PROBLEM, "1.0 GB free", "Free 2.0 GB more."),
)


def udccal(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "udccal.cli.main", "doctor", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=200)


def fake_ask(u3v: tuple[SeenCamera, ...] | Failure) -> Callable:
    answers = {Question.U3V: u3v, Question.PYLON: (), Question.JAX: (JaxDevice("cpu", "cpu"),)}
    return lambda question, read, seconds, words=(): answers[question]


@pytest.fixture
def wired(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    """A computer with a camera on a USB 2 port, one monitor, and Basler's SDK."""
    add_device(tmp_path, "1-1", BASLER | {"speed": "480"}, CONTROL)
    set_usb_memory(tmp_path, "16")
    monkeypatch.setattr(cameras, "version", lambda name: "26.9")
    monkeypatch.setattr(examining, "ask", fake_ask((SeenCamera("Basler ace 1"),)))
    monkeypatch.setattr(
        examining,
        "monitor_finding",
        lambda size, m: monitor_finding(size, m, lambda: (Monitor(0, 0, 0, 640, 480, 60),)),
    )
    return Machine(tmp_path, "linux", lambda path: True)


def test_all_topics_in_order_and_notes_alone_are_no_problem(wired: Machine) -> None:
    found = examine(Wanted(machine=wired))
    assert [finding.topic for finding in found] == TOPICS
    assert {f.topic for f in found if f.status is Status.NOTE} >= {"cameras by pylon", "USB speed", "USB memory"}
    assert Status.PROBLEM not in {finding.status for finding in found}


@pytest.mark.parametrize(
    ("camera", "monitor", "topics"),
    [
        ("sim", None, set()),
        ("u3v", 0, set()),
        ("pylon", None, {"cameras by pylon"}),
        (None, 3, {"monitors"}),
    ],
    ids=["sim", "all there", "pylon", "no such monitor"],
)
def test_what_was_asked_for_and_cannot_work_is_a_problem(
    wired: Machine, camera: str | None, monitor: int | None, topics: set[str]
) -> None:
    found = examine(Wanted(camera=camera, monitor=monitor, machine=wired))
    assert {finding.topic for finding in found if finding.status is Status.PROBLEM} == topics


@pytest.mark.parametrize("backend", ["u3v", "pylon"])
def test_a_camera_of_another_serial_number_is_a_problem(
    backend: str, wired: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = (SeenCamera("Basler ace 1", serial="1"),)
    answers = {Question.U3V: seen, Question.PYLON: seen, Question.JAX: (JaxDevice("cpu", "cpu"),)}
    monkeypatch.setattr(examining, "ask", lambda question, read, seconds, words=(): answers[question])
    for serial, problems in (("1", set()), ("2", {f"cameras by {backend}"})):
        found = examine(Wanted(camera=backend, serial=serial, machine=wired))
        assert {one.topic for one in found if one.status is Status.PROBLEM} == problems


def test_a_hanging_backend_is_one_row_and_the_others_are_there(wired: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(examining, "ask", fake_ask(Failure("no answer within 30 s")))
    found = {finding.topic: finding for finding in examine(Wanted(camera="u3v", machine=wired))}
    assert found["cameras by u3v"].status is Status.PROBLEM
    assert found["JAX devices"].status is Status.OK


def test_people_get_a_table_and_advice_that_can_be_pasted(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(job, "examine", lambda wanted: FINDINGS)
    assert not job.report(Output(), Wanted())
    out, err = capsys.readouterr()
    for finding in FINDINGS:
        assert finding.topic in out
        assert finding.found in out
    assert FINDINGS[1].advice in err  # commands are never broken across lines
    assert err.strip().endswith("Not ready: disk. Follow the advice above, then run this again.")


def test_scripts_get_json(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(job, "examine", lambda wanted: FINDINGS[:2])
    assert job.report(Output(as_json=True), Wanted())
    out, err = capsys.readouterr()
    summary = json.loads(out)
    assert summary["ready"] is True
    assert [finding["status"] for finding in summary["findings"]] == ["OK", "NOTE"]
    assert "No problem found" in err
    assert job.report(Output(as_json=True), Wanted(camera="sim"))
    assert capsys.readouterr().err.strip().endswith("Ready for what you asked for.")


@pytest.mark.medium
def test_the_exit_status_says_whether_what_was_asked_for_can_work(tmp_path: Path) -> None:
    done = udccal("--json", "--rig", "lg55-reduced", "--session", tmp_path / "session")
    summary = json.loads(done.stdout)
    assert done.returncode == (0 if summary["ready"] else 1)
    assert {"Python", "cameras by u3v", "monitors", "GPU", "JAX devices", "disk"} <= {
        finding["topic"] for finding in summary["findings"]
    }
    assert "Traceback" not in done.stderr
    file = tmp_path / "file"
    file.write_bytes(b"")
    refused = udccal("--json", "--rig", "lg55-reduced", "--session", file / "session")
    assert refused.returncode == 1
    assert json.loads(refused.stdout)["ready"] is False  # one object, and the only one
    assert "Not ready: " in refused.stderr


@pytest.mark.medium
@pytest.mark.parametrize(
    ("changes", "serial", "status", "said"),
    [
        ({}, "0815-0000", "OK", ""),
        ({"columns = 4096": "columns = 128"}, "", "PROBLEM", "Expected a camera of 128 x 4096"),
        ({"bits = 12": "bits = 14"}, "", "PROBLEM", "a pixel format of 14 bits and the pattern RGGB"),
        ({"frame_rate_hz = 120.0": "frame_rate_hz = 9000.0"}, "", "NOTE", "The rig says 9000 Hz"),
    ],
    ids=["fits", "size", "bits", "rate"],
)
def test_the_camera_is_opened_and_compared_with_the_rig(
    changes: dict[str, str], serial: str, status: str, said: str, tmp_path: Path, emulated_camera: None
) -> None:
    rig = write_emulated_rig(tmp_path)
    change_rig(rig, changes)
    words = ["--serial", serial] if serial else []
    done = udccal("--json", "--rig", rig, "--camera", "pylon", *words)
    summary = json.loads(done.stdout)
    (finding,) = [one for one in summary["findings"] if one["topic"] == "camera against rig"]
    assert finding["status"] == status, finding
    assert said in finding["advice"]
    assert summary["ready"] is (status != "PROBLEM")
    assert done.returncode == (1 if status == "PROBLEM" else 0)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--serial", "123"], "give --camera u3v or pylon with it"),
        (["--serial", "123", "--camera", "sim"], "give --camera u3v or pylon with it"),
        (["--monitor", "5"], "give --display window with it"),
        (["--monitor", "0", "--display", "manual"], "give --display window with it"),
    ],
)
def test_options_of_which_nothing_would_be_checked_are_refused(words: list[str], said: str) -> None:
    done = udccal(*words)
    assert done.returncode == 2
    assert said in " ".join(done.stderr.replace("│", " ").split())


def test_an_unknown_rig_is_one_sentence() -> None:
    done = udccal("--rig", "no-such-rig")
    assert done.returncode == 1
    assert done.stderr.startswith("udccal: Expected a rig folder")
