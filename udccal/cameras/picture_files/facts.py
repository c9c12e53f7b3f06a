"""Reads how a picture was taken from its file, without its samples (Exif 2.32, section 4.6; DNG 1.6)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, final

from udccal.cameras.picture_files.raw import libraw_facts
from udccal.cameras.picture_files.tags import Directory, is_tiff
from udccal.errors import FileFormatError

_MAKE, _MODEL, _EXIF, _DNG_SERIAL = 271, 272, 34665, 50735
_EXPOSURE_TIME, _SENSITIVITY, _ISO_SPEED = 33434, 34855, 34867
_TIME_ORIGINAL, _SUBSECONDS_ORIGINAL, _BODY_SERIAL = 36867, 37521, 42033
_SEE_ISO_SPEED: Final = 65535  # what the 16-bit field holds when the sensitivity does not fit
_MAX_TEXT: Final = 100
_SAY_NOTHING: Final = (".png", ".exr")


@final
@dataclass(frozen=True)
class Facts:
    """Fields of a file; None or empty where the file does not have them.

    Attributes:
        taken_s: seconds since 1970 by the camera's own clock and calendar.
    """

    vendor: str = ""
    model: str = ""
    serial: str = ""
    exposure_s: float | None = None
    iso: float | None = None
    taken_s: float | None = None


def read_facts(path: Path) -> Facts:
    """Read the fields of the file at ``path``.

    LibRaw returns 1 s where a TIFF-like file leaves the exposure blank, so it reads only files of other formats.

    Raises:
        FileFormatError: when the file is missing or damaged.
    """
    if not path.is_file():
        raise FileFormatError(f"Expected a picture file at {path}, found none. Check the path.")
    if path.suffix.lower() in _SAY_NOTHING:
        return Facts()
    with path.open("rb") as stream:
        if is_tiff(stream.read(4)):
            return _facts(Directory.first(stream, path))
    exposure_s, iso, taken_s = libraw_facts(path)
    return Facts("", "", "", exposure_s, iso, taken_s)


def _facts(main: Directory) -> Facts:
    exif = main.under(_EXIF)
    places = (main,) if exif is None else (exif, main)  # DNG allows the fields of Exif in the main directory
    return Facts(
        vendor=main.text(_MAKE)[:_MAX_TEXT],
        model=main.text(_MODEL)[:_MAX_TEXT],
        serial=(main.text(_DNG_SERIAL) or _text(places, _BODY_SERIAL))[:_MAX_TEXT],
        exposure_s=_positive(places, _EXPOSURE_TIME),
        iso=_iso(places),
        taken_s=_time(_text(places, _TIME_ORIGINAL), _text(places, _SUBSECONDS_ORIGINAL)),
    )


def _iso(places: tuple[Directory, ...]) -> float | None:
    short = _positive(places, _SENSITIVITY)
    return _positive(places, _ISO_SPEED) if short == _SEE_ISO_SPEED else short


def _positive(places: tuple[Directory, ...], tag: int) -> float | None:
    """Return the first usable number of several fields; blank fields are written as 0."""
    values = (place.number(tag) for place in places)
    return next((value for value in values if value is not None and 0 < value < math.inf), None)


def _text(places: tuple[Directory, ...], tag: int) -> str:
    return next((text for place in places if (text := place.text(tag))), "")


def _time(text: str, subseconds: str) -> float | None:
    try:
        seconds = datetime.strptime(text, "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC).timestamp()
    except ValueError:
        return None
    digits = subseconds[:9]
    return seconds + (float(f"0.{digits}") if digits.isdecimal() and digits.isascii() else 0.0)
