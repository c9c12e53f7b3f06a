"""A display in a simulated world."""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import UInt8

from udccal.arrangements import Dark, PanelPicture
from udccal.errors import CaptureError
from udccal.simulation.world import SimulatedWorld


@final
class SimulatedDisplay:
    """Implements ``udccal.displays.protocol.Display``: what it shows is the only light in a dark room.

    Attributes:
        picture: what is on screen now, None when off.
    """

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world
        self.picture: UInt8[np.ndarray, "rows columns 3"] | None = None

    def show(self, picture: UInt8[np.ndarray, "rows columns 3"]) -> None:
        """Show an 8-bit RGB picture at the panel's own resolution.

        Raises:
            CaptureError: when the picture is not of the panel's size.
        """
        panel = self._world.truth.description.panel
        if picture.shape[:2] != (panel.rows, panel.columns):
            raise CaptureError(
                f"Expected a picture of {panel.columns} x {panel.rows} pixels, found {picture.shape[1]} x "
                f"{picture.shape[0]}. Resize it to the panel's resolution."
            )
        self.picture = picture.copy()
        self._world.arrange(PanelPicture(self.picture))

    def off(self) -> None:
        """Show nothing."""
        self.picture = None
        self._world.arrange(Dark())
