"""Opening a session's folder to write to it: a new one, or one that is there, and what the disk says meanwhile."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from udccal.errors import SessionError
from udccal.sessions.damage import is_leftover
from udccal.sessions.lock import LOCK_NAME
from udccal.sessions.manifest import (
    DAMAGED_NAME,
    MANIFEST_NAME,
    PREVIOUS_NAME,
    NewerManifestError,
    read_manifest,
    write_manifest,
)
from udccal.sessions.schema import Manifest


def check_new(folder: Path) -> None:
    """Refuse a folder that holds a session, or anything else that udccal has not left there.

    Raises:
        SessionError: when it does.
    """
    if (folder / MANIFEST_NAME).exists():
        raise SessionError(f"Expected no session at {folder}, found one. Resume it, or choose another folder.")
    if folder.exists() and (not folder.is_dir() or not all(_may_be_there(item) for item in folder.iterdir())):
        raise SessionError(
            f"Expected {folder} to be a new or empty folder, found other content. Choose another folder."
        )


def _may_be_there(item: Path) -> bool:
    """Return whether a process that was killed while it began a session may have left this."""
    return item.name == LOCK_NAME or is_leftover(item)


def read_or_recover(folder: Path) -> tuple[Manifest, bool]:
    """Read the manifest; if it is damaged, replace it by the one before the last step, and return that and True.

    Raises:
        SessionError: when there is none to read, or it is of a later version.
    """
    try:
        return read_manifest(folder), False
    except NewerManifestError:
        raise
    except SessionError:
        try:
            manifest = read_manifest(folder, PREVIOUS_NAME)
        except SessionError:
            manifest = None
        if manifest is None:
            raise
    with sentences("the manifest", folder):
        with suppress(FileNotFoundError):  # keep it: a person may have edited it; a link is moved, not followed
            os.replace(folder / MANIFEST_NAME, folder / DAMAGED_NAME)
        write_manifest(folder, manifest)
    return manifest, True


@contextmanager
def sentences(what: str, folder: Path) -> Iterator[None]:
    """Turn an error of the operating system into a sentence that says what to do."""
    try:
        yield
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        advice = "Free some space there" if full else "Check the disk, the folder and its permissions"
        raise SessionError(
            f"Expected to store {what} in {folder}, found: {error.strerror or error}. {advice}, then run the same "
            "command again: completed steps are kept."
        ) from error
