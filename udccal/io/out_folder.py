"""The folder that a person named for results: checked before the work, and in a sentence when it fails afterwards."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from udccal.errors import UdccalError


def check_writable(folder: Path) -> None:
    """Refuse a folder in which no file can be made; call it before the work. It need not exist; nothing is left.

    Raises:
        UdccalError: when neither it, nor the folder in which it would be made, can be written to.
    """
    with storing_in(folder):
        place = folder.absolute()
        while not os.path.lexists(place):
            place = place.parent
        with tempfile.TemporaryFile(dir=place):
            pass


@contextmanager
def storing_in(folder: Path) -> Iterator[None]:
    """Turn an error of the operating system, while results are written to a folder, into a sentence.

    Raises:
        UdccalError: in place of an OSError.
    """
    try:
        yield
    except OSError as error:
        raise UdccalError(
            f"Expected to write the results to {folder}, found: {error.strerror or error}. Choose another folder, or "
            "correct the disk, the folder or its permissions."
        ) from error
