"""Places that a person named for results: apart from profiles, from sessions, and from what a command reads."""

from __future__ import annotations

import os
from pathlib import Path

from udccal.errors import SessionError, UdccalError
from udccal.io.out_folder import check_writable
from udccal.profiles.store import check_outside_profiles, check_replaceable
from udccal.sessions.manifest import MANIFEST_NAME, PREVIOUS_NAME


def check_apart(file: Path, *given: Path | None) -> None:
    """Refuse a file to write that would be among others' files; call it before the work.

    Args:
        file: the file; links on its path are followed, since they may lead into a profile.
        given: files and folders that the command reads, or replaces as a whole; None for what was not given.

    Raises:
        ProfileError: when it is in a profile's folder, which then could not be replaced any more.
        SessionError: when it is in a session's folder.
        UdccalError: when it is one of the ``given``, or in one of them.
    """
    place = Path(os.path.realpath(file))
    check_outside_profiles(place)
    for folder in place.parents:
        if any(os.path.lexists(folder / name) for name in (MANIFEST_NAME, PREVIOUS_NAME)):
            raise SessionError(
                f"Expected a place outside of any session, found {file} inside the session {folder}, which holds its "
                "own files only. Choose another path."
            )
    for each in given:
        if each is not None and place.is_relative_to(os.path.realpath(each)):
            raise UdccalError(
                f"Expected a place apart from {each}, which this command needs for something else, found {file}. "
                "Choose another path."
            )


def check_profile_place(path: Path, *given: Path | None) -> None:
    """Refuse a path at which a profile cannot be written, or that is among others' files; call it before the work.

    Args:
        path: of the profile.
        given: as for ``check_apart``.

    Raises:
        ProfileError: as ``check_replaceable``.
        SessionError, UdccalError: as ``check_apart``; also when the folder cannot be written to.
    """
    check_replaceable(path)
    check_apart(path, *given)
    check_writable(path.parent)


def check_folder_apart(folder: Path) -> None:
    """Refuse a folder for results that is a profile or a session, or lies in one; call it before the work.

    Raises:
        ProfileError, SessionError: as ``check_apart``.
    """
    check_apart(folder / "results")
