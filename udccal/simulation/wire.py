"""The wire: an even field seen through the panel's out-of-focus rows and columns and the lens's own shading.

The true map is the open area of the pupil's footprint on the panel at each pixel, times the lens's relative
illumination. The area follows from the shapes; no sinusoid is assumed.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.simulation.footprint import open_fraction
from udccal.simulation.truth import RigTruth, pixels_to_directions

_ROWS_AT_ONCE = 16


def relative_illumination(truth: RigTruth, directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Return the lens shading along ``directions`` (panel coordinates), 1 on the axis.

    It is the cos^4 law of the field angle times a mild polynomial for vignetting by the lens barrel.
    """
    camera = truth.description.camera
    corner = np.hypot(camera.columns / truth.optics.fx_px, camera.rows / truth.optics.fy_px) / 2
    square, fourth = np.random.default_rng([truth.seed, 0x71C7]).uniform([0.03, 0.01], [0.06, 0.03])
    cosine = directions @ truth.optics.R_panel_camera[:, 2]
    field2 = (1 / cosine**2 - 1) / corner**2
    return cosine**4 * (1 - square * field2 - fourth * field2**2)


def wire_map(truth: RigTruth) -> Float[np.ndarray, "rows columns"]:
    """Return the relative sensitivity of every pixel to an even field, with mean 1 over the sensor."""
    camera = truth.description.camera
    wire = np.empty((camera.rows, camera.columns))
    x = np.arange(camera.columns, dtype=float)
    for top in range(0, camera.rows, _ROWS_AT_ONCE):
        y = np.arange(top, min(top + _ROWS_AT_ONCE, camera.rows), dtype=float)
        pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        directions = pixels_to_directions(truth.optics, pixels)
        strip = open_fraction(truth, directions) * relative_illumination(truth, directions)
        wire[top : top + len(y)] = strip.reshape(len(y), -1)
    return wire / wire.mean()
