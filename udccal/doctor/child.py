"""The child process that answers one question: ``python -m udccal.doctor.child QUESTION [WORD ...] FILE``.

The answer goes to the file as JSON, apart from what vendors' software prints. The exit status is 0 for an answer,
``FAILED`` for the reason why there is none, and anything else when the process failed.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from udccal.doctor.answers import Failure
from udccal.doctor.questions import Question, answer
from udccal.errors import UdccalError

FAILED = 3


def main() -> None:
    """Answer the question in the first argument, with the words after it; write the answer to the file in the last."""
    status = _write(Question(sys.argv[1]), sys.argv[2:-1], Path(sys.argv[-1]))
    os._exit(status)  # exits at once: libraries that look for hardware may hang or crash while they are unloaded


def _write(question: Question, words: Sequence[str], file: Path) -> int:
    try:
        answers = answer(question, words)
    except UdccalError as error:
        return _failed(file, Failure(str(error), refused=True))
    except Exception as error:  # whatever foreign software raises is the answer
        return _failed(file, Failure(f"{type(error).__name__}: {error}"))
    file.write_text(json.dumps([dataclasses.asdict(each) for each in answers]), encoding="utf-8")
    return 0


def _failed(file: Path, failure: Failure) -> int:
    file.write_text(json.dumps(dataclasses.asdict(failure)), encoding="utf-8")
    return FAILED


if __name__ == "__main__":
    main()
