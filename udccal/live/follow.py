"""Follows a profile on disk: one that has been replaced is loaded in the background and then used."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import final

from udccal.errors import LiveError
from udccal.io.whole_folder import standing
from udccal.profiles.provenance import PROFILE_NAME

_EVERY_S = 1.0


@final
class ProfileFollower:
    """Looks at a profile once a second while it is entered; a change since it was made counts, too.

    Args:
        path: folder or zip file of the profile.
        take: loads the profile and uses it from then on.
        say: gets a sentence when the profile was taken up, or could not be.
    """

    def __init__(self, path: Path, take: Callable[[], None], say: Callable[[str], None]) -> None:
        self._path, self._take, self._say = path, take, say
        self._settled = self._state()
        self._said: tuple[tuple[int, int], str] | None = None
        self._ended = threading.Event()
        # No daemon: Python ends in native code of a profile that is being loaded only by aborting the process.
        self._thread = threading.Thread(target=self._follow, name="profile")

    def __enter__(self) -> ProfileFollower:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._thread.join(_EVERY_S)
        if self._thread.is_alive():
            self._say(f"The profile {self._path} is still being loaded; the program ends after that.")

    def _follow(self) -> None:
        while not self._ended.wait(_EVERY_S):
            state = self._state()
            if state is not None and state != self._settled:
                self._try(state)

    def _try(self, state: tuple[int, int]) -> None:
        try:
            self._take()
        except LiveError as error:
            self._settled = state  # whole, and not for this run: trying again would not help
            self._say_once(state, error)
        except Exception as error:
            self._say_once(state, error)  # it may be half copied
        else:
            self._settled = state
            self._tell(f"The profile {self._path} has changed; frames are restored with the new one from now on.")

    def _say_once(self, state: tuple[int, int], error: Exception) -> None:
        said = state, f"The profile {self._path} has changed and cannot be used; the earlier one is kept. {error}"
        if said != self._said:
            self._said = said
            self._tell(said[1])

    def _tell(self, sentence: str) -> None:
        """Say what concerns frames that still come."""
        if not self._ended.is_set():
            self._say(sentence)

    def _state(self) -> tuple[int, int] | None:
        """Return what changes with the profile; None where there is none at the moment."""
        place = standing(self._path)
        try:
            found = (place / PROFILE_NAME if place.is_dir() else place).stat()
        except OSError:
            return None
        return found.st_ino, found.st_mtime_ns
