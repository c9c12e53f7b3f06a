"""Files of restored pictures: PNG for viewing, EXR for further work."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from udccal.errors import RestorationError
from udccal.io.atomic import write_atomically
from udccal.io.exr import write_rgb_exr
from udccal.io.png import write_rgb8
from udccal.restoration.tone import Tone, to_rgb8, to_rgb16


def write_picture(path: Path, linear: Float[np.ndarray, "rows columns 3"], tone: Tone, bits: int = 8) -> None:
    """Write a restored picture atomically, in the format of the file's name.

    Args:
        path: ``*.exr`` gets linear values in e-/s, ``*.png`` display-encoded ones.
        linear: restored picture in e-/s.
        tone: exposure and colour gains of the display-encoded picture.
        bits: 8 or 16, for PNG.

    Raises:
        RestorationError: when the name has another ending, or ``bits`` is another number.
    """
    if path.suffix == ".exr":
        write_rgb_exr(path, linear)
    elif path.suffix == ".png" and bits == 8:
        write_rgb8(path, to_rgb8(tone.apply(linear)))
    elif path.suffix == ".png" and bits == 16:
        write_atomically(path, _png16(path, to_rgb16(tone.apply(linear))))
    else:
        raise RestorationError(
            f"Expected a picture name ending in .png (8 or 16 bits) or .exr, found '{path.name}' with {bits} bits. "
            "Choose one of these."
        )


def _png16(path: Path, picture: np.ndarray) -> bytes:
    done, encoded = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
    if not done:
        raise RestorationError(
            f"Expected to encode {path} as PNG, found that OpenCV could not. Check the picture's size."
        )
    return encoded.tobytes()
