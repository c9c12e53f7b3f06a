"""How large a picture file may be before it is refused, checked on the header before memory is taken."""

from __future__ import annotations

from pathlib import Path

from udccal.errors import FileFormatError

MAX_SIDE = 16384
MAX_PIXELS = 160_000_000  # the largest sensors sold have 151 million
MAX_SAMPLES = 2 * MAX_PIXELS  # of an average: means and variances

Shape = tuple[int, int]


def check_size(path: Path, rows: int, columns: int, channels: int = 1, shape: Shape | None = None) -> None:
    """Refuse a picture that is empty or larger than any sensor, panel or atlas udccal handles, or of another shape.

    Args:
        path: for the sentence. rows, columns, channels: as the file's header says.
        shape: rows and columns that it must have, where they are known.

    Raises:
        FileFormatError: beyond 16384 samples per side, 160 million pixels or 320 million samples, or of another shape.
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
