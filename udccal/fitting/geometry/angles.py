"""How the camera is mounted, from the pose of boards that stand parallel to the panel: their axes are the panel's."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from udccal.fitting.geometry.calibrated_views import CalibratedViews
from udccal.models.arrays import Arrayish
from udccal.models.geometry import rotation_matrix
from udccal.numerics import in_float64

ANGLE_NAMES = ("tilt_deg", "roll_deg", "yaw_deg")


def panel_rotation(bundle: CalibratedViews, parallel: list[int]) -> Float[np.ndarray, "3"]:
    """Rotation vector of ``R_panel_camera``; several parallel views count as their mean."""
    mean = Rotation.from_rotvec(-bundle.poses[parallel, :3]).mean()
    return np.asarray(mean.as_rotvec(), dtype=np.float64)


def _angles_deg(rotation: Float[Arrayish, "3"]) -> Float[Array, "3"]:
    """(tilt, roll, yaw) of R_panel_camera = Ry(yaw) Rx(-tilt) Rz(roll)."""
    r = rotation_matrix(rotation)
    tilt, roll, yaw = jnp.arcsin(r[1, 2]), jnp.arctan2(r[1, 0], r[1, 1]), jnp.arctan2(r[0, 2], r[2, 2])
    return jnp.rad2deg(jnp.stack([tilt, roll, yaw]))


_angles, _angle_slopes = jax.jit(_angles_deg), jax.jit(jax.jacfwd(_angles_deg))


@in_float64
def with_angles(
    bundle: CalibratedViews, parallel: list[int], rotation: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "12"], Float[np.ndarray, "12 12"]]:
    """Values and covariance of intrinsics and angles."""
    slope = np.asarray(_angle_slopes(rotation))
    picks = np.zeros((12, len(bundle.cov)))
    picks[:9, :9] = np.eye(9)
    for view in parallel:
        picks[9:, 9 + 6 * view : 12 + 6 * view] = -slope / len(parallel)
    values = np.concatenate([bundle.intrinsics, np.asarray(_angles(rotation), dtype=np.float64)])
    return values, picks @ bundle.cov @ picks.T
