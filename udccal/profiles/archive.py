"""A profile as one zip file: a flat list of files, refused before unpacking when it could do harm."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

from udccal.errors import ProfileError

_ENTRY = re.compile(r"(profile\.json|[a-z][a-z0-9_]{0,95}\.exr)")
_MAX_ENTRIES = 256
_MAX_TOTAL_BYTES = 1024 * 1024 * 1024
_CHUNK = 1024 * 1024


def pack_archive(folder: Path, path: Path) -> None:
    """Write the files of a profile's folder to one new zip file. EXR files are compressed already and only stored."""
    files = sorted(folder.iterdir())
    with zipfile.ZipFile(path, "x") as archive:
        for file in files:
            kind = zipfile.ZIP_STORED if file.suffix == ".exr" else zipfile.ZIP_DEFLATED
            archive.write(file, file.name, compress_type=kind)


def unpack_archive(path: Path, folder: Path) -> None:
    """Unpack a profile's zip file into an empty folder.

    Raises:
        ProfileError: when it is no zip file, damaged, holds a name that no profile has (folders, ``..``, absolute
            paths, links), or would unpack to more than a profile can hold.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            _check_entries(path, entries)
            for entry in entries:
                _unpack_entry(path, archive, entry, folder / entry.filename)
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, OSError) as error:
        raise ProfileError(f"Expected {path} to be a whole zip file, found: {error}. Copy it again.") from error


def _check_entries(path: Path, entries: list[zipfile.ZipInfo]) -> None:
    if len(entries) > _MAX_ENTRIES:
        raise ProfileError(f"Expected at most {_MAX_ENTRIES} files in {path}, found {len(entries)}. It is not ours.")
    names = [entry.filename for entry in entries]
    strange = [name for name in names if not _ENTRY.fullmatch(name)]
    if strange or len(set(names)) != len(names):
        found = f"'{strange[0]}'" if strange else "a name twice"
        raise ProfileError(f"Expected only profile.json and EXR files in {path}, found {found}. It is not ours.")
    total = sum(entry.file_size for entry in entries)
    if total > _MAX_TOTAL_BYTES:
        raise ProfileError(
            f"Expected {path} to unpack to at most {_MAX_TOTAL_BYTES} bytes, found {total}. It is not ours."
        )


def _unpack_entry(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo, target: Path) -> None:
    """Unpack one file, never past the size it claims: the claim, not the content, has been checked."""
    left = entry.file_size
    with archive.open(entry) as source, target.open("xb") as sink:
        while chunk := source.read(_CHUNK):
            left -= len(chunk)
            if left < 0:
                raise ProfileError(f"Expected '{entry.filename}' in {path} to have the size it states. Copy it again.")
            sink.write(chunk)
