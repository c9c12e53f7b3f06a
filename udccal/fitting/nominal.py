"""Terms with the values of the rig's description: fits start from them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.mounting import nominal_pupil_mm, nominal_rotation
from udccal.rig import RigDescription


def nominal_geometry(rig: RigDescription) -> Geometry:
    """Return the geometry that a rig's description gives: no distortion, centred, at the nominal mounting.

    Args:
        rig: gives the focal length in px, the sensor's size, and the mounting (angles in degrees, lengths in mm).
    """
    camera = rig.camera
    return Geometry(
        focal_px=np.array([rig.focal_px, rig.focal_px]),
        principal_point_px=np.array([(camera.columns - 1) / 2, (camera.rows - 1) / 2]),
        distortion=np.zeros(5),
        rotation_rad=np.asarray(Rotation.from_matrix(nominal_rotation(rig)).as_rotvec(), dtype=np.float64),
        pupil_mm=nominal_pupil_mm(rig),
    )


def nominal_backscatter(
    geometry: Geometry, rig: RigDescription, mask: Float[np.ndarray, "3 a b"], step: int, window: int
) -> Backscatter:
    """Return a backscatter term with the rig's nominal dimensions; the fit starts from it.

    Args:
        geometry: gives the rays of the sensor's pixels.
        rig: gives the panel, the mounting, the pupil (all in mm) and the sensor.
        mask: rate of white on the grid of bins in e-/s, by camera colour.
        step: spacing of that grid in sensor px.
        window: number of panel pixels across the window that holds the footprints (odd).
    """
    panel = rig.panel
    return Backscatter(
        geometry=geometry,
        mask=mask,
        mix=np.eye(3),
        gamma=np.float64(panel.gamma.value),
        pitch_mm=np.float64(panel.pitch_mm.value),
        pupil_diameter_mm=np.float64(rig.pupil_diameter_mm),
        standoff_mm=np.float64(rig.mounting.standoff_mm.value),
        emitters_px=np.zeros((3, 2)),
        softness_px=np.float64(0.15),
        reflection=np.float64(0.5),
        reflection_mm=np.float64(2 * panel.glass_thickness_mm / panel.glass_index),
        columns=rig.camera.columns,
        rows=rig.camera.rows,
        cfa=rig.camera.cfa,
        step=step,
        window=window,
    )
