"""``frames.csv``: a table for pictures that do not contain, or contain wrongly, how they were taken."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Final

from udccal.cameras.picture_files.listing import MAX_FILES, ListedPicture, list_files, pictures_in
from udccal.errors import CameraError, FileFormatError

NAME: Final = "frames.csv"
_COLUMNS: Final = ("file", "exposure_s", "gain_dB", "timestamp_s")
_MAX_BYTES: Final = 4 << 20
_EXPOSURES_S: Final = (1e-7, 86400.0)
_GAINS_DB: Final = (-100.0, 100.0)
_TIMES_S: Final = (-1e12, 1e12)


def list_folder(folder: Path) -> tuple[ListedPicture, ...]:
    """List the frames of ``folder``: those of its ``frames.csv`` in that order, else all pictures by name.

    Raises:
        CameraError: when there are none, or the table names other files than the folder holds.
        FileFormatError: when the table does not follow docs/cameras.md.
    """
    present = pictures_in(folder)
    table = folder / NAME
    if not table.is_file():
        if not present:
            raise CameraError(f"Expected pictures in {folder}, found none. Put the files of the step there.")
        return list_files(present)
    listed = _read(table)
    missing = {item.path for item in listed} ^ set(present)
    if missing or len({item.path for item in listed}) != len(listed):
        name = min(missing).name if missing else "a file twice"
        raise CameraError(
            f"Expected {table} to list every picture of its folder once, found otherwise for {name}. "
            "Add or remove its line."
        )
    return listed


def _read(table: Path) -> tuple[ListedPicture, ...]:
    if table.stat().st_size > _MAX_BYTES:
        raise FileFormatError(f"Expected {table} to hold at most {_MAX_BYTES} bytes, found more. Use one per step.")
    try:
        lines = list(csv.reader(table.read_text("utf-8-sig").splitlines(), strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise FileFormatError(f"Expected {table} to be a table in UTF-8, found: {error}. Save it as CSV.") from error
    header = tuple(lines[0]) if lines else ()
    if header not in [_COLUMNS[:length] for length in (2, 3, 4)] or not 1 < len(lines) <= MAX_FILES + 1:
        raise FileFormatError(
            f"Expected {table} to begin with the line '{','.join(_COLUMNS)}' (the last two may be left out) and to "
            f"have 1 to {MAX_FILES} more, found '{','.join(header)[:80]}' and {max(len(lines) - 1, 0)}. Correct it."
        )
    return tuple(_listed(table, number, line, len(header)) for number, line in enumerate(lines[1:], start=2))


def _listed(table: Path, number: int, line: list[str], columns: int) -> ListedPicture:
    if len(line) != columns or Path(line[0]).name != line[0]:
        raise FileFormatError(
            f"Expected {columns} columns and the bare name of a file in line {number} of {table}, found "
            f"'{','.join(line)[:80]}'. Correct it."
        )
    values = [
        _number(table, number, text, bounds)
        for text, bounds in zip(line[1:], (_EXPOSURES_S, _GAINS_DB, _TIMES_S), strict=False)
    ]
    return ListedPicture(table.parent / line[0], *values)


def _number(table: Path, number: int, text: str, bounds: tuple[float, float]) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not bounds[0] <= value <= bounds[1]:
        raise FileFormatError(
            f"Expected a number from {bounds[0]:g} to {bounds[1]:g} in line {number} of {table}, found '{text[:40]}'. "
            "Correct it; use a decimal point, no comma."
        )
    return value
