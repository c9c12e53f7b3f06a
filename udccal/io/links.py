"""Checks for links in folders that somebody else may have filled, where a link could lead anywhere.

Nothing is read or written through such a link. The folder itself is the user's choice and may be a link.
"""

from __future__ import annotations

import errno
from pathlib import Path


def is_plain_file(root: Path, file: Path) -> bool:
    """Return whether ``file`` exists below ``root``, and neither it nor a folder between them is a link."""
    return file.is_file() and _first_link(root, file) is None


def refuse_links(root: Path, path: Path) -> None:
    """Refuse a path that is a link or lies behind one; the path need not exist.

    Args:
        root: the folder that is trusted.
        path: a path below ``root``.

    Raises:
        OSError: when ``path``, or a folder between ``root`` and it, is a link.
    """
    link = _first_link(root, path)
    if link is not None:
        raise OSError(errno.ELOOP, f"{link} is a link; remove it")


def make_folder(root: Path, folder: Path) -> None:
    """Make a folder and its missing parents.

    Args:
        root: the folder that is trusted.
        folder: a path below ``root``.

    Raises:
        OSError: when a folder cannot be made, or is a link.
    """
    refuse_links(root, folder)
    folder.mkdir(parents=True, exist_ok=True)


def _first_link(root: Path, path: Path) -> Path | None:
    steps = path.relative_to(root).parts
    places = (root.joinpath(*steps[: count + 1]) for count in range(len(steps)))
    return next((place for place in places if place.is_symlink()), None)
