"""The protocol that every display implements."""

from __future__ import annotations

from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, final, runtime_checkable

import numpy as np
from jaxtyping import UInt8


@final
@dataclass(frozen=True)
class PanelSize:
    """Pixels of a panel, across and down."""

    columns: int
    rows: int


@runtime_checkable
class Display(Protocol):
    """Shows pictures on the panel, pixel for pixel; used as a context manager."""

    @property
    def size(self) -> PanelSize:
        """Pixels of the panel."""
        ...

    def __enter__(self) -> Display: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def show(self, picture: UInt8[np.ndarray, "rows columns 3"]) -> None:
        """Show an 8-bit RGB picture at the panel's own resolution, and return once it is on screen.

        Raises:
            DisplayError: when the picture is not 8-bit RGB of the panel's size, or cannot be shown.
        """
        ...

    def off(self) -> None:
        """Show black, which is no light from a panel whose pixels emit their own.

        Raises:
            DisplayError: when black cannot be shown.
        """
        ...

    def check(self) -> None:
        """Check that the last picture has stayed on screen since it was shown, as far as the display can know.

        It is called after a capture, so that frames of a picture that was covered meanwhile are not kept.

        Raises:
            DisplayError: when the picture has not stayed on screen.
        """
        ...
