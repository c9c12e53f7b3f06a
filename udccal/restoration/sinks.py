"""Files of restored pictures: PNG for viewing, EXR for further work."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from udccal.errors import RestorationError
from udccal.io.exr import write_rgb_exr
from udccal.io.png import write_rgb8
from udccal.restoration.tone import Tone, to_rgb8


def write_picture(path: Path, linear: Float[np.ndarray, "rows columns 3"], tone: Tone) -> None:
    """Write a restored picture atomically, in the format of the file's name.

    Args:
        path: ``*.exr`` gets linear values in e-/s, ``*.png`` display-encoded ones.
        linear: restored picture in e-/s.
        tone: exposure and colour gains of the display-encoded picture.

    Raises:
        RestorationError: when the name has another ending.
    """
    if path.suffix == ".exr":
        write_rgb_exr(path, linear)
    elif path.suffix == ".png":
        write_rgb8(path, to_rgb8(tone.apply(linear)))
    else:
        raise RestorationError(
            f"Expected a picture name ending in .png or .exr, found '{path.name}'. Choose one of these."
        )
