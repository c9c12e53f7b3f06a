"""The rig as found: pose, place, panel and pupil from all terms together, with one covariance.

Every length is measured in pitches of the panel; only the rig file says how long a pitch is. In these units the terms
measure linear functions of one state (S: stand-off, D: thickness, P: pupil):

    geometry     tilt, roll, yaw
    wire         tilt, roll, yaw;  S + D / 2;  P (1 - stand-off / focus);  D; openings
    psf          P; D; openings
    backscatter  S; place on the panel

The pupil of backscatter is left out. It is the width of a footprint whose edge the model makes soft, and it takes up
what the model lacks there: on one of six simulated specimens it was off by 3.7 sigma. Wire and psf know it better.

The wire measures openings and their depth as if they were rectangles. Where the psf has found round corners or a bar in
them, these numbers of the wire are left out.

The place is that against the panel's green emitters. Where they are between the openings is not known, so that the
wire's place within a period does not tell it; it tells movements (``movement.py``).

The rig file's values with its tolerances are one more measurement. An estimate that is mostly its own prior is left
out, since it repeats the rig file. What terms share is in the covariance where ``held_estimates`` has it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from udccal.comparison.combining import Combined, combine
from udccal.comparison.comparable import check_finite
from udccal.comparison.estimates import ANGLES, Estimates, Name, within_half_turn
from udccal.comparison.held import held_estimates
from udccal.comparison.shared import Measured
from udccal.fitting.engine.gaussian import square_root
from udccal.fitting.engine.misfit import chi2_tail
from udccal.fitting.psf.fit import SHAPE
from udccal.quantities import quantity
from udccal.result import Estimate, EstimatePrior
from udccal.rig import RigDescription

NAMES = (
    *ANGLES, "standoff_mm", "panel_x_px", "panel_y_px", "pitch_mm", "column_open", "row_open", "depth_mm",
    "pupil_diameter_mm",
)  # fmt: skip
# Numbers of the wire that are those of rectangular openings.
_OPENINGS = "column_open", "row_open", "depth_per_pitch"
_BACKSCATTER_LENGTHS = tuple(("backscatter", name) for name in ("standoff_mm", "pupil_diameter_mm", "reflection_mm"))
_PITCH, _LENGTHS = NAMES.index("pitch_mm"), [3, 9, 10]
_AT = {name: np.eye(len(NAMES))[i] for i, name in enumerate(NAMES)}


@final
@dataclass(frozen=True)
class RigState:
    """The rig as all terms find it.

    Attributes:
        estimates: in the order of ``NAMES``; the prior of each is the rig file's value with its tolerance.
        cov: of these, in their units.
        agreement_chi2, agreement_dof, agreement_p_value: of the terms' agreement on it, without the rig file.
        terms: those that tell it.
    """

    estimates: tuple[Estimate, ...]
    cov: Float[np.ndarray, "n n"]
    agreement_chi2: float
    agreement_dof: int
    agreement_p_value: float
    terms: tuple[str, ...]


def rig_state(measured: Measured) -> RigState:
    """Solve the state of a rig from all terms of a profile or a calibration, and from its rig file.

    It is computed from what a profile holds and is not stored: a stored copy could contradict its sources.

    Raises:
        ProfileError: when a covariance cannot be one, or numbers are not finite.
    """
    rig = measured.rig
    held = _in_pitches(held_estimates(measured), rig)
    names, design, values, cov = _measurements(measured, held)
    agreed = combine(design, values, cov)
    nominal = _in_file(rig)
    file_design, file_values, file_sigma = _file_measurements(nominal)
    whole = combine(
        np.vstack([design, file_design]),
        np.concatenate([values, file_values]),
        block_diag(cov, np.diag(file_sigma**2)),
    )
    values, cov = _in_mm(whole, rig)
    check_finite(values, cov, np.array([agreed.chi2]))
    estimates = tuple(
        Estimate(name, float(v), float(s), quantity("rig", name).unit, nominal[name])
        for name, v, s in zip(NAMES, values, np.sqrt(np.maximum(np.diag(cov), 0.0)), strict=True)
    )
    terms = tuple(dict.fromkeys(term for term, _ in names))
    return RigState(estimates, cov, agreed.chi2, agreed.dof, chi2_tail(agreed.chi2, agreed.dof), terms)


def _rows() -> dict[Name, Float[np.ndarray, " n"]]:
    """Derivative of each estimate that tells the state, in pitches, by the state."""
    rows: dict[Name, Float[np.ndarray, " n"]] = {(term, a): _AT[a] for a in ANGLES for term in ("geometry", "wire")}
    rows["wire", "standoff_per_pitch"] = _AT["standoff_mm"] + _AT["depth_mm"] / 2
    rows["backscatter", "standoff_mm"] = _AT["standoff_mm"]
    rows["wire", "depth_per_pitch"] = rows["psf", "depth_mm"] = _AT["depth_mm"]
    rows["wire", "footprint_per_pitch"] = _AT["pupil_diameter_mm"]
    rows["psf", "pupil_diameter_mm"] = _AT["pupil_diameter_mm"]
    for name in ("column_open", "row_open"):
        rows["wire", name] = rows["psf", name] = _AT[name]
    for axis in "xy":
        rows["backscatter", f"offset_{axis}_px"] = -_AT[f"panel_{axis}_px"]
    return rows


def _in_pitches(held: Estimates, rig: RigDescription) -> Estimates:
    """The estimates with all lengths in pitches and the pupil's own diameter instead of its shadow's.

    psf and backscatter measure in pitches, too; they give mm by the rig file's pitch, whose tolerance is taken out.
    """
    values, cov, at = held.values.copy(), held.cov.copy(), {name: i for i, name in enumerate(held.names)}
    pitch, change, by_pitch = rig.panel.pitch_mm, np.eye(len(values)), np.zeros(len(values))
    with np.errstate(all="ignore"):
        for name in (("psf", "depth_mm"), ("psf", "pupil_diameter_mm")):
            if name in at and ("psf", "pitch_mm") in at:
                i, own = at[name], at["psf", "pitch_mm"]
                change[i, i], change[i, own] = 1 / held.values[own], -held.values[i] / held.values[own] ** 2
                values[i] /= held.values[own]
        for i in (at[name] for name in _BACKSCATTER_LENGTHS if name in at):
            change[i, i] = 1 / pitch.value
            values[i] /= pitch.value
            by_pitch[i] = values[i] * pitch.tolerance / pitch.value
        if {("wire", "footprint_per_pitch"), ("wire", "standoff_per_pitch")} <= set(at):
            i, standoff_mm = at["wire", "footprint_per_pitch"], values[at["wire", "standoff_per_pitch"]] * pitch.value
            # Rays converge from the pupil towards the focus.
            change[i, i] = 1 / (1 - standoff_mm / rig.lens.focus_mm)
            values[i] *= change[i, i]
        cov = change @ cov @ change.T - np.outer(by_pitch, by_pitch)
    check_finite(values, cov)
    root = square_root(cov)
    return Estimates(held.names, held.units, values, root @ root.T)


def _measurements(
    measured: Measured, held: Estimates
) -> tuple[tuple[Name, ...], Float[np.ndarray, "m 11"], Float[np.ndarray, " m"], Float[np.ndarray, "m m"]]:
    """The estimates that data have decided: names, derivatives by the state, values, and covariance."""
    by_prior = {(result.name, one.name) for result in measured.results for one in result.estimates if one.by_prior}
    rows = _rows()
    if any(("psf", name) in held.names for name in SHAPE):
        for name in _OPENINGS:
            del rows["wire", name]
    at = [i for i, name in enumerate(held.names) if name in rows and held.cov[i, i] > 0 and name not in by_prior]
    names, values = tuple(held.names[i] for i in at), held.values[at]
    mounting = measured.rig.mounting
    for axis, nominal in (("x", mounting.panel_x_px), ("y", mounting.panel_y_px)):
        # Backscatter gives the place against the nominal one.
        values[[name == ("backscatter", f"offset_{axis}_px") for name in names]] -= nominal.value
    for angle in ANGLES:
        # 180 and -180 degrees are one angle: the one that is closer to the rig file's counts.
        here, nominal_deg = [name[1] == angle for name in names], getattr(mounting, angle).value
        values[here] = nominal_deg + within_half_turn(values[here] - nominal_deg)
    design = np.array([rows[name] for name in names]).reshape(-1, len(NAMES))
    return names, design, values, held.cov[np.ix_(at, at)]


def _in_file(rig: RigDescription) -> dict[str, EstimatePrior]:
    """The rig file's values with their tolerances, in the order and units of the state."""
    panel, mounting, lens = rig.panel, rig.mounting, rig.lens
    stated = (
        mounting.tilt_deg, mounting.roll_deg, mounting.yaw_deg, mounting.standoff_mm, mounting.panel_x_px,
        mounting.panel_y_px, panel.pitch_mm, panel.column_open, panel.row_open, panel.depth_mm,
    )  # fmt: skip
    pupil = rig.pupil_diameter_mm * sum(one.tolerance / one.value for one in (lens.focal_mm, lens.f_number))
    found = {name: EstimatePrior(one.value, one.tolerance) for name, one in zip(NAMES, stated, strict=False)}
    return found | {"pupil_diameter_mm": EstimatePrior(rig.pupil_diameter_mm, pupil)}


def _file_measurements(
    nominal: Mapping[str, EstimatePrior],
) -> tuple[Float[np.ndarray, "11 11"], Float[np.ndarray, " 11"], Float[np.ndarray, " 11"]]:
    """The rig file as measurements of the state: derivatives, values, and sigmas.

    The pitch is a logarithm, 0 at its nominal value. A length in mm is to first order one in pitches and a pitch.
    """
    values, sigma = (np.array([getattr(nominal[name], part) for name in NAMES]) for part in ("value", "sigma"))
    # What a file gives without a tolerance is known well enough.
    sigma = np.maximum(sigma, 1e-6 * np.maximum(np.abs(values), 1e-3))
    pitch, design = values[_PITCH], np.eye(len(NAMES))
    values[_LENGTHS], sigma[_LENGTHS] = values[_LENGTHS] / pitch, sigma[_LENGTHS] / pitch
    design[_LENGTHS, _PITCH] = values[_LENGTHS]
    values[_PITCH], sigma[_PITCH] = 0.0, sigma[_PITCH] / pitch
    return design, values, sigma


def _in_mm(found: Combined, rig: RigDescription) -> tuple[Float[np.ndarray, " 11"], Float[np.ndarray, "11 11"]]:
    """The state with its lengths in mm, and its covariance."""
    values, change = found.values.copy(), np.eye(len(NAMES))
    with np.errstate(over="ignore"):
        pitch = rig.panel.pitch_mm.value * np.exp(values[_PITCH])
        values[_LENGTHS] *= pitch
    change[_LENGTHS, _LENGTHS] = change[_PITCH, _PITCH] = pitch
    change[_LENGTHS, _PITCH] = values[_LENGTHS]
    values[_PITCH] = pitch
    return values, change @ found.cov @ change.T
