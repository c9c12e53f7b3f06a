"""A display that mirrors pictures, for the panel seen from behind."""

from __future__ import annotations

from types import TracebackType
from typing import final

import numpy as np
from jaxtyping import UInt8

from udccal.displays.protocol import Display, PanelSize


@final
class MirroredDisplay:
    """Implements ``udccal.displays.protocol.Display``: shows every picture with left and right exchanged.

    Pictures are given as the camera sees the panel, from behind (docs/conventions.md). A screen shows them to people in
    front of it. The camera's right is those people's left.
    """

    def __init__(self, display: Display) -> None:
        self._display = display

    @property
    def size(self) -> PanelSize:
        """Pixels of the panel."""
        return self._display.size

    def __enter__(self) -> MirroredDisplay:
        self._display.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._display.__exit__(kind, error, trace)

    def show(self, picture: UInt8[np.ndarray, "rows columns 3"]) -> None:
        """Show the mirror image."""
        self._display.show(np.ascontiguousarray(picture[:, ::-1]))

    def off(self) -> None:
        """Show nothing."""
        self._display.off()

    def check(self) -> None:
        """Check the display behind this one."""
        self._display.check()
