"""Photographs in any common format as linear RGB light."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from udccal.errors import FileFormatError
from udccal.io.exr import read_rgb_exr
from udccal.io.limits import check_size
from udccal.io.picture_header import picture_size
from udccal.io.png_chunks import SIGNATURE, png_fault

_MAX_BYTES = 256 * 1024 * 1024


def read_photograph(path: Path, gamma: float = 2.2) -> Float[np.ndarray, "rows columns 3"]:
    """Read a photograph as linear RGB.

    Args:
        path: an OpenEXR or Radiance picture, or an 8- or 16-bit PNG or JPEG.
        gamma: exponent that makes 8- and 16-bit values linear; OpenEXR and Radiance values are linear already.

    Returns:
        values from 0 to 1 for integer formats; negative values of float formats become 0.

    Raises:
        FileFormatError: when the file is missing, too large, or not a colour picture.
    """
    if not path.is_file():
        raise FileFormatError(f"Expected a photograph at {path}, found no file. Check the path.")
    if path.suffix.lower() == ".exr":
        return np.maximum(read_rgb_exr(path), 0.0)
    if path.stat().st_size > _MAX_BYTES:
        raise FileFormatError(f"Expected {path} to hold at most {_MAX_BYTES} bytes, found more. Use a smaller picture.")
    picture = _decoded(path, path.read_bytes())
    rgb = np.ascontiguousarray(picture[..., ::-1])
    if rgb.dtype == np.uint8:
        return (rgb.astype(np.float32) / 255.0) ** gamma
    if rgb.dtype == np.uint16:
        return (rgb.astype(np.float32) / 65535.0) ** gamma
    return np.maximum(rgb.astype(np.float32), 0.0)


def _decoded(path: Path, content: bytes) -> np.ndarray:
    """Decode blue, green and red, after checking the file's header and chunks."""
    size = picture_size(content)
    if size is None:
        raise FileFormatError(
            f"Expected {path} to be a PNG, JPEG, Radiance or OpenEXR picture, found another kind. Convert it, or check "
            "the path."
        )
    check_size(path, *size, 3)
    fault = png_fault(content) if content.startswith(SIGNATURE) else None
    encoded = np.frombuffer(content, np.uint8)
    picture = None if fault else cv2.imdecode(encoded, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if picture is None:
        raise FileFormatError(f"Expected {path} to be a whole picture, found {fault or 'damaged data'}. Copy it again.")
    return picture
