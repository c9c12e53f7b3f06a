"""Calibrate a lens from arrays of points, and compute the sigma of where a ray lands.

    python examples/array_calibration.py

The corners are made here, with known truth and 0.1 px of noise; replace them by your own detector's.
"""

from __future__ import annotations

import cv2
import numpy as np

from udccal.fitting.geometry.calibrated import Gauge
from udccal.fitting.geometry.fit import fit_geometry

SIZE = (1280, 960)
MATRIX = np.array([[1100.0, 0.0, 652.0], [0.0, 1100.0, 470.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.12, 0.08, 0.0, 0.0, 0.0])
NOISE_PX = 0.1


def views(count: int, rng: np.random.Generator) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return corners of a board (9 x 6, 30 mm apart) in front of the camera; NaN for corners outside the picture."""
    x, y = np.meshgrid(np.arange(9), np.arange(6))
    board = 30.0 * np.stack([x.ravel() - 4.0, y.ravel() - 2.5, np.zeros(x.size)], axis=1)
    pictures = []
    for _ in range(count):
        lean, place = rng.uniform(-0.5, 0.5, 3), rng.uniform([-130, -90, 400], [130, 90, 700])
        seen = cv2.projectPoints(board, lean, place, MATRIX, DISTORTION)[0].reshape(-1, 2)
        seen += NOISE_PX * rng.standard_normal(seen.shape)
        inside = ((seen >= 0) & (seen < np.array(SIZE))).all(axis=1)
        pictures.append(np.where(inside[:, None], seen, np.nan))
    return [board] * count, pictures


def main() -> None:
    """Fit, and print the lens, the fit's residual and the sigma of three rays."""
    board, pictures = views(12, np.random.default_rng(0))
    found = fit_geometry(board, pictures, SIZE)
    sigma = np.sqrt(np.diag(found.cov))
    order = next(c.name for c in found.candidates if c.chosen)
    print(f"{found.status.name}: rms {found.rms_px:.3f} px, distortion: {order}")
    for name, value, one in zip(("fx", "fy", "cx", "cy"), found.intrinsics.vector, sigma, strict=False):
        print(f"  {name} {value:9.2f} ± {one:.2f} px")
    pixels = np.array([[640.0, 480.0], [100.0, 80.0], [1200.0, 900.0]])
    for gauge in (Gauge.BOARDS, Gauge.ALIGNED):
        covariance = found.projection_covariance(pixels, gauge)
        each = ", ".join(f"{np.sqrt(np.trace(one)):.3f}" for one in covariance)
        print(f"  a ray fixed to {gauge.value}: sigma {each} px")


if __name__ == "__main__":
    main()
