"""Reads the file of the picture that the panel showed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from udccal.io.png import read_rgb8
from udccal.rig import RigDescription


def read_panel_picture(path: Path, rig: RigDescription) -> UInt8[np.ndarray, "panel_rows panel_columns 3"]:
    """Read an 8-bit RGB picture of the panel's own size.

    Raises:
        FileFormatError: when it cannot be read or has another size.
    """
    return read_rgb8(path, (rig.panel.rows, rig.panel.columns))
