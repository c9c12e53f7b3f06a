"""Files that cannot be read: the error names the file, and not what was to be made of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from udccal.errors import UdccalError


@contextmanager
def reading(file: Path, kind: type[UdccalError]) -> Iterator[None]:
    """Turn an error of the operating system, while a file is looked at or read, into a sentence.

    Args:
        file: what is read; nothing may be written meanwhile.
        kind: of the error that is raised.

    Raises:
        UdccalError: of that kind, in place of an OSError.
    """
    try:
        yield
    except OSError as error:
        raise kind(
            f"Expected to read {file}, found: {error.strerror or error}. Check the disk and permissions."
        ) from error
