"""Covariance between terms: errors of one that a fit of another carries on.

    wire         Its fit held the lens; the lens's errors are carried to the wire's pose.
    backscatter  Its fit held lens and rotation of the geometry; their errors are carried to stand-off and place.

The psf's are left out. An error of the lens is one of 1e-5 of its pitch, which is known to some 1e-3. The wire's
openings, depth and footprint are the means of its priors, but those are so wide that an error of the wire of one sigma
moves them by less than a hundredth of theirs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from udccal.calibration import Calibration
from udccal.comparison.comparable import check_finite
from udccal.comparison.estimates import ANGLES, Estimates, Name
from udccal.comparison.grid import sensor_grid
from udccal.fitting.geometry.bundle import INTRINSIC_NAMES, LENS
from udccal.fitting.geometry.fit import term_at
from udccal.fitting.wire.parameters import SHAPE_NAMES
from udccal.models.geometry import Geometry, unproject
from udccal.mounting import angles_deg
from udccal.numerics import in_float64
from udccal.profiles.profile import Profile
from udccal.rig import RigDescription

Measured = Profile | Calibration
# Steps of numerical derivatives: focal length and principal point (px), distortion, angles (deg).
STEPS = np.array([1e-2] * 4 + [1e-5] * 5 + [1e-3] * 3)
_HELD: tuple[Name, ...] = tuple(("geometry", name) for name in INTRINSIC_NAMES + ANGLES)
_POSE: tuple[Name, ...] = tuple(("wire", name) for name in ANGLES + SHAPE_NAMES[3:6])
_PLACE: tuple[Name, ...] = tuple(("backscatter", name) for name in ("standoff_mm", "offset_x_px", "offset_y_px"))


def with_shared(found: Estimates, profile: Measured) -> Estimates:
    """Return the estimates with what terms share in their covariance.

    Args:
        found: the estimates, with the covariance of each term; the wire's angles are those of its whole rotation.
        profile: their terms.

    Raises:
        ProfileError: when numbers are too large to compare.
    """
    names, change, pitch_mm = set(found.names), np.eye(len(found.names)), profile.rig.panel.pitch_mm.value
    with np.errstate(all="ignore"):
        if {*_HELD[:LENS], *_POSE} <= names:
            of = profile.wire.term.geometry
            pose = found.values[_at(found, _POSE)]
            change[np.ix_(_at(found, _POSE), _at(found, _HELD[:LENS]))] = _made_up(profile.rig, of, pose, 6)
        if {*_HELD, *_PLACE} <= names:
            of = profile.backscatter.term.geometry
            turn_deg = angles_deg(np.asarray(of.rotation_rad, dtype=np.float64))
            pose = np.concatenate([turn_deg, found.values[_at(found, _PLACE)] / [pitch_mm, -1, -1]])
            by_held = np.diag([pitch_mm, -1, -1]) @ _made_up(profile.rig, of, pose, 3)
            change[np.ix_(_at(found, _PLACE), _at(found, _HELD))] = by_held
        cov = change @ found.cov @ change.T
    check_finite(cov)
    return replace(found, cov=cov)


def _at(found: Estimates, names: Sequence[Name]) -> list[int]:
    """Where the estimates of these names are."""
    return [found.names.index(name) for name in names]


@in_float64
def _made_up(
    rig: RigDescription, held: Geometry, pose: Float[np.ndarray, "6"], own: int
) -> Float[np.ndarray, "own others"]:
    """Derivatives of the last ``own`` parts of a pose by the lens and by the other parts, which a fit held.

    A fit knows at which place of the panel each pixel looks. Where what it held is off, its own parts make up for this
    as far as they can: by least squares over the sensor, columns and rows alike.

    Args:
        rig: has the size of the sensor.
        held: gives the lens.
        pose: tilt, roll, yaw (degrees); stand-off and place (x, y) of the pupil in pitches.
        own: how many of these the fit found.
    """
    pixels, ideal = sensor_grid(rig), jax.jit(unproject)
    x = np.concatenate([held.focal_px, held.principal_point_px, held.distortion, pose])

    def places(x: Float[np.ndarray, "15"]) -> Float[np.ndarray, " places"]:
        term = term_at(x[:12], np.zeros(3))
        rays = np.column_stack([np.asarray(ideal(term, pixels)), np.ones(len(pixels))])
        rays = Rotation.from_rotvec(np.asarray(term.rotation_rad)).apply(rays)
        return (x[13:] + x[12] * rays[:, :2] / rays[:, 2:]).ravel()

    steps = np.diag(np.concatenate([STEPS, [1e-3] * 3]))
    by = np.array([(places(x + e) - places(x - e)) / (2 * e.max()) for e in steps])
    check_finite(by)
    return -np.linalg.lstsq(by[-own:].T, by[:-own].T, rcond=None)[0]
