"""Largest sizes of picture files, checked on the header before memory is allocated."""

from __future__ import annotations

from pathlib import Path

from udccal.errors import FileFormatError

MAX_SIDE = 16384
MAX_PIXELS = 160_000_000  # the largest sensors sold have 151 million
MAX_SAMPLES = 2 * MAX_PIXELS  # an average has means and variances
MAX_PICTURE_BYTES = 4 * MAX_SAMPLES + (1 << 20)  # 32-bit floats that nothing shrinks, and what stands around them

Shape = tuple[int, int]


def check_size(path: Path, rows: int, columns: int, channels: int = 1, shape: Shape | None = None) -> None:
    """Refuse a picture that is empty or larger than any sensor, panel or atlas udccal handles, or of another shape.

    Args:
        path: the file, for the message.
        rows, columns, channels: size from the file's header.
        shape: rows and columns that the picture must have, where they are known.

    Raises:
        FileFormatError: when it has more than 16384 samples per side, 160 million pixels or 320 million samples, or
            another shape.
    """
    if shape is not None and (rows, columns) != shape:
        raise FileFormatError(
            f"Expected {path} to have {shape[1]} x {shape[0]} samples, found {columns} x {rows}. "
            "Check that it is the right file."
        )
    sides_fit = 0 < rows <= MAX_SIDE and 0 < columns <= MAX_SIDE
    if not sides_fit or rows * columns > MAX_PIXELS or rows * columns * channels > MAX_SAMPLES:
        raise FileFormatError(
            f"Expected {path} to have 1 to {MAX_SIDE} samples per side and at most {MAX_PIXELS} pixels in all, "
            f"found {columns} x {rows} x {channels}. Check that it is the right file, or crop it."
        )
