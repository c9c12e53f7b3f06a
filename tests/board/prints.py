"""Prints on paper that exist as pixels only: pages of a PDF at a known resolution, measured in millimetres."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import pypdfium2
from jaxtyping import Float, UInt8

from udccal.arrangements import BoardSpec

_MM_PER_INCH, _POINTS_PER_INCH = 25.4, 72.0


@dataclass(frozen=True)
class Print:
    """Grey pixels, and the size of one in mm (across, down): a page is rounded up to whole pixels by less than one."""

    pixels: UInt8[np.ndarray, "rows columns"]
    pixel_mm: tuple[float, float]


def printed(pdf: bytes, page: int, dpi: float, part_mm: tuple[float, float, float, float] | None = None) -> Print:
    """Print one page, or a part of it: left, top, width and height in mm from the page's top left corner."""
    document = pypdfium2.PdfDocument(pdf)
    try:
        sheet, scale = document[page], dpi / _POINTS_PER_INCH
        size = sheet.get_width(), sheet.get_height()
        cut = (0.0, 0.0, 0.0, 0.0)
        if part_mm is not None:
            left, top, width, height = (mm / _MM_PER_INCH * _POINTS_PER_INCH for mm in part_mm)
            cut = (left, size[1] - top - height, size[0] - left - width, top)
        pixels = sheet.render(scale=scale, crop=cut, grayscale=True).to_numpy().copy()
        across, down = (side * _MM_PER_INCH / _POINTS_PER_INCH / math.ceil(side * scale) for side in size)
        return Print(pixels, (across, down))
    finally:
        document.close()


def corners_mm(found: Print, spec: BoardSpec) -> Float[np.ndarray, "n 2"]:
    """Places of the board's inner corners that OpenCV's detector finds, in mm from the first one, by number."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
    board = cv2.aruco.CharucoBoard((spec.columns, spec.rows), spec.square_mm, spec.marker_mm, dictionary)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(found.pixels)
    assert ids is not None
    assert ids.ravel().tolist() == list(range((spec.columns - 1) * (spec.rows - 1)))
    places = corners.reshape(-1, 2) * found.pixel_mm
    return places - places[0]


def marks_mm(found: Print, axis: int) -> Float[np.ndarray, " marks"]:
    """Middles of the dark marks along a strip, weighted by their darkness; ``axis`` 0 is across, 1 is down the page."""
    dark = 255.0 - found.pixels.mean(axis=axis)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], dark > 25, [False]]).astype(int)))
    middles = [np.average(np.arange(a, b), weights=dark[a:b]) for a, b in zip(ends[::2], ends[1::2], strict=True)]
    return np.array(middles) * found.pixel_mm[axis]
