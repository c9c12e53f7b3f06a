"""The estimates that a profile holds, with one covariance over all terms.

The covariances within terms are those that the profile keeps; those between terms are computed (``shared.py``). The
wire's rotation counts from the geometry's; the whole rotation takes its place.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from udccal.comparison.comparable import check_finite
from udccal.comparison.estimates import ANGLES, ORDER, Estimates, Name, within_half_turn
from udccal.comparison.shared import Measured, with_shared
from udccal.errors import ProfileError
from udccal.fitting.wire.parameters import SHAPE_NAMES
from udccal.mounting import angles_deg
from udccal.result import FitResult

_ROTATION, _TURN_STEP_DEG = SHAPE_NAMES[:3], 1e-3
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
    if {("wire", name) for name in _ROTATION} <= set(names):
        found = _with_whole_rotation(found, profile)
    return with_shared(found, profile)


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
    """The angles of the wire's whole rotation from camera to panel in place of its rotation from the geometry's."""
    at = [found.names.index(("wire", name)) for name in _ROTATION]
    values, change, names, units = found.values.copy(), np.eye(len(found.names)), list(found.names), list(found.units)
    turn, steps = values[at], _TURN_STEP_DEG * np.eye(3)
    with np.errstate(all="ignore"):
        values[at] = _whole_deg(profile, turn)
        apart = [within_half_turn(_whole_deg(profile, turn + e) - _whole_deg(profile, turn - e)) for e in steps]
        change[np.ix_(at, at)] = np.transpose(apart) / (2 * _TURN_STEP_DEG)
        cov = change @ found.cov @ change.T
    check_finite(values, cov)
    for i, name in zip(at, ANGLES, strict=True):
        names[i], units[i] = ("wire", name), "deg"
    return Estimates(tuple(names), tuple(units), values, cov)


def _whole_deg(profile: Measured, turn_deg: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """(tilt, roll, yaw) of the geometry's rotation followed by ``turn_deg``, a rotation vector."""
    base = Rotation.from_rotvec(np.asarray(profile.wire.term.geometry.rotation_rad, dtype=np.float64))
    return angles_deg((Rotation.from_rotvec(turn_deg, degrees=True) * base).as_rotvec())
