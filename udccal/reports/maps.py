"""Arrays of the fitted terms that a report shows, at the same places as those of a simulated truth."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import gaussian_filter

from udccal.calibration import Calibration
from udccal.kernels import kernel_size, kernels_at
from udccal.models.backscatter import backscatter_rate
from udccal.models.geometry import Geometry, panel_points_mm
from udccal.numerics import in_float64
from udccal.rig import RigDescription

# Width of the smoothing that estimates the shading, as a fraction of the picture's height.
_SHADING = 0.06
_PLACES = ((0.5, 0.5), (0.17, 0.21), (0.81, 0.33), (0.37, 0.86))


@dataclass(frozen=True)
class TermMaps:
    """The terms as maps on the sensor.

    ``kernels`` are of point sources centred on ``positions_px``, which lie between those that a procedure captures.
    ``backscatter`` is a mosaic in e-/s for ``picture`` shown on the panel, before the wire; ``seen_px`` is the part of
    the panel that the sensor looks through (left, top, right, bottom).
    """

    wire: Float[np.ndarray, "rows columns"]
    positions_px: Float[np.ndarray, "places 2"]
    kernels: Float[np.ndarray, "places 3 ky kx"]
    picture: UInt8[np.ndarray, "panel_rows panel_columns 3"]
    seen_px: tuple[int, int, int, int]
    backscatter: Float[np.ndarray, "rows columns"]


def ripple(wire: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """Divide a wire map by its smooth shading, which is far larger than the ripple."""
    return wire / gaussian_filter(wire, _SHADING * wire.shape[0], mode="nearest") - 1.0


def report_positions(rig: RigDescription) -> Float[np.ndarray, "places 2"]:
    """Return the whole-pixel places (x, y) at which the report shows the blur."""
    return np.floor(np.array(_PLACES) * [rig.camera.columns - 1, rig.camera.rows - 1])


@in_float64
def fitted_maps(calibration: Calibration, picture: UInt8[np.ndarray, "panel_rows panel_columns 3"]) -> TermMaps:
    """Return the maps of the fitted terms."""
    rig = calibration.rig
    positions = report_positions(rig)
    return TermMaps(
        wire=calibration.foundation.wire_map,
        positions_px=positions,
        kernels=kernels_at(calibration.psf.term, positions, *kernel_size(rig)),
        picture=picture,
        seen_px=_seen_px(calibration.geometry.term, rig),
        backscatter=np.asarray(backscatter_rate(calibration.backscatter.term, picture)),
    )


_panel_points_mm = jax.jit(panel_points_mm)


def _seen_px(geometry: Geometry, rig: RigDescription) -> tuple[int, int, int, int]:
    """Return the panel pixels that rays through the sensor's edge cross, widened by the pupil."""
    x, y = rig.camera.columns - 1.0, rig.camera.rows - 1.0
    corners = np.array([[0, 0], [x / 2, 0], [x, 0], [x, y / 2], [x, y], [x / 2, y], [0, y], [0, y / 2]])
    points = np.asarray(_panel_points_mm(geometry, corners)) / rig.panel.pitch_mm.value
    reach = rig.pupil_diameter_mm / rig.panel.pitch_mm.value
    low = np.clip(np.floor(points.min(axis=0) - reach), 0, [rig.panel.columns - 2, rig.panel.rows - 2])
    high = np.clip(np.ceil(points.max(axis=0) + reach), low + 1, [rig.panel.columns - 1, rig.panel.rows - 1])
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])
