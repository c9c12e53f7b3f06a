"""The estimates that a profile holds, with one covariance over all terms.

The covariances are those that the profile keeps, one per term. Two things are computed from the terms. The wire's
rotation counts from the geometry's; the whole rotation takes its place. And the wire was fitted with the lens held, so
that the lens's covariance is carried to the wire's pose.
"""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from udccal.calibration import Calibration
from udccal.comparison.comparable import check_finite
from udccal.comparison.estimates import ANGLES, ORDER, Estimates, Name, within_half_turn
from udccal.comparison.grid import sensor_grid
from udccal.errors import ProfileError
from udccal.fitting.geometry.bundle import INTRINSIC_NAMES, LENS
from udccal.fitting.geometry.fit import angles_deg, term_at
from udccal.fitting.wire.parameters import SHAPE_NAMES
from udccal.models.geometry import unproject
from udccal.numerics import in_float64
from udccal.profiles.profile import Profile
from udccal.result import FitResult

Measured = Profile | Calibration
# Steps of numerical derivatives: focal length and principal point (px), distortion, angles (deg).
STEPS = np.array([1e-2] * 4 + [1e-5] * 5 + [1e-3] * 3)
# Rotation, stand-off and offset, and the steps of their derivatives.
_POSE, _POSE_STEP = SHAPE_NAMES[:6], 1e-3
# What rounding adds to the correlations of a covariance.
_ROUNDING = 1e-6


def held_estimates(profile: Measured) -> Estimates:
    """Return the estimates of all terms that are in a covariance, without elements of the terms' arrays.

    Which elements a fit has, its data decide; they are compared by what they do to the maps.

    Raises:
        ProfileError: when a covariance cannot be one.
    """
    results = [profile.result(term) for term in ORDER]
    covs = [_checked(result) for result in results]
    every = [(term, one) for term, r, cov in zip(ORDER, results, covs, strict=True) for one in r.estimates[: len(cov)]]
    own = np.array([i for i, (_, one) in enumerate(every) if "." not in one.name], dtype=np.int64)
    kept = [every[i] for i in own]
    names: tuple[Name, ...] = tuple((term, one.name) for term, one in kept)
    values = np.array([one.value for _, one in kept], dtype=np.float64)
    found = Estimates(names, tuple(one.unit for _, one in kept), values, block_diag(*covs)[np.ix_(own, own)])
    return _with_whole_rotation(found, profile) if {("wire", name) for name in _POSE} <= set(names) else found


def _checked(result: FitResult) -> Float[np.ndarray, "n n"]:
    """The covariance of a fit; refuse what is none."""
    cov = np.asarray(result.cov, dtype=np.float64)
    unit = np.sqrt(np.where(np.diag(cov) > 0, np.diag(cov), 1.0))
    with np.errstate(all="ignore"):
        scaled = cov / np.outer(unit, unit)
    whole = len(cov) <= len(result.estimates) and bool(np.isfinite(scaled).all())
    whole = whole and float(np.abs(scaled - scaled.T).max(initial=0.0)) <= _ROUNDING
    if not whole or float(np.linalg.eigvalsh(scaled).min(initial=0.0)) < -_ROUNDING * max(len(cov), 1):
        raise ProfileError(
            f"Expected a covariance of the {result.name} estimates, symmetric and without negative variances, found "
            f"another matrix of shape {cov.shape} for {len(result.estimates)} estimates. Restore the profile from a "
            "copy."
        )
    return (cov + cov.T) / 2


def _with_whole_rotation(found: Estimates, profile: Measured) -> Estimates:
    """The angles of the wire's whole rotation from camera to panel, and the lens's share of the pose's covariance."""
    at = np.array([found.names.index(("wire", name)) for name in _POSE])
    values, change = found.values.copy(), np.eye(len(found.names))
    turn, steps = values[at[:3]], _POSE_STEP * np.eye(3)
    lens = [i for i, (term, name) in enumerate(found.names) if term == "geometry" and name in INTRINSIC_NAMES]
    if len(lens) == LENS:
        change[np.ix_(at, np.array(lens))] = _by_lens(profile)
    with np.errstate(all="ignore"):
        values[at[:3]] = _whole_deg(profile, turn)
        apart = [within_half_turn(_whole_deg(profile, turn + e) - _whole_deg(profile, turn - e)) for e in steps]
        slopes = np.array(apart) / (2 * _POSE_STEP)
        change[np.ix_(at[:3], at[:3])] = np.transpose(slopes)
        cov = change @ found.cov @ change.T
    check_finite(values, cov)
    names, units = list(found.names), list(found.units)
    for i, name in zip(at, ANGLES, strict=False):
        names[i], units[i] = ("wire", name), "deg"
    return Estimates(tuple(names), tuple(units), values, cov)


def _whole_deg(profile: Measured, turn_deg: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """(tilt, roll, yaw) of the geometry's rotation followed by ``turn_deg``, a rotation vector."""
    base = Rotation.from_rotvec(np.asarray(profile.wire.term.geometry.rotation_rad, dtype=np.float64))
    return angles_deg((Rotation.from_rotvec(turn_deg, degrees=True) * base).as_rotvec())


@in_float64
def _by_lens(profile: Measured) -> Float[np.ndarray, "6 9"]:
    """Derivatives of the wire's pose by the lens that its fit held.

    A flat shows the phase of rows and columns at every pixel. Where the lens is off, the pose makes up for it as far as
    it can: by least squares over the sensor, rows and columns alike.
    """
    wire, pixels, ideal = profile.wire.term, sensor_grid(profile.rig), jax.jit(unproject)
    of = wire.geometry
    lens = np.concatenate([of.focal_px, of.principal_point_px, of.distortion])
    turn = _whole_deg(profile, np.rad2deg(np.asarray(wire.rotation_rad)))
    pose = np.concatenate([turn, [float(wire.standoff_per_pitch)], wire.offset_periods])

    def phases(lens: Float[np.ndarray, "9"], pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, " phases"]:
        term = term_at(np.concatenate([lens, pose[:3]]), np.zeros(3))
        rays = np.column_stack([np.asarray(ideal(term, pixels)), np.ones(len(pixels))])
        rays = Rotation.from_rotvec(np.asarray(term.rotation_rad)).apply(rays)
        return (pose[4:] + pose[3] * rays[:, :2] / rays[:, 2:]).ravel()

    with np.errstate(all="ignore"):
        by_lens = [(phases(lens + e, pose) - phases(lens - e, pose)) / e.max() for e in np.diag(STEPS[:LENS])]
        by_pose = [(phases(lens, pose + e) - phases(lens, pose - e)) / _POSE_STEP for e in _POSE_STEP * np.eye(6)]
    check_finite(np.array(by_lens), np.array(by_pose))
    return -np.linalg.lstsq(np.transpose(by_pose), np.transpose(by_lens), rcond=None)[0]
