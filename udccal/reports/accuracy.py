"""Accuracy of each term, the part of the frames' information that was used, and the effect of more captures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from udccal.calibration import ORDER, Calibration
from udccal.errors import UdccalError
from udccal.fitting.geometry.fit import projection_sigma_px
from udccal.numerics import in_two_threads
from udccal.planning.forecast import Curve, Forecast, forecast
from udccal.planning.state import measured_state, sensor_samples
from udccal.reports.tables import Table
from udccal.result import FitResult, FitStatus
from udccal.rig import RigDescription
from udccal.sessions.schema import TermName

_ACROSS = 17
# A smaller gain is not worth a sentence.
_LEAST_GAIN = 1.02


@dataclass(frozen=True)
class Accuracy:
    """One term's accuracy: the forecast for its captures, and the fit's own sigma (None if of another quantity).

    Attributes:
        used: fraction of the information in the frames that the fit used, from the fit's diagnostics where it has one.
        full: whether the fit's effort was full, as in the checks of the forecasts.
    """

    forecast: Forecast
    stated: float | None
    used: float
    full: bool = True

    @property
    def sigma(self) -> float:
        """The fit's own sigma where it has one, else the forecast."""
        return self.forecast.sigma if self.stated is None else self.stated

    @property
    def efficiency(self) -> float:
        """Cramér-Rao variance of all frames over the fit's variance: ``used``, less the fit's own inefficiency."""
        return self.used * min((self.forecast.sigma / self.sigma) ** 2, 1.0)


def accuracies(calibration: Calibration) -> tuple[Accuracy, ...]:
    """Return the accuracy of each fitted term; leave out terms whose procedure does not describe its captures."""
    state = replace(measured_state(calibration.rig, calibration), wire_pixels=calibration.wire.samples)

    def of(term: TermName) -> Accuracy | None:
        result = calibration.result(term)
        try:
            ahead = forecast(term, state)
        except UdccalError:
            return None
        if ahead is None:
            return None
        used = _diagnostic(result, "efficiency")
        used = ahead.limits.used if used is None else used
        return Accuracy(ahead, stated(term, result, calibration.rig), used, result.effort == "full")

    terms = [term for term in ORDER if calibration.result(term).status is FitStatus.CONVERGED]
    found = in_two_threads(of, terms) if terms else []
    return tuple(accuracy for accuracy in found if accuracy is not None)


def stated(term: TermName, result: FitResult, rig: RigDescription) -> float | None:
    """Return the fit's own sigma of the term's quantity, where the result holds it."""
    match term:
        case "noise":
            K = result.estimate("K_DN_per_e")
            return 100 * K.sigma / K.value
        case "geometry":
            if not len(result.cov) or result.posterior is None:
                return None
            sigma = projection_sigma_px(result, sensor_samples(rig, _ACROSS))
            return float(np.sqrt(np.mean(sigma**2)))
        case "wire":
            return _diagnostic(result, "wire_map_rms_sigma")
        case "psf" | "backscatter":
            return None


def accuracy_table(accuracy: Accuracy) -> Table:
    """Return the numbers of the figure as a table."""
    ahead, unit = accuracy.forecast, accuracy.forecast.quantity.unit
    within = " (within 15 %)" if accuracy.full else ""
    rows = [(f"forecast for the captured frames{within}", f"{ahead.sigma:.3g} {unit}")]
    if accuracy.stated is not None:
        rows.append(("sigma of the fit", f"{accuracy.stated:.3g} {unit}"))
    rows.append(("floor, however much is captured", f"{ahead.limits.floor:.3g} {unit}" if ahead.limits.floor else "–"))
    rows.append(("efficiency: used part of the information in the frames", f"{100 * accuracy.efficiency:.0f} %"))
    rows.append(("unused part of the information", f"{100 * (1 - accuracy.efficiency):.0f} %"))
    title = f"Accuracy: σ of {ahead.quantity.meaning}"
    return Table(title, ("", ""), tuple(rows), frozenset({1}))


def forecast_sentence(ahead: Forecast) -> str:
    """Return a sentence about which captures to increase."""
    said = "The curves show sigma against each number of captures, with the others unchanged. "
    best = max(ahead.curves, key=lambda curve: curve.most_gain)
    if best.most_gain < _LEAST_GAIN:
        said += "More captures would hardly lower sigma. "
    else:
        said += f"{_gain(ahead, best)} "
    if ahead.limits.floor and best.most_gain * ahead.limits.floor > ahead.sigma / 2:
        said += f"The floor is {ahead.limits.floor:.3g} {ahead.quantity.unit}. {ahead.limits.lowered_by}"
    if ahead.idle:
        said += f" It does not depend on {' or '.join(ahead.idle)}."
    return said.strip()


def _gain(ahead: Forecast, best: Curve) -> str:
    unit = ahead.quantity.unit
    counted = f"{best.variable.counted}, {best.counts[-1]:.0f} instead of {best.now}"
    return f"More {counted}, lower sigma most: {best.sigma[-1]:.3g} {unit} instead of {ahead.sigma:.3g} {unit}."


def _diagnostic(result: FitResult, name: str) -> float | None:
    return next((float(item.value) for item in result.diagnostics if item.name == name), None)
