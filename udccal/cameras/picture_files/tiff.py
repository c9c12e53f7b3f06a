"""Reads mosaics from TIFF files, 16-bit and of one channel; OpenCV decodes them after a check of the directory."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import cv2
import numpy as np
from jaxtyping import UInt16

from udccal.cameras.picture_files.tags import Directory
from udccal.errors import FileFormatError
from udccal.io.limits import MAX_SAMPLES, check_size

_COLUMNS, _ROWS, _BITS, _COMPRESSION, _PHOTOMETRIC = 256, 257, 258, 259, 262
_STRIPS, _ORIENTATION, _CHANNELS, _STRIP_BYTES = 273, 274, 277, 279
_ROWS_PER_STRIP, _TILE_COLUMNS, _TILE_ROWS, _TILES, _TILE_BYTES, _SAMPLE_FORMAT = 278, 322, 323, 324, 325, 339
_UNCOMPRESSED: Final = 1
_LOSSLESS: Final = (1, 5, 8, 32946, 32773)  # none, LZW, Deflate and its older code, PackBits
_BLACK_IS_ZERO, _CFA = 1, 32803
_MAX_BYTES: Final = 2 * MAX_SAMPLES + (1 << 20)


def read_tiff16(path: Path) -> UInt16[np.ndarray, "rows columns"]:
    """Read a TIFF of one upright 16-bit picture of one channel, black at 0, coded without loss.

    Raises:
        FileFormatError: when it is missing, another kind of TIFF, too large, or cut short.
    """
    if not path.is_file():
        raise FileFormatError(f"Expected a TIFF file at {path}, found none. Check the path.")
    with path.open("rb") as stream:
        directory = Directory.first(stream, path)
        rows, columns = _checked(directory, path)
        stream.seek(0)
        content = np.frombuffer(stream.read(_MAX_BYTES), np.uint8)
    try:
        picture = cv2.imdecode(content, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise _damaged(path) from error
    if picture is None or picture.dtype != np.uint16 or picture.shape != (rows, columns):
        raise _damaged(path)
    return picture


def _checked(directory: Directory, path: Path) -> tuple[int, int]:
    """Return rows and columns; refuse a directory that describes another kind of picture."""
    rows, columns = _one(directory, _ROWS, 0), _one(directory, _COLUMNS, 0)
    check_size(path, rows, columns)
    found = (
        ("bits", _one(directory, _BITS, 1), (16,)),
        ("channels", _one(directory, _CHANNELS, 1), (1,)),
        ("compression", _one(directory, _COMPRESSION, 1), _LOSSLESS),
        ("photometric interpretation", _one(directory, _PHOTOMETRIC, -1), (_BLACK_IS_ZERO, _CFA)),
        ("sample format", _one(directory, _SAMPLE_FORMAT, 1), (1,)),
        ("orientation", _one(directory, _ORIENTATION, 1), (1,)),
        ("further pictures from", directory.following, (0,)),
    )
    for what, value, allowed in found:
        if value not in allowed:
            raise FileFormatError(
                f"Expected {path} to be one upright picture of one 16-bit channel without loss, found {what} {value}. "
                "Export it as 16-bit greyscale TIFF."
            )
    _check_parts(directory, path, rows, columns)
    return rows, columns


def _check_parts(directory: Directory, path: Path, rows: int, columns: int) -> None:
    """Check that every strip or tile lies in the file: decoders differ in how they fill a missing one."""
    tiled = bool(directory.integers(_TILES))
    starts = directory.integers(_TILES if tiled else _STRIPS)
    lengths = directory.integers(_TILE_BYTES if tiled else _STRIP_BYTES)
    part_rows = max(1, _one(directory, _TILE_ROWS if tiled else _ROWS_PER_STRIP, rows))
    part_columns = max(1, _one(directory, _TILE_COLUMNS, columns)) if tiled else columns
    expected = -(-rows // part_rows) * -(-columns // part_columns)
    size = path.stat().st_size
    if len(starts) != expected or len(lengths) != expected or size > _MAX_BYTES:
        raise _damaged(path)
    if any(start + length > size or length == 0 for start, length in zip(starts, lengths, strict=True)):
        raise _damaged(path)
    if _one(directory, _COMPRESSION, _UNCOMPRESSED) == _UNCOMPRESSED and sum(lengths) < 2 * rows * columns:
        raise _damaged(path)


def _one(directory: Directory, tag: int, default: int) -> int:
    values = directory.integers(tag)
    return values[0] if values else default


def _damaged(path: Path) -> FileFormatError:
    return FileFormatError(f"Expected {path} to be a whole 16-bit TIFF file, found damaged data. Copy it again.")
