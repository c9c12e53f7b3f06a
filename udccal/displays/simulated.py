"""A display in a simulated world."""

from __future__ import annotations

from types import TracebackType
from typing import final

import numpy as np
from jaxtyping import UInt8

from udccal.arrangements import Dark, PanelPicture
from udccal.displays.checked import check_picture
from udccal.displays.protocol import PanelSize
from udccal.simulation.world import SimulatedWorld


@final
class SimulatedDisplay:
    """Implements ``udccal.displays.protocol.Display``: its picture is the only light in a dark room.

    Attributes:
        picture: the picture on screen; None when off.
    """

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world
        self.picture: UInt8[np.ndarray, "rows columns 3"] | None = None

    @property
    def size(self) -> PanelSize:
        """Pixels of the simulated panel."""
        panel = self._world.truth.description.panel
        return PanelSize(panel.columns, panel.rows)

    def __enter__(self) -> SimulatedDisplay:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Do nothing: the world keeps its arrangement."""

    def show(self, picture: UInt8[np.ndarray, "rows columns 3"]) -> None:
        """Show an 8-bit RGB picture at the panel's own resolution.

        Raises:
            DisplayError: when the picture is not 8-bit RGB of the panel's size.
        """
        check_picture(picture, self.size)
        self.picture = picture.copy()
        self._world.arrange(PanelPicture(self.picture))

    def off(self) -> None:
        """Show nothing."""
        self.picture = None
        self._world.arrange(Dark())

    def check(self) -> None:
        """Do nothing: nothing covers a simulated panel."""
