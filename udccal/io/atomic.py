"""Files that are there whole or not at all: written under a temporary name, flushed to disk, then renamed."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary name beside ``path`` to write to; on leaving without an error it is flushed and becomes ``path``.

    On an error nothing is left behind, and a file that was at ``path`` before stays as it was. A link at ``path`` is
    replaced and not followed.
    """
    temporary = path.with_name(f".{path.stem}-{secrets.token_hex(6)}.partial{path.suffix}")
    os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))  # O_EXCL opens no link, nor what is there
    try:
        yield temporary
        flush(temporary)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    flush_folder(path.parent)


def write_atomically(path: Path, content: bytes) -> None:
    """Write ``content`` to ``path`` so that no reader, and no power cut, ever meets half of it."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def flush(path: Path) -> None:
    """Have a file's bytes on disk."""
    descriptor = os.open(path, os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def flush_folder(folder: Path) -> None:
    """Have a folder's names on disk."""
    if os.name != "posix":  # elsewhere a folder cannot be opened; the rename itself is all there is
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
