"""Lists the files of a folder that are its frames, in order, with their known settings."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from udccal.cameras.picture_files.mosaics import PICTURE_SUFFIXES
from udccal.errors import CameraError

MAX_FILES: Final = 40_000


@final
@dataclass(frozen=True)
class ListedPicture:
    """A file, and the settings that its user gives; None where the file's own fields count."""

    path: Path
    exposure_s: float | None = None
    gain_dB: float | None = None
    timestamp_s: float | None = None


def list_files(paths: Sequence[str | Path]) -> tuple[ListedPicture, ...]:
    """List the files of ``paths`` in their order.

    Raises:
        CameraError: when there is none, or more than a session ever needs.
    """
    if not 0 < len(paths) <= MAX_FILES:
        raise CameraError(f"Expected at least one file and at most {MAX_FILES}, found {len(paths)}. List the files.")
    return tuple(ListedPicture(Path(path)) for path in paths)


def pictures_in(folder: Path) -> tuple[Path, ...]:
    """Return the pictures of ``folder`` by name, numbers in names by value (2 before 10); ignore other files.

    Raises:
        CameraError: when it is not a folder, or holds more files than a session ever needs.
    """
    if not folder.is_dir():
        raise CameraError(f"Expected a folder of pictures at {folder}, found none. Check the path.")
    found: list[Path] = []
    for number, path in enumerate(folder.iterdir()):
        if number >= MAX_FILES:
            raise CameraError(f"Expected at most {MAX_FILES} files in {folder}, found more. Use one folder per step.")
        if path.suffix.lower() in PICTURE_SUFFIXES and not path.name.startswith("."):
            found.append(path)
    return tuple(sorted(found, key=_natural))


def _natural(path: Path) -> tuple[tuple[tuple[int, str], ...], str]:
    """Split a name into text and numbers; digits are compared by length, then by letter, which is by value."""
    parts = re.split(r"([0-9]+)", path.name.lower())
    bare = (part.lstrip("0") if index % 2 else part for index, part in enumerate(parts))
    return tuple((len(part) if index % 2 else 0, part) for index, part in enumerate(bare)), path.name
