"""Reads mosaics from files of every kind."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, final

import numpy as np
from jaxtyping import UInt16

from udccal.cameras.picture_files.facts import read_facts
from udccal.cameras.picture_files.mosaic import Mosaic
from udccal.cameras.picture_files.raw import RAW_SUFFIXES, raw_mosaic
from udccal.cameras.picture_files.tiff import read_tiff16
from udccal.errors import FileFormatError
from udccal.io.exr import read_exr
from udccal.io.limits import Shape
from udccal.io.png import read_png16

PICTURE_SUFFIXES: Final = (".png", ".tif", ".tiff", ".exr", *RAW_SUFFIXES)
_MAX_DN: Final = 65535


@final
@dataclass(frozen=True)
class Layout:
    """What PNG, TIFF and EXR files do not contain: the CFA pattern (``mono`` for none), and the bits per sample."""

    cfa: str
    bits: int


def read_raw(path: Path, shape: Shape | None = None) -> Mosaic:
    """Read a camera raw file with its pattern, levels and exposure.

    Args:
        path: the file.
        shape: expected (rows, columns), checked before decoding; None for any.

    Raises:
        FileFormatError: when it is missing, not a raw file, damaged, too large, or not a 2 x 2 Bayer mosaic.
    """
    return replace(raw_mosaic(path, shape), exposure_s=read_facts(path).exposure_s)


def read_mosaic(path: Path, layout: Layout) -> Mosaic:
    """Read the samples of any file that holds a mosaic.

    Args:
        path: the file.
        layout: pattern and bits of PNG, TIFF and EXR files; raw files contain their own.

    Raises:
        FileFormatError: when it cannot be read, or has samples beyond the layout's bits.
    """
    match path.suffix.lower():
        case ".png":
            data = read_png16(path)
        case ".tif" | ".tiff":
            data = read_tiff16(path)
        case ".exr":
            data = _single_plane(path)
        case _:
            return raw_mosaic(path)
    limit = 2**layout.bits - 1
    if int(data.max()) > limit:
        raise FileFormatError(
            f"Expected samples of {layout.bits} bits in {path}, found {int(data.max())} DN. Give its bits."
        )
    return Mosaic(data, layout.cfa, 0.0, limit)


def _single_plane(path: Path) -> UInt16[np.ndarray, "rows columns"]:
    """Read an EXR of one channel that holds DN; round fractions."""
    channels = list(read_exr(path).values())
    if len(channels) != 1 or channels[0].min() < 0 or channels[0].max() > _MAX_DN:
        raise FileFormatError(
            f"Expected one channel of 0 to {_MAX_DN} DN in {path}, found something else. Use a mosaic."
        )
    return np.rint(channels[0]).astype(np.uint16)
