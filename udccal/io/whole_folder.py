"""Folders that are replaced whole: however and whenever the process ends, the old one or the new one is there.

Where the system can exchange two names in one step, the name always has a folder. Elsewhere it has none for a moment;
the old folder is then next to it, under a name that ``standing`` finds.
"""

from __future__ import annotations

import ctypes
import errno
import os
import re
import secrets
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from udccal.errors import UdccalError
from udccal.io.atomic import flush, flush_folder

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # fcntl.h and linux/fs.h
_T = TypeVar("_T")
_NOT_HERE = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP)


@contextmanager
def folder_beside(path: Path) -> Iterator[Path]:
    """Yield an empty folder next to ``path`` for files that ``replace_whole`` will move there; then remove it.

    Processes that write to the same parent folder wait for each other. Leftovers found there are therefore of processes
    that ended, and are removed.

    Raises:
        OSError: when the folder cannot be made.
    """
    with _alone(path.parent) as alone:
        if alone:
            _tidy(path)
        folder = path.with_name(f".{path.name}-{secrets.token_hex(6)}.partial")
        folder.mkdir()
        try:
            yield folder
        finally:
            _remove(folder)


def replace_whole(new: Path, path: Path) -> None:
    """Move a finished file or folder to ``path``, in place of what is there.

    Args:
        new: a file, or a folder of files, on the same disk; an earlier folder of ``path`` is left here.
        path: where to put it.

    Raises:
        OSError: when it cannot be moved; ``path`` is then as it was.
    """
    for file in new.iterdir() if new.is_dir() else (new,):
        flush(file)
    if new.is_dir():
        flush_folder(new)
    if os.path.lexists(path) and (new.is_dir() or path.is_dir()):
        _swap(new, path)
    else:
        os.replace(new, path)
    flush_folder(path.parent)


def standing(path: Path) -> Path:
    """Return where to read the folder ``path``: there, or where a process that ended while replacing it left it."""
    left = () if os.path.lexists(path) else _beside(path, "old")
    return next(iter(left), path)


def read_standing(path: Path, read: Callable[[Path], _T]) -> _T:
    """Return what ``read`` makes of the folder or file ``path``; when it is replaced meanwhile, the new one is read.

    Raises:
        UdccalError, OSError: as ``read``, for something that nobody replaced during reading.
    """
    while True:
        place = standing(path)
        before = _identity(place)
        try:
            return read(place)
        except (UdccalError, OSError):
            if standing(path) == place and _identity(place) == before:
                raise


def _identity(path: Path) -> tuple[int, int] | None:
    """Return numbers that change when ``path`` is replaced; None when nothing is there."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_ctime_ns  # the time too: the system gives a removed folder's number to the next


def _swap(new: Path, path: Path) -> None:
    if _exchange(new, path):
        return
    old = new.with_suffix(".old")
    os.replace(path, old)
    try:
        os.replace(new, path)
    except OSError:
        os.replace(old, path)
        raise
    os.replace(old, new)


def _exchange(new: Path, path: Path) -> bool:
    """Exchange two names in one step; return False where the system or the disk cannot."""
    renameat2 = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None) if sys.platform == "linux" else None
    if renameat2 is None:
        return False
    if renameat2(_AT_FDCWD, os.fsencode(new), _AT_FDCWD, os.fsencode(path), _RENAME_EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in _NOT_HERE:
        return False
    raise OSError(number, os.strerror(number), str(path))


def _tidy(path: Path) -> None:
    """Put back or remove what processes that ended left next to ``path``."""
    place = standing(path)
    if place != path:
        os.replace(place, path)
    for left in (*_beside(path, "old"), *_beside(path, "partial")):
        _remove(left)


def _beside(path: Path, kind: str) -> tuple[Path, ...]:
    name = re.compile(re.escape(f".{path.name}-") + rf"[0-9a-f]{{12}}\.{kind}")
    return tuple(item for item in path.parent.glob(".*") if name.fullmatch(item.name))


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def _alone(folder: Path) -> Iterator[bool]:
    """Wait until no other process holds the folder, and yield True; yield False at once where the disk has no locks."""
    if os.name != "posix":
        yield False
        return
    import fcntl

    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        except OSError:
            alone = False
        else:
            alone = True
        yield alone
    finally:
        os.close(descriptor)
