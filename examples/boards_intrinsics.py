"""Calibrate two real cameras from photographs of a chessboard, and compare with OpenCV's own calibration.

    python examples/boards_intrinsics.py --data ../shared/data

Each folder of photographs holds ``boards/left01.jpg`` ... and ``boards/right01.jpg`` ... of a board with 9 x 6 inner
corners. Distances are in squares: the size of a square changes no intrinsic parameter.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from udccal import FitResult, fit_geometry
from udccal.models.geometry import Geometry

INNER = (9, 6)
DEFAULT_DATA = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"


def chessboard_corners(picture: np.ndarray) -> np.ndarray | None:
    """Return the inner corners of a chessboard in px from OpenCV, or None when there is none."""
    found, corners = cv2.findChessboardCorners(picture, INNER)
    if not found:
        return None
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    return cv2.cornerSubPix(picture, corners, (5, 5), (-1, -1), stop)


def calibrate(name: str, files: list[Path]) -> FitResult[Geometry] | None:
    """Calibrate one camera from its photographs and print the result."""
    pictures = [picture for file in files if (picture := cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)) is not None]
    found = [corners for corners in map(chessboard_corners, pictures) if corners is not None]
    if len(found) < 3:
        print(f"{name}: a board was found in {len(found)} of {len(files)} photographs; at least 3 are needed.")
        return None
    rows, columns = pictures[0].shape
    x, y = np.meshgrid(np.arange(INNER[0]), np.arange(INNER[1]))
    board = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1).astype(np.float64)
    ours = fit_geometry([board] * len(found), found, (columns, rows))
    theirs, matrix, distortion, _, _ = cv2.calibrateCamera(
        [board.astype(np.float32)] * len(found), [c.astype(np.float32) for c in found], (columns, rows), None, None
    )
    lens, numbers = ours.term, {d.name: d.value for d in ours.diagnostics}
    order = next(c.name for c in ours.candidates if c.chosen)
    lost = int(numbers["corners_rejected"])
    print(f"{name}: board found in {len(found)} of {len(files)} pictures, {lost} corners left out")
    (fx, fy), (cx, cy) = lens.focal_px, lens.principal_point_px
    print(
        f"  udccal  rms {numbers['rms_reprojection']:.3f} px   fx {fx:.2f} fy {fy:.2f} cx {cx:.2f} cy {cy:.2f}   "
        f"distortion: {order} {np.round(lens.distortion, 4)}"
    )
    print(
        f"  OpenCV  rms {theirs:.3f} px   fx {matrix[0, 0]:.2f} fy {matrix[1, 1]:.2f} "
        f"cx {matrix[0, 2]:.2f} cy {matrix[1, 2]:.2f}   distortion: all five {np.round(distortion.ravel()[:5], 4)}"
    )
    return ours


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=DEFAULT_DATA, help="folder that holds boards/")
    folder = parser.parse_args(arguments).data / "boards"
    cameras = {name: sorted(folder.glob(f"{name}*.jpg")) for name in ("left", "right")}
    if not any(cameras.values()):
        print(f"Skipped: expected photographs left*.jpg and right*.jpg in {folder}, found none. Give --data FOLDER.")
        return
    for name, files in cameras.items():
        if files:
            calibrate(name, files)


if __name__ == "__main__":
    main()
