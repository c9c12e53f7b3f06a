"""The one protocol behind which every display stands."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8


@runtime_checkable
class Display(Protocol):
    """Shows pictures on the panel, pixel for pixel."""

    def show(self, picture: UInt8[np.ndarray, "rows columns 3"]) -> None:
        """Show an 8-bit RGB picture at the panel's own resolution, and return once it is on screen."""
        ...

    def off(self) -> None:
        """Show nothing: no light from the panel."""
        ...
