"""Folders that are replaced whole: whatever ends the process, and whenever, the old one or the new one stands.

Where the system lets two names change places at once, the name is never without a folder. Elsewhere it is for a moment;
the old folder then lies beside it, under a name that ``standing`` finds.
"""

from __future__ import annotations

import ctypes
import errno
import os
import re
import secrets
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from udccal.io.atomic import flush, flush_folder

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # fcntl.h and linux/fs.h
_NOT_HERE = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP)


@contextmanager
def folder_beside(path: Path) -> Iterator[Path]:
    """An empty folder to make in it what ``replace_whole`` puts at ``path``; what is left in it afterwards is removed.

    Processes that write beside one another wait for each other, so that what lies there is of dead ones and is removed.

    Raises:
        OSError: when it cannot be made.
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
    """Have a finished file, or folder of files, stand at ``path``; what stood there is gone or left at ``new``.

    Raises:
        OSError: when it cannot be done; ``path`` is then as it was.
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
    """Where the folder of that name is to be read: there, or where a process that ended while replacing it left it."""
    left = () if os.path.lexists(path) else _beside(path, "old")
    return next(iter(left), path)


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
    """Let two names change places at once; False where the system or the disk does not know how."""
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
    """Put back and remove what dead processes left beside ``path``."""
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
    """Wait until no other process is here with the same folder; False at once where the disk knows no locks."""
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
