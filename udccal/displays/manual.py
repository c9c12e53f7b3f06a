"""A display that a person operates: asked to show a file, and whether it is on screen."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import final

import numpy as np
from jaxtyping import UInt8

from udccal.displays.checked import check_picture
from udccal.displays.protocol import PanelSize
from udccal.errors import DisplayError
from udccal.io.png import write_rgb8

_BLACK = "black"


@final
class ManualDisplay:
    """Implements ``udccal.displays.protocol.Display`` for panels that are not connected to this computer.

    There is no timeout: a person may take as long as they like. Ctrl-C in ``confirm`` ends the wait.
    """

    def __init__(
        self, folder: Path, size: PanelSize, tell: Callable[[str], None], confirm: Callable[[str], bool]
    ) -> None:
        """Args:
        folder: folder for the pictures; made when it is missing. A picture's name is a hash of its pixels, so that
            two pictures never have the same name and an old one is never shown by mistake.
        size: pixels of the panel.
        tell: says a sentence to the person.
        confirm: asks the person a question, waits, and returns whether the answer was yes.
        """
        self._folder = folder
        self._size = size
        self._tell = tell
        self._confirm = confirm
        self._shown: str | None = None

    @property
    def size(self) -> PanelSize:
        """Pixels of the panel."""
        return self._size

    def __enter__(self) -> ManualDisplay:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """The pictures stay in the folder."""

    def show(self, picture: UInt8[np.ndarray, "rows columns 3"]) -> None:
        """Write the picture as PNG, say where it is, and return once the person has it on screen.

        Raises:
            DisplayError: when the picture is not 8-bit RGB of the panel's size, or the person says no.
        """
        check_picture(picture, self._size)
        file = self._folder / f"panel-{hashlib.sha256(picture.tobytes()).hexdigest()[:12]}.png"
        if self._shown == file.name:
            return
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            write_rgb8(file, picture)
        except OSError as error:
            raise DisplayError(
                f"Expected to write the picture {file}, found: {error.strerror}. Check the disk and permissions."
            ) from error
        self._ask(
            file.name,
            f"Show {file.resolve()} on the panel: full screen, pixel for pixel, not resized, no menu or pointer on it.",
        )

    def off(self) -> None:
        """Return once the person has switched the panel off or to black; ask only when it is not off already.

        Raises:
            DisplayError: when the person says no.
        """
        if self._shown != _BLACK:
            self._ask(_BLACK, "Switch the panel off, or let it show black only.")

    def check(self) -> None:
        """Do nothing: only the person sees the panel."""

    def _ask(self, shown: str, sentence: str) -> None:
        self._shown = None  # not known until the answer is there
        self._tell(sentence)
        if not self._confirm("Is it done?"):
            raise DisplayError(f"Expected the answer yes to '{sentence}', found no. Run the same command to continue.")
        self._shown = shown
