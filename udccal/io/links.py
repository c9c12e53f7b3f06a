"""Folders that somebody else may have filled: a link below one leads wherever its maker wants it to.

Nothing is read or written through such a link. The folder itself is the user's choice and may be one.
"""

from __future__ import annotations

import errno
from pathlib import Path


def is_plain_file(root: Path, file: Path) -> bool:
    """Whether a file is there below ``root``, and neither it nor a folder on the way to it is a link."""
    return file.is_file() and _first_link(root, file) is None


def refuse_links(root: Path, path: Path) -> None:
    """Refuse a place below ``root`` that is a link or lies behind one; nothing need be there.

    Raises:
        OSError: when it does.
    """
    link = _first_link(root, path)
    if link is not None:
        raise OSError(errno.ELOOP, f"{link} is a link; remove it")


def make_folder(root: Path, folder: Path) -> None:
    """Make a folder below ``root``, and those on the way to it, where they are not there yet.

    Raises:
        OSError: when one cannot be made, or is a link.
    """
    refuse_links(root, folder)
    folder.mkdir(parents=True, exist_ok=True)


def _first_link(root: Path, path: Path) -> Path | None:
    steps = path.relative_to(root).parts
    places = (root.joinpath(*steps[: count + 1]) for count in range(len(steps)))
    return next((place for place in places if place.is_symlink()), None)
