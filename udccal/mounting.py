"""Position and rotation of the camera behind the panel: nominal ones from a rig's description, rotations by angles."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from udccal.rig import RigDescription


def nominal_rotation(rig: RigDescription) -> Float[np.ndarray, "3 3"]:
    """Return the nominal R_panel_camera of ``rig``."""
    mounting = rig.mounting
    turn_deg = np.array([mounting.tilt_deg.value, mounting.roll_deg.value, mounting.yaw_deg.value])
    return np.asarray(_rotation(turn_deg).as_matrix(), dtype=np.float64)


def nominal_pupil_mm(rig: RigDescription) -> Float[np.ndarray, "3"]:
    """Return the nominal (x, y, z) of the entrance pupil of ``rig`` in panel coordinates, in mm."""
    mounting, pitch = rig.mounting, rig.panel.pitch_mm.value
    return np.array([mounting.panel_x_px.value * pitch, mounting.panel_y_px.value * pitch, -mounting.standoff_mm.value])


def turned_by(turn_deg: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Return the rotation vector of R_panel_camera = Ry(yaw) Rx(-tilt) Rz(roll), see docs/conventions.md.

    Args:
        turn_deg: tilt, roll and yaw.
    """
    return np.asarray(_rotation(turn_deg).as_rotvec())


def _rotation(turn_deg: Float[np.ndarray, "3"]) -> Rotation:
    tilt, roll, yaw = turn_deg
    return Rotation.from_euler("YXZ", [yaw, -tilt, roll], degrees=True)


def angles_deg(rotation: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Return (tilt, roll, yaw) of the rotation vector of R_panel_camera."""
    yaw, tilt, roll = Rotation.from_rotvec(rotation).as_euler("YXZ", degrees=True)
    return np.array([-tilt, roll, yaw])
