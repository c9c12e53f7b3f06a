"""The file of ``--log``: refused before the work where it would harm others, and worth less than the work."""

from __future__ import annotations

import contextlib
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

from udccal.cli.jobs.apart import check_apart
from udccal.cli.output import Output
from udccal.errors import UdccalError


def check_log(path: Path | None, *given: Path | None) -> None:
    """Refuse a log that would replace a part of a profile, of a session, or of what a command uses.

    Args:
        path: of ``--log``; None for no log.
        given: as for ``check_apart``.

    Raises:
        UdccalError: when it would.
    """
    if path is None:
        return
    check_apart(path, *given)
    if path.is_file() and zipfile.is_zipfile(path):
        raise UdccalError(
            f"Expected --log to name a new file or an earlier log, found that {path} is a zip file, as profiles are. "
            "Name another."
        )


@contextlib.contextmanager
def log_file(output: Output, path: Path, holds: str) -> Iterator[Callable[[str], None]]:
    """Yield what writes a line to a file. Work goes on where that fails: it is worth more.

    What a file holds is replaced with the first line: work that cannot begin leaves it as it was.

    Args:
        output: says at the end where the file is cut short.
        path: the file, in a folder that exists.
        holds: what it holds, in a word.

    Raises:
        UdccalError: when the file cannot be opened.
    """
    try:
        new = not path.exists()
        stream = path.open("a", encoding="utf-8", buffering=1)
    except OSError as error:
        raise UdccalError(
            f"Expected --log to name a file that can be written, found: {error}. Name another."
        ) from error
    begun = cut_short = False

    def write(line: str) -> None:
        nonlocal begun, cut_short
        if not begun:
            begun = True
            with contextlib.suppress(OSError):  # a pipe has no length
                stream.truncate(0)
        try:
            print(line, file=stream)
        except OSError:
            cut_short = True

    try:
        yield write
    finally:
        with contextlib.suppress(OSError):  # what could not be written before
            stream.close()
        if new and not begun:
            path.unlink(missing_ok=True)
        if cut_short:
            output.say(f"The {holds} in {path} are cut short: it could not be written to.")
