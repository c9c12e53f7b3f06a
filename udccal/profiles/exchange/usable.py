"""Whether an imported lens can be used: every pixel has one ray, and every ray goes through the panel to its front.

Other programs' files may hold numbers that are in range each and make no camera together, as in another order.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from udccal.errors import ProfileError
from udccal.models.geometry import Geometry, distort, rotation_matrix, stretch, unproject
from udccal.numerics import in_float64
from udccal.rig import RigDescription

# Beyond it no lens is a pinhole with a distortion.
_WIDEST_DEG = 80.0
# Lenses that udccal can undo are off by hundredths at most; where rounds do not converge, by many pixels.
_MOST_OFF_PX = 1.0
_POINTS = 33


@in_float64
def check_usable(geometry: Geometry, posed: bool, rig: RigDescription, source: str) -> None:
    """Refuse a lens or a pose with which nothing could be restored.

    Args:
        geometry: as imported; its numbers are in range.
        posed: whether the pose is the file's own, and not the rig description's.
        rig: gives the size of the picture.
        source: where the lens comes from, for the message.

    Raises:
        ProfileError: which names the entry of the file.
    """
    across, down = np.linspace(0, rig.camera.columns - 1, _POINTS), np.linspace(0, rig.camera.rows - 1, _POINTS)
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    _check_width(geometry, pixels, source)
    ideal = np.asarray(unproject(geometry, pixels))
    _check_distortion(geometry, pixels, ideal, source)
    if posed and not geometry.pupil_mm[2] < 0:
        raise ProfileError(
            f"Expected the third number of 'pupil_mm' in {source} below 0, since the camera is behind the panel, found "
            f"{geometry.pupil_mm[2]:g}. Correct the file; docs/conventions.md has the panel's frame."
        )
    rays = np.column_stack([ideal, np.ones(len(ideal))])
    if np.any(rays @ np.asarray(rotation_matrix(geometry.rotation_rad))[2] <= 0):
        entry, also = ("R_panel_camera", "") if posed else ("camera_matrix", ", and the tilt in the rig's description")
        raise ProfileError(
            f"Expected '{entry}' in {source} with which every pixel looks to the front of the panel, found pixels that "
            f"look back. Correct the file{also}; docs/conventions.md has the frames."
        )


def _check_width(geometry: Geometry, pixels: Float[np.ndarray, "n 2"], source: str) -> None:
    slopes = (pixels - np.asarray(geometry.principal_point_px)) / np.asarray(geometry.focal_px)
    widest_deg = float(np.degrees(np.arctan(np.linalg.norm(slopes, axis=-1).max())))
    if widest_deg > _WIDEST_DEG:
        raise ProfileError(
            f"Expected 'camera_matrix' (mrcal: 'intrinsics') in {source} with all pixels within {_WIDEST_DEG:g} "
            f"degrees of the lens's axis, found one at {widest_deg:.1f}. Correct focal length and principal point."
        )


def _check_distortion(
    geometry: Geometry, pixels: Float[np.ndarray, "n 2"], ideal: Float[np.ndarray, "n 2"], source: str
) -> None:
    """Refuse a distortion that udccal cannot undo, or that folds the picture."""
    again = distort(geometry, ideal) * jnp.asarray(geometry.focal_px) + jnp.asarray(geometry.principal_point_px)
    off = np.abs(np.asarray(again) - pixels)
    if not (np.all(off <= _MOST_OFF_PX) and np.all(np.asarray(stretch(geometry, ideal)) > 0)):
        found = ", ".join(f"{value:g}" for value in np.asarray(geometry.distortion))
        raise ProfileError(
            f"Expected 'distortion_coefficients' (mrcal: 'intrinsics') in {source} that can be undone in the whole "
            f"picture, found {found}. Check their order, k1, k2, p1, p2, k3, or calibrate with boards in the corners."
        )
