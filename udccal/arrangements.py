"""What must stand in front of the camera during a step, for a person and for a simulated world.

Pixel positions follow docs/conventions.md: (0, 0) is the centre of the top-left sensor pixel, x right, y down.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8


@dataclass(frozen=True)
class Dark:
    """No light at all: lens capped, panel off."""


@dataclass(frozen=True)
class FlatLight:
    """An evenly lit, featureless white LED panel fills the view; our display is off."""


@dataclass(frozen=True)
class Led:
    """One small white LED in an otherwise dark room, its image at (``x_px``, ``y_px``) on the sensor.

    ``distance_mm`` is the distance from the display; the LED is a disc of ``diameter_mm``.
    """

    x_px: float
    y_px: float
    distance_mm: float
    diameter_mm: float


@dataclass(frozen=True)
class BoardSpec:
    """A ChArUco board: ``columns`` x ``rows`` squares, the origin at its outer top-left corner, z into the board."""

    columns: int
    rows: int
    square_mm: float
    marker_mm: float
    dictionary: str = "DICT_5X5_1000"


@dataclass(frozen=True)
class Board:
    """A board held in even light. ``parallel_to_panel`` marks the one view on the alignment jig.

    ``rotation_vector`` (radians) and ``translation_mm`` take board coordinates to *panel* coordinates. They describe
    where a person should hold it; a fit never reads them.
    """

    spec: BoardSpec
    rotation_vector: tuple[float, float, float]
    translation_mm: tuple[float, float, float]
    parallel_to_panel: bool = False


@dataclass(frozen=True)
class PanelPicture:
    """Blackout: the only light is our display showing ``picture`` (8-bit RGB at the panel's own resolution)."""

    picture: UInt8[np.ndarray, "panel_rows panel_columns 3"]


@dataclass(frozen=True)
class Photograph:
    """A scene in linear radiance on a plane parallel to the panel at ``distance_mm``, with the display lit or dark.

    The picture is ``width_mm`` wide, its centre on the ray of the middle of the sensor; outside it is mirrored.
    """

    radiance: Float[np.ndarray, "rows columns 3"]
    width_mm: float
    distance_mm: float
    panel_picture: UInt8[np.ndarray, "panel_rows panel_columns 3"] | None = None


Arrangement = Dark | FlatLight | Led | Board | PanelPicture | Photograph


@dataclass(frozen=True)
class Occasion:
    """The step that an arrangement belongs to; it seeds the clock and the noise of a simulated world.

    ``instruction`` is the sentence for a person. ``number`` is the place of the step in the session, counted from 0.
    """

    step_id: str
    number: int
    instruction: str


@runtime_checkable
class Stage(Protocol):
    """Puts things in front of the camera: a simulated world, or a person who follows an instruction."""

    def arrange(self, arrangement: Arrangement, occasion: Occasion) -> None:
        """Set up the arrangement; return when it is in place."""
        ...
