"""PSF: exposure brackets of a small LED at field positions on a grid, each at several sub-pixel shifts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, final

import numpy as np
from jaxtyping import Float

from procedures.aiming import low_discrepancy
from procedures.base import Procedure, Step
from procedures.checks import shows_led
from procedures.plans import Bracket, Metered
from udccal.arrangements import Led
from udccal.cameras.protocol import Region
from udccal.rig import RigDescription
from udccal.sessions.schema import TermName

_INSET = 0.04  # of the sensor's side
_LEVEL = 0.8  # of saturation, in the brightest sample of the shortest exposure
_CELL_PX = 2.0  # a shift moves the LED within one cell of the Bayer pattern


@final
class PsfProcedure(Procedure):
    """Each shift moves the LED within a 2 x 2 cell, so that together they sample every channel below its pitch."""

    term: ClassVar[TermName] = "psf"

    def steps(self, rig: RigDescription) -> Iterator[Step]:
        """Yield all shifts of one position, then the next position."""
        captures = rig.captures
        shifts = _CELL_PX * low_discrepancy(captures.psf_shifts)
        for position, (x, y) in enumerate(led_positions_px(rig)):
            region = region_around(rig, float(x), float(y))
            for shift, (dx, dy) in enumerate(shifts):
                led = Led(float(x + dx), float(y + dy), captures.psf_distance_mm, captures.psf_led_mm)
                yield Step(
                    id=f"psf/p{position:02d}_s{shift}",
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


def led_positions_px(rig: RigDescription) -> Float[np.ndarray, "positions 2"]:
    """Return the first sample (x, y) of each position's Bayer cell, on a grid over the sensor, row by row."""
    sides = ((rig.camera.columns, rig.captures.psf_columns), (rig.camera.rows, rig.captures.psf_rows))
    across, down = (_even(_places(side, count)) for side, count in sides)
    return np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)


def region_around(rig: RigDescription, x_px: float, y_px: float) -> Region:
    """Return the region with the LED near its middle; at the sensor's edge it is moved inwards and keeps its size."""
    captures, camera = rig.captures, rig.camera
    columns = min(captures.psf_region_columns, camera.columns) // 2 * 2
    rows = min(captures.psf_region_rows, camera.rows) // 2 * 2
    x = min(max(x_px - columns / 2, 0), camera.columns - columns)
    y = min(max(y_px - rows / 2, 0), camera.rows - rows)
    return Region(int(x) // 2 * 2, int(y) // 2 * 2, columns, rows)


def _places(side: int, count: int) -> Float[np.ndarray, " count"]:
    if count == 1:
        return np.array([side / 2])
    return np.linspace(_INSET * side, (1 - _INSET) * side - _CELL_PX, count)


def _even(values: Float[np.ndarray, " count"]) -> Float[np.ndarray, " count"]:
    return np.floor(values / 2) * 2
