"""A child process that answers, refuses, hangs, crashes, or answers nonsense."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

import pytest

from udccal.doctor import ask as asking
from udccal.doctor.answers import Failure, JaxDevice, SeenCamera, read_cameras, read_devices
from udccal.doctor.ask import ask, ask_command
from udccal.doctor.child import FAILED
from udccal.doctor.questions import Question


def child(code: str, seconds: float = 20.0) -> tuple[SeenCamera, ...] | Failure:
    return ask_command([sys.executable, "-c", f"import sys\nfile = sys.argv[1]\n{code}"], read_cameras, seconds)


def test_an_answer_is_read_back() -> None:
    cameras = [{"name": "A", "too_slow": True, "trouble": ""}, {"name": "B"}]
    answer = child(f"print('noise' * 100000)\nopen(file, 'w').write({json.dumps(cameras)!r})")
    assert answer == (SeenCamera("A", too_slow=True), SeenCamera("B"))


def test_a_refusal_is_the_sentence_itself() -> None:
    failure = json.dumps({"reason": "Expected a, found b." + "x" * 1000, "refused": True})
    answer = child(f"open(file, 'w').write({failure!r})\nsys.exit({FAILED})")
    assert isinstance(answer, Failure)
    assert answer.refused
    assert answer.reason.startswith("Expected a, found b.")
    assert len(answer.reason) == 500


@pytest.mark.medium
def test_hanging_ends_in_bounded_time_with_all_that_was_started(tmp_path: Path) -> None:
    note = tmp_path / "grandchild"
    code = (
        "import subprocess, time\n"
        "started = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])\n"
        f"open({str(note)!r}, 'w').write(str(started.pid))\n"
        "time.sleep(600)\n"
    )
    start = time.monotonic()
    assert child(code, seconds=3.0) == Failure("no answer within 3 s")
    assert time.monotonic() - start < 15
    grandchild = Path(f"/proc/{note.read_text()}/stat")
    end = time.monotonic() + 10
    while grandchild.exists() and grandchild.read_text().split()[2] != "Z" and time.monotonic() < end:
        time.sleep(0.05)
    assert not grandchild.exists() or grandchild.read_text().split()[2] == "Z"  # dead, perhaps not yet buried


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "signal SIGSEGV"),
        ("sys.exit(7)", "exit status 7"),
        ("pass", "exit status 0"),
        ("open(file, 'w').write('{')", "exit status 0"),
        ("open(file, 'w').write('[{\"no_name\": 1}]')", "exit status 0"),
        ("open(file, 'w').write('[' * 2000000)", "exit status 0"),
        (f"open(file, 'w').write('[]')\nsys.exit({FAILED})", f"exit status {FAILED}"),
    ],
    ids=["crash", "status", "silent", "cut short", "other", "huge", "wrong kind"],
)
def test_breaking_down_is_a_failure(code: str, said: str) -> None:
    assert child(code) == Failure(f"it failed ({said})")


def test_jax_answers_from_a_real_child() -> None:
    answer = ask(Question.JAX, read_devices, 120.0)
    assert isinstance(answer, tuple)
    assert all(isinstance(device, JaxDevice) for device in answer)
    assert answer


def test_a_missing_package_is_a_failure(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "jax.py").write_text("raise ImportError('no such thing here')", encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    assert ask(Question.JAX, read_devices, 60.0) == Failure("ImportError: no such thing here")


def test_camera_backends_answer_from_a_real_child() -> None:
    for question in (Question.U3V, Question.PYLON):
        answer = ask(question, read_cameras, 60.0)
        assert isinstance(answer, tuple) or answer.refused, answer


def test_the_child_is_killed_when_the_doctor_is_interrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[int] = []

    def interrupted(self: object, timeout: float | None = None) -> int:
        if not started:
            started.append(self.pid)  # type: ignore[attr-defined]
            raise KeyboardInterrupt
        return waited(self, timeout)  # type: ignore[arg-type]

    waited = asking.subprocess.Popen.wait
    monkeypatch.setattr(asking.subprocess.Popen, "wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        child("import time; time.sleep(600)")
    with pytest.raises(ProcessLookupError):
        os.kill(started[0], 0)
