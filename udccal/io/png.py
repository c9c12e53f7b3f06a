"""PNG files: 16-bit mosaics exactly as a camera delivered them, and 8-bit RGB pictures."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16

from udccal.errors import FileFormatError
from udccal.io.atomic import write_atomically
from udccal.io.limits import Shape, check_size
from udccal.io.png_chunks import SIGNATURE, png_fault

_GREY, _RGB = 0, 2
# Neighbours in a mosaic differ by colour and noise. Filters and a search for repeats do not shrink it, and take two
# thirds of the time. Level 1 shrinks pictures nearly as far as higher levels do.
_MOSAIC = [
    *(cv2.IMWRITE_PNG_COMPRESSION, 1),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY),
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE),
]
# A PNG is not much larger than its samples; its texts and profiles fit into a megabyte.
_MOST_OVERHEAD, _MOST_EXTRA = 2, 1 << 20
_PICTURE = [cv2.IMWRITE_PNG_COMPRESSION, 1]


class _Header(NamedTuple):
    columns: int
    rows: int
    bits: int
    colour: int


def read_png16(path: Path, shape: Shape | None = None) -> UInt16[np.ndarray, "rows columns"]:
    """Read a 16-bit mosaic in DN.

    Args:
        path: the file.
        shape: expected (rows, columns); a file of another shape is not decoded.

    Raises:
        FileFormatError: when the file is missing, truncated, too large, of another shape, or not 16-bit greyscale.
    """
    return _read(path, 16, _GREY, "a 16-bit greyscale PNG", shape)


def write_png16(path: Path, mosaic: UInt16[np.ndarray, "rows columns"]) -> None:
    """Write a mosaic as 16-bit greyscale PNG, atomically and without loss.

    Args:
        path: the file; an earlier one is replaced.
        mosaic: samples in DN.

    Raises:
        OSError: when the disk is full or cannot be written to.
        FileFormatError: when the size is out of bounds.
    """
    _write(path, mosaic, _MOSAIC)


def read_rgb8(path: Path, shape: Shape | None = None) -> UInt8[np.ndarray, "rows columns 3"]:
    """Read an 8-bit RGB picture, in the order R, G, B.

    Args:
        path: the file.
        shape: expected (rows, columns); a file of another shape is not decoded.

    Raises:
        FileFormatError: when the file is missing, truncated, too large, of another shape, or not 8-bit RGB.
    """
    picture = _read(path, 8, _RGB, "an 8-bit RGB PNG", shape)
    # Blue, green, red; where the file names a colour that is transparent, OpenCV adds a fourth channel.
    return np.ascontiguousarray(picture[..., 2::-1])


def write_rgb8(path: Path, picture: UInt8[np.ndarray, "rows columns 3"]) -> None:
    """Write an 8-bit RGB picture as PNG, atomically and without loss.

    Args:
        path: the file; an earlier one is replaced.
        picture: values in the order R, G, B.

    Raises:
        OSError: when the disk is full or cannot be written to.
        FileFormatError: when the size is out of bounds.
    """
    _write(path, np.ascontiguousarray(picture[..., ::-1]), _PICTURE)


def _write(path: Path, picture: np.ndarray, parameters: list[int]) -> None:
    check_size(path, picture.shape[0], picture.shape[1])
    # OpenCV takes every array for one in the processor's order of bytes.
    own = picture.astype(picture.dtype.newbyteorder("="), copy=False)
    done, encoded = cv2.imencode(".png", own, parameters)
    if not done:
        raise FileFormatError(f"Expected to encode {path} as PNG, found that OpenCV could not.")
    write_atomically(path, encoded.tobytes())


def _read(path: Path, bits: int, colour: int, expected: str, shape: Shape | None) -> np.ndarray:
    header = _checked_header(path, shape)
    if (header.bits, header.colour) != (bits, colour):
        raise FileFormatError(
            f"Expected {path} to be {expected}, found {header.bits} bits of colour type {header.colour}. "
            "Save it in that form."
        )
    pixel_bytes = bits // 8 * (3 if colour == _RGB else 1)
    most_bytes = _MOST_OVERHEAD * header.columns * header.rows * pixel_bytes + _MOST_EXTRA
    if path.stat().st_size > most_bytes:
        raise FileFormatError(f"Expected {path} to hold at most {most_bytes} bytes, found more. Copy it again.")
    content = path.read_bytes()
    fault = png_fault(content)
    if fault is not None:
        raise FileFormatError(f"Expected {path} to be a whole PNG file, found {fault}. Copy or capture it again.")
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise FileFormatError(f"Expected {path} to be {expected}, found damaged data. Copy or capture it again.")
    return picture


def _checked_header(path: Path, shape: Shape | None) -> _Header:
    """Read and check the IHDR chunk before the rest of the file is read."""
    if not path.is_file():
        raise FileFormatError(f"Expected a PNG file at {path}, found none. Check the path.")
    with path.open("rb") as stream:
        start = stream.read(33)
    if len(start) < 33 or not start.startswith(SIGNATURE) or start[12:16] != b"IHDR":
        raise FileFormatError(f"Expected {path} to be a PNG file, found other content. Check the file.")
    header = _Header(*struct.unpack(">IIBB", start[16:26]))
    check_size(path, header.rows, header.columns, 3 if header.colour == _RGB else 1, shape)
    return header
