"""The term geometry as the rig was built to have it: where every fit of rays starts."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from udccal.models.geometry import Geometry
from udccal.mounting import nominal_pupil_mm, nominal_rotation
from udccal.rig import RigDescription


def nominal_geometry(rig: RigDescription) -> Geometry:
    """Distortion-free geometry of a rig description: focal length of the lens, centred, at its nominal mounting."""
    camera = rig.camera
    return Geometry(
        focal=np.array([rig.focal_px, rig.focal_px]),
        centre=np.array([(camera.columns - 1) / 2, (camera.rows - 1) / 2]),
        distortion=np.zeros(5),
        rotation=np.asarray(Rotation.from_matrix(nominal_rotation(rig)).as_rotvec(), dtype=np.float64),
        pupil=nominal_pupil_mm(rig),
    )
