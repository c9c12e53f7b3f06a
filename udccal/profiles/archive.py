"""A profile as one zip file: a flat list of files, checked before unpacking."""

from __future__ import annotations

import errno
import re
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from udccal.errors import ProfileError
from udccal.profiles.arrays import MAX_FILE_BYTES
from udccal.profiles.provenance import MAX_JSON_BYTES, PROFILE_NAME

_ENTRY = re.compile(r"(profile\.json|[a-z][a-z0-9_]{0,95}\.exr)")
_MAX_ENTRIES = 256
_MAX_TOTAL_BYTES = 1024 * 1024 * 1024
_CHUNK = 1024 * 1024
# The methods a profile needs. zipfile unpacks them in bounded pieces; other methods it may unpack whole.
_KINDS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# Bound of the list of files at the archive's end, which zipfile reads whole (APPNOTE 6.3.10, 4.3.15 and 4.3.16).
_MAX_LIST_BYTES = 1024 * 1024
_END = struct.Struct("<4s8xI4x2s")
_END_SIGNATURE, _LARGE_SIGNATURE, _NO_COMMENT = b"PK\5\6", b"PK\6\7", b"\0\0"
_LARGE_BYTES = 20
# What zipfile raises for damaged files: names and numbers that cannot be, and content that does not unpack.
_DAMAGES = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    NotImplementedError,
    OSError,
    OverflowError,
    RuntimeError,
    ValueError,
)
# What to do about a file that cannot be written, by the reason.
_NO_ROOM = {
    errno.ENOSPC: "Free some space there",
    errno.EDQUOT: "Free some space there",
    errno.EFBIG: "Allow larger files there (ulimit -f)",
}
_UNREADABLE = (errno.EACCES, errno.EPERM, errno.EIO)


def pack_archive(folder: Path, path: Path) -> None:
    """Write the files of a profile's folder to one new zip file. EXR files are already compressed and are stored."""
    files = sorted(folder.iterdir())
    # A computer without a battery for its clock begins in 1970, which zip files cannot hold: 1980 is written then.
    with zipfile.ZipFile(path, "x", strict_timestamps=False) as archive:
        for file in files:
            kind = zipfile.ZIP_STORED if file.suffix == ".exr" else zipfile.ZIP_DEFLATED
            archive.write(file, file.name, compress_type=kind)


@contextmanager
def unpacked(path: Path, only: str | None = None) -> Iterator[Path]:
    """Yield the folder of a profile: ``path`` itself, or a temporary folder for as long as its zip file is needed.

    Args:
        path: the profile's folder or zip file.
        only: the one file that is needed; None for all.

    Raises:
        ProfileError: as ``unpack_archive``, and when ``path`` is the ``profile.json`` of a folder.
    """
    if not path.is_file():
        yield path
        return
    if path.name == PROFILE_NAME:
        raise ProfileError(
            f"Expected a profile's folder or zip file, found {path}, one of its files. Name the folder, {path.parent}."
        )
    with tempfile.TemporaryDirectory(prefix="udccal-") as folder:
        unpack_archive(path, Path(folder), only)
        with naming(path, Path(folder)):
            yield Path(folder)


@contextmanager
def naming(path: Path, folder: Path) -> Iterator[None]:
    """Name ``path`` in errors about a temporary folder of its files: a person has never seen that, and it is deleted.

    Raises:
        ProfileError: with the other name.
    """
    try:
        yield
    except ProfileError as error:
        raise ProfileError(str(error).replace(str(folder), str(path))) from error


def unpack_archive(path: Path, folder: Path, only: str | None = None) -> None:
    """Unpack a profile's zip file into an empty folder; with ``only`` just that file, after the same checks.

    Raises:
        ProfileError: when the file is damaged or not a zip file, holds a name that no profile has (folders, ``..``,
            absolute paths, links), or would unpack to more than a profile can hold; also when the disk is full.
    """
    try:
        _check_list(path)
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            _check_entries(path, entries)
            for entry in (entry for entry in entries if only in (None, entry.filename)):
                _unpack_entry(path, archive, entry, folder / entry.filename)
    except _DAMAGES as error:
        if isinstance(error, OSError) and error.errno in _NO_ROOM:
            raise ProfileError(
                f"Expected room to unpack {path} into {folder}, found: {error.strerror}. {_NO_ROOM[error.errno]}, or "
                "set TMPDIR to a folder on another disk."
            ) from error
        if isinstance(error, OSError) and error.errno in _UNREADABLE:
            raise ProfileError(
                f"Expected to read {path}, found: {error.strerror}. Check the disk and permissions."
            ) from error
        raise ProfileError(f"Expected {path} to be a whole zip file, found: {error}. Copy it again.") from error


def _check_list(path: Path) -> None:
    with path.open("rb") as stream:
        stream.seek(max(path.stat().st_size - _END.size - _LARGE_BYTES, 0))
        tail = stream.read()
    signature, size, comment = _END.unpack(tail[-_END.size :]) if len(tail) >= _END.size else (b"", 0, b"")
    if signature != _END_SIGNATURE or comment != _NO_COMMENT:
        raise zipfile.BadZipFile("no list of files at its end")
    if size > _MAX_LIST_BYTES or tail.startswith(_LARGE_SIGNATURE):
        raise ProfileError(f"Expected a short list of files in {path}, found a large one. It is not a profile.")


def _check_entries(path: Path, entries: list[zipfile.ZipInfo]) -> None:
    if len(entries) > _MAX_ENTRIES:
        raise ProfileError(
            f"Expected at most {_MAX_ENTRIES} files in {path}, found {len(entries)}. It is not a profile."
        )
    names = [entry.filename for entry in entries]
    strange = [name for name in names if not _ENTRY.fullmatch(name)]
    if strange or len(set(names)) != len(names):
        found = f"'{strange[0]}'" if strange else "a name twice"
        raise ProfileError(f"Expected only profile.json and EXR files in {path}, found {found}. It is not a profile.")
    for entry in entries:
        most = MAX_JSON_BYTES if entry.filename == PROFILE_NAME else MAX_FILE_BYTES
        if entry.file_size > most or entry.compress_type not in _KINDS:
            raise ProfileError(
                f"Expected '{entry.filename}' in {path} to unpack to at most {most} bytes, stored or deflated, found "
                f"{entry.file_size} bytes coded by method {entry.compress_type}. It is not a profile."
            )
    total = sum(entry.file_size for entry in entries)
    if total > _MAX_TOTAL_BYTES:
        raise ProfileError(
            f"Expected {path} to unpack to at most {_MAX_TOTAL_BYTES} bytes, found {total}. It is not a profile."
        )


def _unpack_entry(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo, target: Path) -> None:
    """Unpack one file, and refuse content beyond the size in its header, which is all that was checked before."""
    left = entry.file_size
    with archive.open(entry) as source, target.open("xb") as sink:
        while chunk := source.read(_CHUNK):
            left -= len(chunk)
            if left < 0:
                raise ProfileError(
                    f"Expected '{entry.filename}' in {path} to have the size in its header, found more. Copy it again."
                )
            sink.write(chunk)
