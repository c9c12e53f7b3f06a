"""The wire fit's numbers, gathered for a person to read."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.fitting.wire.joint import Joint
from udccal.fitting.wire.misfit import Misfit, robust_ratio
from udccal.fitting.wire.noise import Judged, listed
from udccal.fitting.wire.phase import PhaseFit
from udccal.fitting.wire.scan import modulation_at
from udccal.fitting.wire.sigma import MapSigma
from udccal.models.geometry import tilt_rad
from udccal.models.wire import Wire, panel_rotation
from udccal.result import Diagnostic, Estimate, FitResult, FitStatus, ResidualSample

SHAPE_NAMES = (
    "rotation_x_deg",
    "rotation_y_deg",
    "rotation_z_deg",
    "standoff_per_pitch",
    "offset_x",
    "offset_y",
    "pupil_per_pitch",
    "row_open",
    "column_open",
    "depth_per_pitch",
)
SHAPE_UNITS = ("deg", "deg", "deg", "1", "period", "period", "1", "1", "1", "1")
# Structure that the model lacks, as strong as shot noise and PRNU together.
_WORST_CHI2 = 2.0
# Beyond so many prior sigmas the rig description is doubted.
_DOUBTED = 3.0
_FEW = 16_384
_MOST_RESIDUALS = 6000


def wire_result(
    phase: PhaseFit, joint: Joint, found: Misfit, sigma: MapSigma, wire: Wire, pixels: int
) -> FitResult[Wire]:
    """The result of a fit that came to its end.

    Args:
        phase: search and start.
        joint: the fit.
        found: whether the model describes the data.
        sigma: of the map.
        wire: the term.
        pixels: of the sensor.
    """
    spent = joint.judged.pixels
    estimates, cov = _estimates(wire, joint, found) if joint.shape else ((), np.zeros((0, 0)))
    left_out = joint.judged.clipped + int(np.count_nonzero(joint.judged.outlying))
    return FitResult(
        name="wire",
        term=wire,
        status=_status(phase, joint),
        estimates=estimates,
        cov=cov,
        chi2_dof=joint.variance,
        samples=spent.used,
        candidates=joint.candidates,
        diagnostics=(
            Diagnostic("wire_map_rms_sigma", 100 * sigma.rms(), "%"),
            Diagnostic("wire_map_model_sigma", 100 * found.sigma, "%"),
            Diagnostic("harmonics_left_out", 100 * found.omitted, "%"),
            Diagnostic("model_sigma_that_would_be_seen", 100 * found.resolution, "%"),
            Diagnostic("residual_pattern_p_value", found.p_value, "1"),
            Diagnostic("efficiency", spent.used / pixels, "1"),
            Diagnostic("residual_rms", 100 * found.residual_rms, "%"),
            Diagnostic("modulation_peak_to_peak", 100 * _peak_to_peak(joint, wire), "%"),
            Diagnostic("harmonics", float(np.shape(wire.harmonics)[0]), "1"),
            Diagnostic("parameters", float(joint.basis.size), "1"),
            Diagnostic("pixels_left_out", float(left_out), "1"),
            Diagnostic("gain_in_chi2", phase.gain_in_chi2, "1"),
            *_tilts(wire),
            Diagnostic("iterations", float(phase.iterations + joint.rounds), "1"),
        ),
        notes=_notes(phase, joint, found, wire),
        outliers=listed(joint.judged, sigma.columns),
        residuals=_residuals(joint.judged, sigma),
    )


def _residuals(judged: Judged, sigma: MapSigma) -> ResidualSample:
    """Of evenly drawn pixels in use."""
    pixels, use = judged.pixels, np.flatnonzero(judged.pixels.weight > 0)
    drawn = use[:: max(1, -(-len(use) // _MOST_RESIDUALS))]
    z = (pixels.value[drawn] - judged.expected[drawn]) * np.sqrt(pixels.weight[drawn])
    places = (pixels.scaled[drawn] + 1) / 2 * [sigma.columns - 1, sigma.rows - 1]
    return ResidualSample(np.asarray(places, dtype=np.float64), np.asarray(z, dtype=np.float64))


def _impossible(joint: Joint) -> bool:
    """Whether an opening is surely wider than its period."""
    if not joint.shape:
        return False
    sigma = np.sqrt(np.diag(joint.cov)[-len(SHAPE_NAMES) :])[7:9]
    return bool(np.any(np.array([joint.wire.row_open, joint.wire.column_open]) - 1 > 3 * sigma))


def _status(phase: PhaseFit, joint: Joint) -> FitStatus:
    if joint.variance > _WORST_CHI2 or _impossible(joint):
        return FitStatus.POOR_FIT
    if not phase.present:
        return FitStatus.ABSENT
    return FitStatus.CONVERGED if joint.converged else FitStatus.NOT_CONVERGED


def _notes(phase: PhaseFit, joint: Joint, found: Misfit, wire: Wire) -> tuple[str, ...]:
    notes = []
    if phase.present:
        notes.append("cov covers the shape parameters, as fitted together with all coefficients of the fields.")
        notes += _doubts(joint, phase, wire)
    else:
        notes.append("No modulation by rows is visible; the map is the shading alone.")
        if found.omitted > 0:
            notes.append(
                f"These flats are too noisy to tell: rows may modulate by {100 * found.omitted:.2g} % unseen, which "
                "the stated sigmas include. Average more frames, or expose longer."
            )
    if found.found:
        notes.append(
            f"The residuals are patterned (p = {found.p_value:.1g}): the model may be {100 * found.sigma:.3f} % off, "
            "which the stated sigmas include."
        )
    if _impossible(joint):
        notes.append("An opening came out wider than its period: check panel, pitch and lens in the rig description.")
    if joint.variance > _WORST_CHI2:
        notes.append("Look at the residual map for dust, glare or uneven light; check PRNU and the rig description.")
    elif not joint.converged:
        notes.append("Capture more flats, or give the fit more pixels.")
    return tuple(notes)


def _doubts(joint: Joint, phase: PhaseFit, wire: Wire) -> list[str]:
    """Shape parameters that contradict the rig description, in words."""
    off = phase.prior.offsets(wire, joint.basis, shape=True)[-len(SHAPE_NAMES) :] / phase.prior.sigma
    return [
        f"{name} is {abs(sigmas) * 2:.0f} tolerances away from the rig description; check it."
        for name, sigmas in zip(SHAPE_NAMES, off, strict=True)
        if abs(sigmas) > _DOUBTED
    ]


def _peak_to_peak(joint: Joint, wire: Wire) -> float:
    spent = joint.judged.pixels
    few = np.s_[:: max(1, len(spent.ideal) // _FEW)]
    return float(np.ptp(np.asarray(modulation_at(wire, spent.ideal[few][:_FEW], spent.scaled[few][:_FEW]))))


def _tilts(wire: Wire) -> tuple[Diagnostic, Diagnostic]:
    tilt = float(np.rad2deg(np.arcsin(np.clip(np.asarray(panel_rotation(wire))[1, 2], -1.0, 1.0))))
    apart = tilt - float(np.rad2deg(tilt_rad(wire.geometry)))
    return Diagnostic("tilt_by_wire", tilt, "deg"), Diagnostic("tilt_by_wire_minus_geometry", apart, "deg")


def _estimates(wire: Wire, joint: Joint, found: Misfit) -> tuple[tuple[Estimate, ...], Float[np.ndarray, "10 10"]]:
    # The fit's own parameters are radians and, for stand-off and pupil, logarithms.
    unit = np.ones(len(SHAPE_NAMES))
    unit[:3] = 180 / np.pi
    unit[3], unit[6] = float(np.asarray(wire.standoff_per_pitch)), float(np.asarray(wire.pupil_per_pitch))
    if found.found:
        unit = unit * robust_ratio(joint)[-len(unit) :]
    cov = joint.cov[-len(unit) :, -len(unit) :] * np.outer(unit, unit)
    shape = (wire.standoff_per_pitch, *np.mod(wire.offset, 1.0), wire.pupil_per_pitch)
    values = np.array([*np.rad2deg(wire.rotation), *shape, wire.row_open, wire.column_open, wire.depth_per_pitch])
    estimates = tuple(
        Estimate(name, float(value), float(np.sqrt(variance)), unit_name)
        for name, value, variance, unit_name in zip(SHAPE_NAMES, values, np.diag(cov), SHAPE_UNITS, strict=True)
    )
    return estimates, cov
