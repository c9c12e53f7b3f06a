"""Fast computation of the rays of grids of sensor positions: exact at knots, a cubic spline between them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_interp_spline

from udccal.simulation.truth import RigTruth, pixels_to_directions

# Directions vary so smoothly over the sensor that the spline is within 1e-6 px of the exact inversion.
_KNOT_STEP_PX = 16.0


def slope_grid(
    truth: RigTruth, x_px: Float[np.ndarray, "columns"], y_px: Float[np.ndarray, "rows"]
) -> Float[np.ndarray, "rows columns 2"]:
    """Return slopes (s_x / s_z, s_y / s_z) in panel coordinates of rays at sensor positions (x, y), both increasing."""
    knots_x, knots_y = (np.linspace(v[0], v[-1], max(5, int((v[-1] - v[0]) / _KNOT_STEP_PX) + 2)) for v in (x_px, y_px))
    directions = pixels_to_directions(truth.optics, np.stack(np.meshgrid(knots_x, knots_y), axis=-1))
    slopes = directions[..., :2] / directions[..., 2:]
    basis_x, basis_y = spline_basis(knots_x, x_px), spline_basis(knots_y, y_px)
    return np.stack([basis_y @ slopes[..., i] @ basis_x.T for i in range(2)], axis=-1)


def spline_basis(nodes: Float[np.ndarray, "nodes"], positions: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n nodes"]:
    """Return the matrix from values at ``nodes`` to a cubic spline's at ``positions``, constant outside the nodes."""
    if nodes.size == 1:
        return np.ones((positions.size, 1))
    cardinal = make_interp_spline(nodes, np.eye(nodes.size), k=min(3, nodes.size - 1))
    return cardinal(np.clip(positions, nodes[0], nodes[-1]))


def cosine_grid(
    truth: RigTruth, x_px: Float[np.ndarray, "columns"], y_px: Float[np.ndarray, "rows"]
) -> Float[np.ndarray, "rows columns 2"]:
    """Return direction cosines (s_x, s_y) of the rays of ``slope_grid``."""
    slopes = slope_grid(truth, x_px, y_px)
    return slopes / np.sqrt(1.0 + (slopes**2).sum(axis=-1, keepdims=True))
