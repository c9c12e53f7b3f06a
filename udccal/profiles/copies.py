"""A profile's files in another form: one zip file, a folder, or the present version of the format."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from udccal.errors import ProfileError
from udccal.io.links import is_plain_file
from udccal.io.reading import reading
from udccal.io.whole_folder import folder_beside, read_standing
from udccal.profiles.archive import naming, unpacked
from udccal.profiles.arrays import MAX_FILE_BYTES
from udccal.profiles.encode import decode
from udccal.profiles.history import identity
from udccal.profiles.provenance import PROFILE_NAME
from udccal.profiles.schema import VERSION
from udccal.profiles.store import check_replaceable, put, read_profile, read_stored, stored_files, write_profile

_PIECE_BYTES = 1 << 20


def pack_profile(source: Path, target: Path) -> None:
    """Write a profile as one zip file, byte for byte, whole or not at all.

    Args:
        source: folder or zip file of the profile.
        target: the zip file; a profile that is there is replaced.

    Raises:
        ProfileError: when ``source`` is not a whole profile, or ``target`` does not end in ``.zip`` or holds something
            else.
    """
    if target.suffix != ".zip":
        raise ProfileError(f"Expected the name of a file that ends in .zip, found {target.name}. Add .zip to it.")
    _copy(source, target)


def unpack_profile(source: Path, target: Path) -> None:
    """Write the profile of a zip file as a folder, byte for byte, whole or not at all.

    Args:
        source: the zip file.
        target: the folder; a profile that is there is replaced.

    Raises:
        ProfileError: when ``source`` is not a zip file with a whole profile, or ``target`` ends in ``.zip`` or holds
            something else.
    """
    with reading(source, ProfileError):
        there = source.is_file()
    if not there:
        raise ProfileError(f"Expected a profile's zip file at {source}, found none. Check the path.")
    if target.suffix == ".zip":
        raise ProfileError(f"Expected the name of a folder, found {target.name}, which ends in .zip. Choose another.")
    _copy(source, target)


def migrate_profile(source: Path, target: Path) -> None:
    """Write a profile of an older format version anew in the present one; the old one becomes its parent.

    Args:
        source: folder or zip file of the profile.
        target: folder, or zip file if it ends in ``.zip``; a profile that is there is replaced.

    Raises:
        ProfileError: when ``source`` cannot be read or has the present version, or ``target`` holds something else.
    """
    check_replaceable(target)
    old = identity(source)
    if old.version == VERSION:
        raise ProfileError(
            f"Expected a profile of a format version before {VERSION} at {source}, found {VERSION}, the present one. "
            "There is nothing to migrate."
        )
    write_profile(target, dataclasses.replace(read_profile(source), parent=old.sha256))


def _copy(source: Path, target: Path) -> None:
    """Copy the files that a profile lists, and read all of the copy before it takes its place."""
    check_replaceable(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    read_standing(source, partial(_copy_standing, target=target))


def _copy_standing(source: Path, target: Path) -> None:
    with unpacked(source) as folder, folder_beside(target) as copy:
        for name in (PROFILE_NAME, *sorted(stored_files(read_stored(folder)))):
            file = folder / name
            with reading(file, ProfileError):
                fits = is_plain_file(folder, file) and file.stat().st_size <= MAX_FILE_BYTES
            if not fits:
                raise ProfileError(
                    f"Expected the file {name} in {source}, of at most {MAX_FILE_BYTES} bytes, found none. Copy the "
                    "whole profile again."
                )
            with (copy / name).open("wb") as stream:
                for piece in _pieces(file):
                    stream.write(piece)
        with naming(source, copy):
            decode(read_stored(copy), copy)
        put(copy, target)


def _pieces(file: Path) -> Iterator[bytes]:
    """Yield the content of a file; an error of reading names it, one of whoever writes the content passes by."""
    with reading(file, ProfileError), file.open("rb") as stream:
        while piece := stream.read(_PIECE_BYTES):
            yield piece
