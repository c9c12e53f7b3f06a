"""Calibrate a lens from corners as arrays, made here with 0.1 px of noise, and compute the sigma of where a ray lands.

python examples/array_calibration.py
"""

from __future__ import annotations

import cv2
import numpy as np

import udccal
from udccal.fitting.geometry.fit import projection_sigma_px

SIZE, DISTORTION, NOISE_PX = (1280, 960), np.array([-0.12, 0.08, 0.0, 0.0, 0.0]), 0.1
MATRIX = np.array([[1100.0, 0.0, 652.0], [0.0, 1100.0, 470.0], [0.0, 0.0, 1.0]])


def main() -> None:
    """Draw 12 views of a board (9 x 6, 30 mm apart), fit them, and print the lens and the sigma of three rays."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(9), np.arange(6))
    board, views = 30.0 * np.stack([x.ravel() - 4.0, y.ravel() - 2.5, np.zeros(x.size)], axis=1), []
    for _ in range(12):
        lean, place = rng.uniform(-0.5, 0.5, 3), rng.uniform([-130, -90, 400], [130, 90, 700])
        seen = cv2.projectPoints(board, lean, place, MATRIX, DISTORTION)[0].reshape(-1, 2)
        seen += NOISE_PX * rng.standard_normal(seen.shape)
        # A corner that is not seen is NaN.
        views.append(np.where(((seen >= 0) & (seen < SIZE)).all(axis=1)[:, None], seen, np.nan))
    found = udccal.fit_geometry([board] * len(views), views, SIZE)
    order = next(c.name for c in found.candidates if c.chosen)
    print(f"{found.status.name}: rms {found.diagnostics[0].value:.3f} px, distortion: {order}")
    for one in found.estimates[:4]:
        print(f"  {one.name} {one.value:9.2f} ± {one.sigma:.2f} {one.unit}")
    sigma = projection_sigma_px(found, np.array([[640.0, 480.0], [100.0, 80.0], [1200.0, 900.0]]))
    print("  rays: sigma " + ", ".join(f"{np.linalg.norm(one):.3f}" for one in sigma) + " px")


if __name__ == "__main__":
    main()
