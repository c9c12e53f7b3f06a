"""A sheet of pictures per tier, for eyes: before, restored and true, of parts at full size."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from jaxtyping import UInt8

from tests.benchmarks.pareto.groups import USUAL, Group
from tests.benchmarks.pareto.runs import Sight
from tests.benchmarks.pictures import Rgb
from udccal.io.png import write_rgb8
from udccal.restoration.tone import to_rgb8

_ROWS, _COLUMNS = 300, 420
_LABEL_ROWS: Final = 22
# Width in px over which detail is averaged to find the part that has most.
_WINDOW: Final = (81, 81)


@dataclass(frozen=True)
class Shown:
    """One row of a sheet: parts of pictures side by side, and a title."""

    title: str
    parts: UInt8[np.ndarray, "rows columns 3"]


def is_shown(sight: Sight) -> bool:
    """Whether a sight is on the sheets: a few of each group, no picture twice."""
    case = sight.case
    if case.group is Group.lamps:
        return True
    if case.conditions == USUAL:
        return case.shot.name in ("kodim05", "kodim23", "lobby view", "mosaic 1", "mosaic 3", "park bands")
    return case.conditions.name in ("light / 64", "white, known", "faces, unknown")


def shown_part(title: str, before: Rgb, after: Rgb, truth: Rgb) -> Shown:
    """Cut the busiest part of the truth out of display-encoded pictures, at full size."""
    part = busiest_part(truth, _ROWS, _COLUMNS)
    return Shown(title, np.concatenate([to_rgb8(picture[part]) for picture in (before, after, truth)], axis=1))


def write_sheet(shown: Iterable[Shown], path: Path) -> None:
    """Write the rows below each other."""
    write_rgb8(path, np.concatenate([_titled(each) for each in shown]))


def busiest_part(truth: Rgb, rows: int, columns: int) -> tuple[slice, slice]:
    """The part of a picture with the most detail about its middle.

    Args:
        truth: display-encoded.
        rows: of the part. columns: of the part; the whole picture's where that has fewer.
    """
    grey = truth.mean(axis=2)
    detail = cv2.blur(np.abs(grey - cv2.blur(grey, (3, 3))), _WINDOW)
    y, x = np.unravel_index(int(detail.argmax()), detail.shape)
    top = int(np.clip(y - rows // 2, 0, max(grey.shape[0] - rows, 0)))
    left = int(np.clip(x - columns // 2, 0, max(grey.shape[1] - columns, 0)))
    return slice(top, top + rows), slice(left, left + columns)


def _titled(shown: Shown) -> UInt8[np.ndarray, "rows columns 3"]:
    label = np.zeros((_LABEL_ROWS, shown.parts.shape[1], 3), dtype=np.uint8)
    cv2.putText(label, shown.title, (4, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return np.concatenate([label, shown.parts])
