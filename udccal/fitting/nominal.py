"""The term geometry as the rig was built to have it: where every fit of rays starts."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from udccal.models.geometry import Geometry, mounting_rotation
from udccal.numerics import in_float64
from udccal.rig import RigDescription


def rotation_vector(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """Rotation vector in rad of a rotation matrix."""
    return np.asarray(Rotation.from_matrix(matrix).as_rotvec(), dtype=np.float64)


@in_float64
def nominal_geometry(rig: RigDescription) -> Geometry:
    """Distortion-free geometry of a rig description: focal length of the lens, centred, at its nominal mounting."""
    camera, mounting = rig.camera, rig.mounting
    tilt, roll, yaw = (
        np.float64(np.deg2rad(angle.value)) for angle in (mounting.tilt_deg, mounting.roll_deg, mounting.yaw_deg)
    )
    pitch_mm = rig.panel.pitch_mm.value
    return Geometry(
        focal=np.array([rig.focal_px, rig.focal_px]),
        centre=np.array([(camera.columns - 1) / 2, (camera.rows - 1) / 2]),
        distortion=np.zeros(5),
        rotation=rotation_vector(np.asarray(mounting_rotation(tilt, roll, yaw), dtype=np.float64)),
        pupil=np.array(
            [
                mounting.panel_x_px.value * pitch_mm,
                mounting.panel_y_px.value * pitch_mm,
                -mounting.standoff_mm.value,
            ]
        ),
    )
