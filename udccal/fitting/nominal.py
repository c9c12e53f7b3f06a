"""The term geometry as the rig was built to have it: where every fit of rays starts."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from udccal.models.geometry import Geometry
from udccal.rig import RigDescription


def nominal_geometry(rig: RigDescription) -> Geometry:
    """Distortion-free geometry of a rig description: focal length of the lens, centred, at its nominal mounting."""
    camera, mounting = rig.camera, rig.mounting
    # R_panel_camera = Ry(yaw) Rx(-tilt) Rz(roll), as in ``models.geometry.mounting_rotation``.
    angles_deg = [mounting.yaw_deg.value, -mounting.tilt_deg.value, mounting.roll_deg.value]
    pitch_mm = rig.panel.pitch_mm.value
    return Geometry(
        focal=np.array([rig.focal_px, rig.focal_px]),
        centre=np.array([(camera.columns - 1) / 2, (camera.rows - 1) / 2]),
        distortion=np.zeros(5),
        rotation=np.asarray(Rotation.from_euler("YXZ", angles_deg, degrees=True).as_rotvec(), dtype=np.float64),
        pupil=np.array(
            [
                mounting.panel_x_px.value * pitch_mm,
                mounting.panel_y_px.value * pitch_mm,
                -mounting.standoff_mm.value,
            ]
        ),
    )
