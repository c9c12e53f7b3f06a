"""PSF: exposure brackets of a small LED at field positions on a grid, each at several sub-pixel shifts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, final

import numpy as np
from jaxtyping import Float

from procedures.aiming import low_discrepancy
from procedures.base import Procedure
from procedures.checks import shows_led
from procedures.led_walk import CELL_PX, FieldCell, LedVisit, region_around
from procedures.plans import Bracket, Metered
from procedures.step import Bench, Step
from udccal.arrangements import Led, Stage
from udccal.cameras.protocol import Camera
from udccal.displays.protocol import Display
from udccal.guide.drawing import side_view
from udccal.guide.steps import GuidedStep
from udccal.rig import RigDescription
from udccal.sessions.schema import TermName
from udccal.sessions.writer import SessionWriter

_INSET = 0.04  # of the sensor's side
_LEVEL = 0.8  # of saturation, in the brightest sample of the shortest exposure


@final
class PsfProcedure(Procedure):
    """Each shift moves the LED within a 2 x 2 cell, so that together they sample every channel below its pitch."""

    term: ClassVar[TermName] = "psf"

    def steps(self, rig: RigDescription) -> Iterator[Step]:
        """Yield all shifts of one position, then the next position."""
        captures = rig.captures
        shifts = CELL_PX * low_discrepancy(captures.psf_shifts)
        for position, (x, y) in enumerate(led_positions_px(rig)):
            region = region_around(rig, float(x), float(y))
            for shift, (dx, dy) in enumerate(shifts):
                led = Led(float(x + dx), float(y + dy), captures.psf_distance_mm, captures.psf_led_mm)
                yield Step(
                    id=_step_id(position, shift),
                    term="psf",
                    arrangement=led,
                    instruction=f"Darken the room. Put the LED {captures.psf_distance_mm / 1000:g} m in front of the "
                    f"display so that its image falls on column {led.x_px:.0f}, row {led.y_px:.0f} of the sensor"
                    + (", then move it by less than its image's width." if shift else "."),
                    check=shows_led(led.x_px, led.y_px),
                    region=region,
                    exposure=Metered(_LEVEL, "spot"),
                    plan=Bracket(captures.psf_exposures),
                )

    def guided(self, rig: RigDescription) -> Iterator[GuidedStep]:
        """Yield the cells of the field; a person aims at a cell, and the LED's place in it is measured."""
        cells = field_cells(rig)
        for number, cell in enumerate(cells):
            yield _guided(rig, cell, f"LED in cell {number + 1} of {len(cells)}", number == 0)


def field_cells(rig: RigDescription) -> tuple[FieldCell, ...]:
    """Return the cells about the positions of the grid, back and forth through the rows, so that the ways are short.

    A cell is half as wide and high as the grid's spacing, and ends well before the sensor's edge.
    """
    captures, camera = rig.captures, rig.camera
    places = led_positions_px(rig)
    sides = np.array([camera.columns, camera.rows])
    spacing = [
        np.diff(np.unique(along)).min() if len(np.unique(along)) > 1 else side / 2
        for along, side in zip(places.T, sides, strict=True)
    ]
    order = np.arange(len(places)).reshape(captures.psf_rows, captures.psf_columns)
    order[1::2] = order[1::2, ::-1]
    cells = []
    for position in order.ravel():
        place = places[position]
        half = np.minimum(np.array(spacing) / 4, np.minimum(place, sides - 1 - place) - _INSET / 4 * sides)
        ids = tuple(_step_id(int(position), shift) for shift in range(captures.psf_shifts))
        cells.append(FieldCell((float(place[0]), float(place[1])), (float(half[0]), float(half[1])), ids))
    return tuple(cells)


def _step_id(position: int, shift: int) -> str:
    return f"psf/p{position:02d}_s{shift}"


def _guided(rig: RigDescription, cell: FieldCell, title: str, first: bool) -> GuidedStep:
    captures, (x, y) = rig.captures, cell.place_px

    def begin(camera: Camera, display: Display, stage: Stage, writer: SessionWriter) -> LedVisit:
        return LedVisit(cell, Metered(_LEVEL, "spot"), Bench(camera, display, stage), writer)

    where = f"within {cell.half_px[0]:.0f} px of column {x:.0f} and {cell.half_px[1]:.0f} px of row {y:.0f}"
    begun = (
        f"Darken the room. Put the LED {captures.psf_distance_mm / 1000:g} m in front of the display. " if first else ""
    )
    return GuidedStep(
        id=cell.step_ids[0].removesuffix("_s0"),
        term="psf",
        title=title,
        why="The spread of a point of light, as it is in this part of the picture, is what restoration takes out.",
        instruction=f"{begun}Bring its image into the cell: {where}. Let it rest; after each series of frames nudge it "
        f"by a pixel or so, {captures.psf_shifts} series in all.",
        drawing=side_view(rig, Led(x, y, captures.psf_distance_mm, captures.psf_led_mm)),
        step_ids=cell.step_ids,
        needs=(),
        frames=captures.psf_shifts * captures.psf_exposures,
        by_itself=True,
        begin=begin,
    )


def led_positions_px(rig: RigDescription) -> Float[np.ndarray, "positions 2"]:
    """Return the first sample (x, y) of each position's Bayer cell, on a grid over the sensor, row by row."""
    sides = ((rig.camera.columns, rig.captures.psf_columns), (rig.camera.rows, rig.captures.psf_rows))
    across, down = (_even(_places(side, count)) for side, count in sides)
    return np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)


def _places(side: int, count: int) -> Float[np.ndarray, " count"]:
    if count == 1:
        return np.array([side / 2])
    return np.linspace(_INSET * side, (1 - _INSET) * side - CELL_PX, count)


def _even(values: Float[np.ndarray, " count"]) -> Float[np.ndarray, " count"]:
    return np.floor(values / 2) * 2
