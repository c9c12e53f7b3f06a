"""How accurate each term is, how much of what its frames tell was used, and what more captures would bring."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from udccal.calibration import ORDER, Calibration
from udccal.errors import UdccalError
from udccal.fitting.geometry.boards import projection_sigma_px
from udccal.planning.forecast import Curve, Forecast, forecast
from udccal.planning.state import measured_state, sensor_samples
from udccal.reports.tables import Table
from udccal.result import FitResult, FitStatus
from udccal.rig import RigDescription
from udccal.sessions.schema import TermName

_ACROSS = 17
# A gain below this is none worth a sentence.
_LEAST_GAIN = 1.02


@dataclass(frozen=True)
class Accuracy:
    """One term's accuracy: as forecast for its captures, and as its fit states it (None where it states another).

    Attributes:
        used: share of the information in the frames that the fit spent, by the fit's own count where it has one.
    """

    forecast: Forecast
    stated: float | None
    used: float

    @property
    def sigma(self) -> float:
        """By the fit where it says so, else the forecast."""
        return self.forecast.sigma if self.stated is None else self.stated

    @property
    def efficiency(self) -> float:
        """Cramér-Rao variance of all frames over the one stated; what the fit spent may be spent less than well."""
        return self.used * min((self.forecast.sigma / self.sigma) ** 2, 1.0)


def accuracies(calibration: Calibration) -> tuple[Accuracy, ...]:
    """Of the terms that were fitted; those whose procedure does not tell what it takes are left out."""
    state = measured_state(calibration.rig, calibration)
    found = []
    for term in ORDER:
        result = calibration.result(term)
        if result.status is not FitStatus.CONVERGED:
            continue
        try:
            ahead = forecast(term, state)
        except UdccalError:
            continue
        if ahead is not None:
            used = _diagnostic(result, "efficiency")
            found.append(Accuracy(ahead, stated(term, result, calibration.rig), ahead.used if used is None else used))
    return tuple(found)


def stated(term: TermName, result: FitResult, rig: RigDescription) -> float | None:
    """The sigma of the term's quantity by its own fit, where the result holds it."""
    match term:
        case "noise":
            K = result.estimate("K_DN_per_e")
            return 100 * K.sigma / K.value
        case "geometry":
            if not len(result.cov):
                return None
            sigma = projection_sigma_px(result, sensor_samples(rig, _ACROSS))
            return float(np.sqrt(np.mean(sigma**2)))
        case "wire":
            return _diagnostic(result, "wire_map_rms_sigma")
        case "psf" | "backscatter":
            return None


def accuracy_table(accuracy: Accuracy) -> Table:
    """The numbers beside the figure."""
    ahead, unit = accuracy.forecast, accuracy.forecast.quantity.unit
    rows = [("forecast for the frames captured (to 15 %)", f"{ahead.sigma:.3g} {unit}")]
    if accuracy.stated is not None:
        rows.append(("stated by the fit", f"{accuracy.stated:.3g} {unit}"))
    rows.append(("left, however much is captured", f"{ahead.floor.sigma:.3g} {unit}" if ahead.floor.sigma else "–"))
    rows.append(("efficiency: information in the frames that is used", f"{100 * accuracy.efficiency:.0f} %"))
    rows.append(("information left on the table", f"{100 * (1 - accuracy.efficiency):.0f} %"))
    title = f"Accuracy: σ of {ahead.quantity.meaning}"
    return Table(title, ("", ""), tuple(rows), frozenset({1}))


def forecast_sentence(ahead: Forecast) -> str:
    """What to capture more of, in words."""
    said = "How sure the result is against how much is captured, all else as it was. "
    best = max(ahead.curves, key=lambda curve: curve.most_gain)
    if best.most_gain < _LEAST_GAIN:
        said += "More captures bring next to nothing. "
    else:
        said += f"{_gain(ahead, best)} "
    if ahead.floor.sigma and best.most_gain * ahead.floor.sigma > ahead.sigma / 2:
        said += ahead.floor.lowered_by
    if ahead.idle:
        said += f" It does not depend on {' or '.join(ahead.idle)}."
    return said.strip()


def _gain(ahead: Forecast, best: Curve) -> str:
    unit = ahead.quantity.unit
    counted = f"{best.variable.counted}, {best.counts[-1]:.0f} for {best.now}"
    return f"Most would come from more {counted}: {best.sigma[-1]:.3g} {unit} for {ahead.sigma:.3g} {unit}."


def _diagnostic(result: FitResult, name: str) -> float | None:
    return next((float(item.value) for item in result.diagnostics if item.name == name), None)
