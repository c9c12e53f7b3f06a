"""Nominal position and rotation of the camera behind the panel, from a rig's description."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from udccal.rig import RigDescription


def nominal_rotation(rig: RigDescription) -> Float[np.ndarray, "3 3"]:
    """Return the nominal R_panel_camera of ``rig``: Ry(yaw) Rx(-tilt) Rz(roll), see docs/conventions.md."""
    mounting = rig.mounting
    angles_deg = [mounting.yaw_deg.value, -mounting.tilt_deg.value, mounting.roll_deg.value]
    return np.asarray(Rotation.from_euler("YXZ", angles_deg, degrees=True).as_matrix(), dtype=np.float64)


def nominal_pupil_mm(rig: RigDescription) -> Float[np.ndarray, "3"]:
    """Return the nominal (x, y, z) of the entrance pupil of ``rig`` in panel coordinates, in mm."""
    mounting, pitch = rig.mounting, rig.panel.pitch_mm.value
    return np.array([mounting.panel_x_px.value * pitch, mounting.panel_y_px.value * pitch, -mounting.standoff_mm.value])
