"""Reads Bayer mosaics of camera raw files through LibRaw. The only module that imports rawpy."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import UTC
from pathlib import Path
from typing import Final

import numpy as np
import rawpy

from udccal.cameras.picture_files.mosaic import Mosaic
from udccal.errors import FileFormatError
from udccal.io.limits import Shape, check_size

RAW_SUFFIXES = (
    *(".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".srf", ".sr2", ".raf", ".rw2", ".orf"),
    *(".pef", ".srw", ".3fr", ".fff", ".iiq", ".erf", ".mrw", ".kdc", ".dcr", ".mos", ".raw"),
)
# How files of these kinds begin (LibRaw 0.22, identify.cpp). LibRaw takes any other file for one of a camera whose
# files have the same length.
_START: Final = re.compile(
    rb"II\*\0|MM\0\*|II(U\0|RO|RS)|MMOR|IIII.waR|MMMMRaw|FUJIFILM|\0MRM|.{4}ftypcrx |.{25}ARECOYK", re.DOTALL
)
_START_BYTES: Final = 32


def raw_mosaic(path: Path, shape: Shape | None = None) -> Mosaic:
    """Read the visible part of a Bayer mosaic, with no processing but the decoding of the maker's format.

    A mosaic of another ``shape`` (rows, columns) than the given one is refused before it is decoded.

    Raises:
        FileFormatError: when it is missing, not a raw file, damaged, too large, of another shape, or not a 2 x 2
            Bayer mosaic.
    """
    with _opened(path) as raw:
        check_size(path, raw.sizes.raw_height, raw.sizes.raw_width)
        check_size(path, raw.sizes.height, raw.sizes.width, shape=shape)
        raw.unpack()
        return Mosaic(
            data=raw.raw_image_visible.copy(),
            cfa=_cfa(path, raw),
            black_DN=float(np.mean(raw.black_level_per_channel)),
            saturation_DN=int(raw.white_level),
        )


def libraw_facts(path: Path) -> tuple[float | None, float | None, float | None]:
    """Return exposure in s, ISO and time in s since 1970 from LibRaw; None where the file does not contain them.

    A file without an ISO counts as one without an exposure: LibRaw replaces a blank exposure by 1 s.

    Raises:
        FileFormatError: as ``raw_mosaic``.
    """
    with _opened(path) as raw:
        other = getattr(raw, "other", None)  # older rawpy does not have it
        if other is None or not other.iso_speed > 0:
            return None, None, None
        exposure = float(other.shutter_speed)
        taken = other.timestamp.replace(tzinfo=UTC).timestamp()
        return exposure if exposure > 0 else None, float(other.iso_speed), taken if taken > 0 else None


@contextmanager
def _opened(path: Path) -> Iterator[rawpy.RawPy]:
    if not path.is_file():
        raise FileFormatError(f"Expected a camera raw file at {path}, found none. Check the path.")
    _check_start(path)
    try:
        with closing(rawpy.RawPy()) as raw:
            raw.open_file(str(path))
            yield raw
    except rawpy.LibRawError as error:
        reason = error.args[0] if error.args else type(error).__name__
        shown = reason.decode("ascii", "replace") if isinstance(reason, bytes) else str(reason)
        message = f"Expected {path} to be a whole camera raw file, found: {shown}. Copy it again."
        raise FileFormatError(message) from error


def _check_start(path: Path) -> None:
    with path.open("rb") as stream:
        start = stream.read(_START_BYTES)
    if _START.match(start) is None:
        raise FileFormatError(
            f"Expected {path} to begin as a camera raw file does, found no header, so that its size and pattern would "
            "be a guess. Convert it to DNG; as frames of --camera files, 16-bit TIFF or PNG do as well."
        )


def _cfa(path: Path, raw: rawpy.RawPy) -> str:
    bayer = raw.raw_type == rawpy.RawType.Flat and raw.raw_pattern is not None and raw.raw_pattern.shape == (2, 2)
    names = raw.color_desc.decode("ascii", "replace")
    cfa = "".join(names[int(index)] for index in raw.raw_colors_visible[:2, :2].ravel()) if bayer else ""
    if sorted(cfa) != ["B", "G", "G", "R"]:
        raise FileFormatError(f"Expected a 2 x 2 Bayer mosaic in {path}, found another layout. Use a raw Bayer file.")
    return cfa
