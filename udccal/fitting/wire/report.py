"""A wire fit's numbers, gathered for a person to read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import equinox as eqx
import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.gaussian import Posterior, Prior
from udccal.fitting.engine.orders import Choice
from udccal.fitting.engine.report import estimates, residual_sample
from udccal.fitting.wire.data import Weighed
from udccal.fitting.wire.jacobian import values_at
from udccal.fitting.wire.misfit import Misfit
from udccal.fitting.wire.parameters import SHAPE_NAMES, SHAPE_UNITS, Parameters
from udccal.fitting.wire.rules import WireRules
from udccal.models.geometry import tilt_rad
from udccal.models.wire import Wire, panel_rotation
from udccal.result import Diagnostic, Estimate, FitResult, FitStatus

_FEW = 16_384


@final
@dataclass(frozen=True)
class Joint:
    """A fitted wire, and what tells how sure it is.

    Attributes:
        parameters: those kept, of all orders of ``orders``.
        x: their values; the map's mean is 1.
        cov: theirs, misfit included where it was found.
        prior: of the same.
        variance: of the residuals, in units of what noise makes.
        by_tile: each tile's part of the score.
        seen: the pixels of the fit, weighed by the fitted wire.
        converged, iterations: of the descents.
        gain: chi-squared that the rows' first harmonic explained in the scan.
    """

    parameters: Parameters
    x: Float[np.ndarray, " n"]
    cov: Float[np.ndarray, "n n"]
    prior: Prior
    variance: float
    seen: Weighed
    by_tile: Float[np.ndarray, "tiles n"]
    orders: Choice
    converged: bool
    iterations: int
    gain: float

    @property
    def wire(self) -> Wire:
        """As fitted."""
        return self.parameters.wire(self.x)

    @property
    def impossible(self) -> bool:
        """Whether an opening is surely wider than its period."""
        wide = self.x[self.parameters.linear :][7:9] - 1
        return bool(np.any(wide > 3 * np.sqrt(np.diag(self.cov)[self.parameters.linear :][7:9])))


def wire_result(
    joint: Joint,
    found: Misfit,
    left_out: float,
    map_sigma: float,
    posterior: Posterior[Wire],
    shape: tuple[int, int],
    rules: WireRules,
) -> FitResult[Wire]:
    """The result of a fit that came to its end.

    Args:
        joint: the fit.
        found: whether the model describes the data.
        left_out: of harmonics that were left out, or of rows that may be there unseen; relative, RMS over the sensor.
        map_sigma: of the map, relative, RMS over the sensor.
        posterior: of the wire.
        shape: rows and columns of the sensor.
        rules: what is doubted.
    """
    panel, seen = joint.parameters.panel, joint.seen
    term = trimmed(posterior.term_at(posterior.mean), panel)
    outliers = seen.outliers(shape[1])
    drawn = np.flatnonzero(seen.pixels.weight > 0)
    places = (seen.pixels.scaled[drawn] + 1) / 2 * [shape[1] - 1, shape[0] - 1]
    named, cov = _estimates(joint) if panel else ((), np.zeros((0, 0)))
    return FitResult(
        name="wire",
        term=term,
        status=_status(joint, rules),
        estimates=named,
        cov=cov,
        chi2_dof=joint.variance,
        samples=seen.pixels.used,
        candidates=joint.orders.candidates,
        diagnostics=(
            Diagnostic("wire_map_rms_sigma", 100 * map_sigma, "%"),
            Diagnostic("wire_map_model_sigma", 100 * float(np.hypot(found.sigma, left_out)), "%"),
            Diagnostic("harmonics_left_out", 100 * left_out, "%"),
            Diagnostic("model_sigma_that_would_be_seen", 100 * found.resolution, "%"),
            Diagnostic("residual_pattern_p_value", found.test.p_value, "1"),
            Diagnostic("efficiency", seen.pixels.used / (shape[0] * shape[1]), "1"),
            Diagnostic("residual_rms", 100 * found.residual_rms, "%"),
            Diagnostic("modulation_peak_to_peak", 100 * _peak_to_peak(joint), "%"),
            Diagnostic("harmonics", float(np.shape(term.harmonics)[0]), "1"),
            Diagnostic("parameters", float(joint.parameters.linear), "1"),
            Diagnostic("pixels_left_out", float(sum(one.count for one in outliers)), "1"),
            Diagnostic("gain_in_chi2", joint.gain, "1"),
            *_tilts(term),
            Diagnostic("iterations", float(joint.iterations), "1"),
        ),
        notes=tuple(_notes(joint, found, left_out, rules)),
        outliers=outliers,
        residuals=residual_sample(places, seen.z[drawn]),
        posterior=posterior,
    )


def trimmed(wire: Wire, panel: bool) -> Wire:
    """Without Legendre degrees that no harmonic uses, and without harmonics where no panel is: quicker to compute."""
    used = np.flatnonzero(np.any(np.asarray(wire.fields) != 0, axis=(0, 1, 2)))
    degrees, count = (int(used.max()) + 1 if used.size else 1), (None if panel else 0)
    beside = wire.amplitudes if np.any(wire.amplitudes) else np.zeros((0, 2, 1, 1))
    leaves = (wire.harmonics[:count], wire.frequency[:count], wire.fields[:count, ..., :degrees], beside)
    return eqx.tree_at(lambda w: (w.harmonics, w.frequency, w.fields, w.amplitudes), wire, leaves)


def _status(joint: Joint, rules: WireRules) -> FitStatus:
    if joint.variance > rules.worst_variance or joint.impossible:
        return FitStatus.POOR_FIT
    if not joint.parameters.panel:
        return FitStatus.ABSENT
    return FitStatus.CONVERGED if joint.converged else FitStatus.NOT_CONVERGED


def _notes(joint: Joint, found: Misfit, left_out: float, rules: WireRules) -> Iterator[str]:
    if joint.parameters.panel:
        yield "cov covers the shape parameters, as fitted together with all coefficients of the fields."
        off = (joint.prior.root @ (joint.x - joint.prior.mean))[joint.parameters.linear :]
        for name, sigmas in zip(SHAPE_NAMES, np.abs(off), strict=True):
            if sigmas > rules.doubted_sigma:
                yield f"{name} is {sigmas * 2:.0f} tolerances away from the rig description; check it."
    else:
        yield "No modulation by rows is visible; the map is the shading alone."
        if left_out > 0:
            yield (
                f"These flats are too noisy to tell: rows may modulate by {100 * left_out:.2g} % unseen, which "
                "the stated sigmas include. Average more frames, or expose longer."
            )
    if found.test.found:
        yield (
            f"The residuals are patterned (p = {found.test.p_value:.1g}): the model may be {100 * found.sigma:.3f} % "
            "off, which the stated sigmas include."
        )
    if joint.impossible:
        yield "An opening came out wider than its period: check panel, pitch and lens in the rig description."
    if joint.variance > rules.worst_variance:
        yield "Look at the residual map for dust, glare or uneven light; check PRNU and the rig description."
    elif not joint.converged:
        yield "Capture more flats, or give the fit more pixels."


def _peak_to_peak(joint: Joint) -> float:
    few = joint.seen.pixels.thinned(_FEW)
    return float(np.ptp(values_at(joint.wire, few.ideal, few.scaled)[0]))


def _tilts(wire: Wire) -> tuple[Diagnostic, Diagnostic]:
    tilt = float(np.rad2deg(np.arcsin(np.clip(np.asarray(panel_rotation(wire))[1, 2], -1.0, 1.0))))
    apart = tilt - float(np.rad2deg(tilt_rad(wire.geometry)))
    return Diagnostic("tilt_by_wire", tilt, "deg"), Diagnostic("tilt_by_wire_minus_geometry", apart, "deg")


def _estimates(joint: Joint) -> tuple[tuple[Estimate, ...], Float[np.ndarray, "10 10"]]:
    # The fit's own parameters are radians and, for stand-off and pupil, logarithms.
    values, unit = joint.x[joint.parameters.linear :].copy(), np.ones(len(SHAPE_NAMES))
    values[[3, 6]] = unit[[3, 6]] = np.exp(values[[3, 6]])
    values[:3], unit[:3] = np.rad2deg(values[:3]), 180 / np.pi
    values[4:6] %= 1.0
    cov = joint.cov[joint.parameters.linear :, joint.parameters.linear :] * np.outer(unit, unit)
    return estimates(SHAPE_NAMES, SHAPE_UNITS, values, cov), cov
