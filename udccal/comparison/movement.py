"""The camera's movement against the panel between two profiles, solved from all terms that tell it.

The movement m = (x, y, z in mm; tilt, roll, yaw in degrees) is that of the entrance pupil in the panel's frame.
Geometry tells the angles; the wire angles, distance and place within a pitch; backscatter distance and whole place:

    geometry     d angles = m_angles
    wire         d angles = m_angles,  d stand-off = -m_z / pitch,  d offset = (m_x, m_y) / pitch  modulo 1
    backscatter  d stand-off_mm = -m_z,  d offset_px = -(m_x, m_y) / pitch

Generalised least squares with the estimates' joint covariance; all other estimates are free to change.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.comparison.combining import combine
from udccal.comparison.estimates import ANGLES, Difference, Name, chi2_of
from udccal.comparison.limits import DiffLimits
from udccal.fitting.engine.misfit import chi2_tail

_UNITS = ("mm", "mm", "mm", "deg", "deg", "deg")
_PARTS = ("x", "y", "z", "tilt", "roll", "yaw")


@final
@dataclass(frozen=True)
class Moved:
    """One part of a movement. ``value`` and ``sigma`` are None where no term determines it."""

    name: str
    value: float | None
    sigma: float | None
    unit: str


@final
@dataclass(frozen=True)
class Movement:
    """The movement of the camera from A to B, against the panel.

    Attributes:
        parts: x, y, z of the entrance pupil in the panel's frame, and the camera's tilt, roll and yaw.
        distance: length of (x, y, z). angle: of the whole turn.
        whole_pitches: pitches of the panel in x and y that the movement holds; None where backscatter does not tell.
        chi2, dof, p_value: of no movement at all.
        agreement_chi2, agreement_dof, agreement_p_value: of the terms' agreement on this movement.
        terms: those from which it was solved.
    """

    parts: tuple[Moved, ...]
    distance: Moved
    angle: Moved
    whole_pitches: tuple[int, int] | None
    chi2: float
    dof: int
    p_value: float
    agreement_chi2: float
    agreement_dof: int
    agreement_p_value: float
    terms: tuple[str, ...]


def movement(differences: Difference, pitch_mm: float, limits: DiffLimits) -> Movement:
    """Solve the movement that explains the differences of all terms best.

    Args:
        differences: B less A.
        pitch_mm: nominal pitch of the panel.
        limits: says when backscatter tells whole pitches.
    """
    rows = _design(pitch_mm)
    seen = differences.only(np.array([name in rows for name in differences.names], dtype=bool))
    seen, pitches = _with_whole_pitches(seen, limits)
    found = combine(np.array([rows[name] for name in seen.names]).reshape(-1, 6), seen.values, seen.cov)
    values, cov, known = found.values, found.cov, found.known
    chi2, dof = chi2_of(values[known], cov[np.ix_(known, known)])
    return Movement(
        parts=tuple(_moved(*one) for one in zip(_PARTS, values, np.sqrt(np.diag(cov)), _UNITS, strict=True)),
        distance=_length("distance", values[:3], cov[:3, :3], "mm"),
        angle=_length("angle", values[3:], cov[3:, 3:], "deg"),
        whole_pitches=pitches,
        chi2=chi2,
        dof=dof,
        p_value=chi2_tail(chi2, dof),
        agreement_chi2=found.chi2,
        agreement_dof=found.dof,
        agreement_p_value=chi2_tail(found.chi2, found.dof),
        terms=tuple(dict.fromkeys(term for term, _ in seen.names)),
    )


def _design(pitch_mm: float) -> dict[Name, Float[np.ndarray, "6"]]:
    """Derivative of each estimate that tells the movement by the movement's parts."""
    x, y, z, *angles = np.eye(6)
    rows: dict[Name, Float[np.ndarray, "6"]] = {
        ("wire", "standoff_per_pitch"): -z / pitch_mm,
        ("backscatter", "standoff_mm"): -z,
    }
    for axis, along in (("x", x), ("y", y)):
        rows["wire", f"offset_{axis}_periods"] = along / pitch_mm
        rows["backscatter", f"offset_{axis}_px"] = -along / pitch_mm
    for name, about in zip(ANGLES, angles, strict=True):
        rows["geometry", name] = rows["wire", name] = about
    return rows


def _with_whole_pitches(seen: Difference, limits: DiffLimits) -> tuple[Difference, tuple[int, int] | None]:
    """Add to the wire's places the whole pitches that bring them closest to those of backscatter."""
    wire, light = (
        [(term, f"offset_{axis}_{unit}") for axis in "xy"]
        for term, unit in (("wire", "periods"), ("backscatter", "px"))
    )
    if not {*wire, *light} <= set(seen.names):
        return seen, None
    at, to = ([seen.names.index(name) for name in names] for names in (wire, light))
    if np.any(seen.sigma[to] > limits.pitch_sigma):
        return seen, None
    whole = np.round(-seen.values[to] - seen.values[at])
    values = seen.values.copy()
    values[at] += whole
    return replace(seen, values=values), (int(whole[0]), int(whole[1]))


def _length(name: str, values: Float[np.ndarray, "3"], cov: Float[np.ndarray, "3 3"], unit: str) -> Moved:
    """Length of a vector, and its sigma along it; without a direction, RMS of the three."""
    length = float(np.linalg.norm(values))
    along = values / length if length > 0 else np.full(3, 3**-0.5)
    variance = along @ cov @ along if length > 0 else np.trace(cov) / 3
    return _moved(name, length, float(np.sqrt(np.maximum(variance, 0.0))), unit)


def _moved(name: str, value: float, sigma: float, unit: str) -> Moved:
    known = bool(np.isfinite(value) and np.isfinite(sigma))
    return Moved(name, float(value) if known else None, float(sigma) if known else None, unit)
