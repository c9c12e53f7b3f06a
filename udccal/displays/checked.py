"""The check that every display makes before it shows a picture."""

from __future__ import annotations

import numpy as np

from udccal.displays.protocol import PanelSize
from udccal.errors import DisplayError


def check_picture(picture: np.ndarray, size: PanelSize) -> None:
    """Refuse a picture that is not 8-bit RGB, (rows, columns, 3), of the panel's size: a display never resamples.

    Raises:
        DisplayError: when it is another.
    """
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
        raise DisplayError(
            f"Expected an 8-bit RGB picture of shape (rows, columns, 3), found {picture.dtype} of shape "
            f"{picture.shape}. Convert it."
        )
    rows, columns = picture.shape[:2]
    if (columns, rows) != (size.columns, size.rows):
        raise DisplayError(
            f"Expected a picture of {size.columns} x {size.rows} pixels, found {columns} x {rows}. "
            "Make it at the panel's own resolution."
        )
