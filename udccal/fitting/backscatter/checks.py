"""Checks of the backscatter fit's data: arrays of fitting shapes, and bins whose numbers can be."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from udccal.arguments import check_array, found_instead
from udccal.errors import FitError
from udccal.rig import RigDescription

if TYPE_CHECKING:
    from udccal.fitting.backscatter.data import BackscatterData, Binned

_EACH: Final = "Give each shot its own."


def check_shapes(shots: Binned) -> None:
    """Raise FitError unless all arrays of shots are of their kind, and of the shape of the rates."""
    shape: tuple[int, ...] = getattr(shots.rate, "shape", ())
    if not isinstance(shots.rate, np.ndarray) or len(shape) < 3 or shape[1] != 3:
        found = found_instead(shots.rate)
        raise FitError(f"Expected rates as an array, shots x 3 colours x bins, found {found}. Bin the shots' averages.")
    for name in ("rate", "shot", "rest"):
        check_array(getattr(shots, name), name, "real numbers", shape, _EACH, FitError)
    check_array(shots.clipped, "clipped", "truth values", shape, _EACH, FitError)
    for name in ("exposure_s", "scatter"):
        check_array(getattr(shots, name), name, "real numbers", shape[:1], _EACH, FitError)


def check_data(data: BackscatterData) -> None:
    """Raise FitError unless there is a picture for each shot, and all numbers of bins and exposures can be."""
    shots, crop = data.shots, data.crop
    if shots.rate.ndim != 4:
        found = found_instead(shots.rate)
        raise FitError(f"Expected rates of shots x 3 x rows x columns, found {found}. Keep the grid's two dimensions.")
    pictures = max(len(shots.rate) - 2, 0)
    if len(shots.rate) == 1 or len(data.names) != pictures:
        expected = f"Expected a name for each shot between white and dark, {pictures}"
        raise FitError(
            f"{expected}, found {len(data.names)}. Give white first, dark last, and the names of the others."
        )
    shape = pictures, crop.rows, crop.columns, 3
    check_array(data.shown, "the pictures shown", "8-bit values", shape, _EACH, FitError)
    if not (np.isfinite(shots.exposure_s) & (shots.exposure_s > 0)).all():
        found = shots.exposure_s[:8].tolist()
        raise FitError(f"Expected positive exposures, found {found}. Give the exposure of each shot in seconds.")
    possible = np.isfinite(shots.rate + shots.shot + shots.rest) & (shots.shot > 0) & (shots.rest >= 0)
    if not possible.all():
        shot, colour, row, column = np.argwhere(~possible)[0].tolist()
        first = f"{('white', *data.names, 'dark')[shot]}, {'RGB'[colour]}, bin ({column}, {row})"
        found = f"found {np.sum(~possible)} others, the first in {first}"
        raise FitError(
            "Expected a rate, a variance per rate above 0 and a variance in the dark of 0 or more in every bin, "
            f"{found}. Check the noise term, and the map that divides the rates."
        )


def check_grid(shots: Binned, step: int, rig: RigDescription) -> None:
    """Raise FitError unless the shots' grid is that of the rig's sensor, ``step`` px apart."""
    expected, found = (rig.camera.rows // step, rig.camera.columns // step), shots.rate.shape[2:]
    if len(shots.rate) and found != expected:
        raise FitError(f"Expected a grid of {expected} bins for this sensor, found {found}. Bin all of the sensor.")
