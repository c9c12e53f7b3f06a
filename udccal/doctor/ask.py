"""Asks a child process, so that software which hangs or crashes is a finding and does not end the doctor."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from udccal.doctor.answers import Failure, read_failure
from udccal.doctor.child import FAILED
from udccal.doctor.questions import Question

_LONGEST_ANSWER = 1 << 20
_LONGEST_REASON = 500
T = TypeVar("T")


def ask(question: Question, read: Callable[[bytes], T], seconds: float, words: Sequence[str] = ()) -> T | Failure:
    """Ask one question; return what ``read`` makes of the answer, or why there is none within that time.

    ``words`` are those that the question needs (``udccal.doctor.questions.answer``).
    """
    return ask_command([sys.executable, "-m", "udccal.doctor.child", question.value, *words], read, seconds)


def ask_command(command: Sequence[str], read: Callable[[bytes], T], seconds: float) -> T | Failure:
    """Do as ``ask`` with any command that answers as ``udccal.doctor.child`` does, into the file named last."""
    with tempfile.TemporaryDirectory(prefix="udccal-doctor-") as folder:
        file = Path(folder) / "answer.json"
        status = _run([*command, str(file)], seconds)
        if status is None:
            return Failure(f"no answer within {seconds:g} s")
        try:
            with file.open("rb") as stream:
                content = stream.read(_LONGEST_ANSWER)
            if status == 0:
                return read(content)
            if status == FAILED:
                failure = read_failure(content)
                return dataclasses.replace(failure, reason=failure.reason[:_LONGEST_REASON])
        except (OSError, ValidationError):
            pass  # it failed before its answer was written
        return Failure(f"it failed ({_cause(status)})")


def _run(command: Sequence[str], seconds: float) -> int | None:
    """Return the exit status, or None when time ran out; end whatever the process started."""
    quiet = subprocess.DEVNULL
    with subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True) as process:
        try:
            return process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None
        finally:
            _end(process)


def _end(process: subprocess.Popen) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        if os.name == "posix":
            os.killpg(process.pid, signal.SIGKILL)  # its own session is its own process group
        else:
            process.kill()


def _cause(status: int) -> str:
    try:
        return f"signal {signal.Signals(-status).name}"
    except ValueError:
        return f"exit status {status}"
