"""A lock, so that one process at a time writes to a session."""

from __future__ import annotations

from pathlib import Path

from filelock import FileLock, Timeout

from udccal.errors import SessionError
from udccal.io.links import refuse_links

LOCK_NAME = ".session.lock"


def lock_session(folder: Path) -> FileLock:
    """Lock a session until the lock is released; the operating system releases it when the process ends in any way.

    Raises:
        SessionError: when another process, or another writer in this one, holds it, or the disk has no locks.
    """
    lock = FileLock(folder / LOCK_NAME, timeout=0, thread_local=False)
    try:
        refuse_links(folder, folder / LOCK_NAME)  # older versions of filelock follow one
        lock.acquire()
    except Timeout as error:
        raise SessionError(
            f"Expected the session {folder} to be free, found that another process is writing to it. "
            "Wait until it ends, or stop it."
        ) from error
    except (OSError, NotImplementedError) as error:
        raise SessionError(
            f"Expected to lock the session {folder}, found: {error}. Use a folder on a local disk of your own."
        ) from error
    return lock
