"""How large a picture file may be before it is refused, checked on the header before memory is taken."""

from __future__ import annotations

from pathlib import Path

from udccal.errors import FileFormatError

MAX_SIDE = 16384
MAX_SAMPLES = 400_000_000


def check_size(path: Path, rows: int, columns: int, channels: int = 1) -> None:
    """Refuse a picture that is empty or larger than any sensor, panel or atlas udccal handles.

    Raises:
        FileFormatError: beyond 16384 samples per side or 400 million samples in all.
    """
    sides_fit = 0 < rows <= MAX_SIDE and 0 < columns <= MAX_SIDE
    if not sides_fit or rows * columns * channels > MAX_SAMPLES:
        raise FileFormatError(
            f"Expected {path} to have 1 to {MAX_SIDE} samples per side and at most {MAX_SAMPLES} in all, "
            f"found {columns} x {rows} x {channels}. Check that it is the right file, or crop it."
        )
