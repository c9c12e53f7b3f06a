"""The five chapters of a report: each term's figures, tables and sentences."""

from __future__ import annotations

from dataclasses import dataclass

from matplotlib.figure import Figure

from udccal.calibration import ORDER, Calibration
from udccal.fitting.psf.held_out import stated_by
from udccal.quantities import quantity
from udccal.reports import figures, fit_figures
from udccal.reports.accuracy import Accuracy, accuracy_table, forecast_sentence
from udccal.reports.board_views import BoardEvidence
from udccal.reports.evidence import PhotonTransfer
from udccal.reports.fit_tables import (
    candidates_table,
    captures_sentence,
    diagnostics_table,
    estimates_table,
    meanings_table,
    more_orders,
    orders_table,
    outliers_table,
)
from udccal.reports.maps import TermMaps
from udccal.reports.page import Illustration, TermSection
from udccal.reports.residuals import residual_histogram, residual_map
from udccal.reports.tables import Table, number, spread
from udccal.reports.truth import TruthRow
from udccal.sessions.schema import TermName

_LONGEST_LIST = 14


@dataclass(frozen=True)
class Evidence:
    """All numbers of a report; the page leaves out what is None."""

    calibration: Calibration
    fitted: TermMaps
    true: TermMaps | None
    rows: tuple[TruthRow, ...]
    transfer: PhotonTransfer | None
    boards: BoardEvidence | None
    accuracies: tuple[Accuracy, ...]

    def accuracy(self, term: TermName) -> Accuracy | None:
        """Return the accuracy of a term; None where it is not known."""
        return next((one for one in self.accuracies if one.forecast.term == term), None)


_EXPLANATIONS: dict[TermName, str] = {
    "noise": "The sensor's response: gain, dark noise and non-uniformity, with the names of EMVA 1288.",
    "geometry": "The direction of each pixel: the lens with its distortion, and the camera's rotation to the panel.",
    "wire": "The shadow of the panel's pixel rows, far out of focus: a ripple that multiplies the picture.",
    "psf": "Diffraction of a point of light by the panel's rows; it changes over the field and with colour.",
    "backscatter": "Light of the panel itself that scatters back into the lens; it depends on what the panel shows.",
}


def sections(evidence: Evidence) -> tuple[TermSection, ...]:
    """Return one section per term in the order of the fits."""
    return tuple(_section(term, evidence) for term in ORDER)


def _section(term: TermName, evidence: Evidence) -> TermSection:
    result = evidence.calibration.result(term)
    shown = () if result.unfitted else (*_illustrations(term, evidence), *_quality(term, evidence))
    details = [meanings_table(result), diagnostics_table("Diagnostics of the fit", result)]
    estimates = estimates_table("Fitted", result)
    shown_tables = _numbers(term, evidence)
    if len(estimates.rows) > _LONGEST_LIST:
        details.append(estimates)
    elif estimates.rows:
        shown_tables = (estimates, *shown_tables)
    if more_orders(result):
        details.append(candidates_table("All orders tried", result))
    if result.outliers:
        details.append(outliers_table("Outliers", result))
    return TermSection(
        term=term,
        heading=term.capitalize(),
        explanation=_EXPLANATIONS[term],
        status=result.status,
        finding=_finding(term, evidence),
        illustrations=shown,
        tables=shown_tables,
        details=tuple(details) if result.samples else (),
        notes=tuple(filter(None, (*result.notes, captures_sentence(result)))),
    )


def _numbers(term: TermName, evidence: Evidence) -> tuple[Table, ...]:
    """Return the tables of accuracy and orders."""
    result, accuracy = evidence.calibration.result(term), evidence.accuracy(term)
    tables = () if accuracy is None else (accuracy_table(accuracy),)
    return (*tables, orders_table(result)) if result.candidates else tables


def _finding(term: TermName, evidence: Evidence) -> str:
    """Return the most important number: the error where the truth is known, else the sigma."""
    result, accuracy = evidence.calibration.result(term), evidence.accuracy(term)
    distances = [row for row in evidence.rows if row.term == term and row.fitted is None]
    if distances:
        worst = distances[0]
        return f"{worst.quantity[0].upper()}{worst.quantity[1:]}: {worst.error:.2g} {worst.unit}."
    if not result.estimates:
        return "Nothing was fitted."
    if accuracy is not None and term != "noise":
        told = accuracy.forecast.quantity
        return f"{told.meaning[0].upper()}{told.meaning[1:]}: sigma {accuracy.sigma:.2g} {told.unit}."
    first = result.estimates[0]
    unit = "" if first.unit == "1" else f" {first.unit}"
    name = quantity(term, first.name).plain
    return f"{name[0].upper()}{name[1:]}: {number(first.value, first.sigma)} ± {spread(first.sigma)}{unit}."


def _illustrations(term: TermName, evidence: Evidence) -> tuple[Illustration, ...]:
    draw = {"noise": _noise, "geometry": _geometry, "wire": _wire, "psf": _psf, "backscatter": _backscatter}
    return draw[term](evidence)


def _quality(term: TermName, evidence: Evidence) -> tuple[Illustration, ...]:
    """Return the pictures of the residuals and of the effect of more captures."""
    drawn: list[Illustration] = []
    camera, sample = evidence.calibration.rig.camera, evidence.calibration.result(term).residuals
    if sample is not None and len(sample.z):
        cells, histogram = residual_map(sample, camera.columns, camera.rows), residual_histogram(sample)
        caption = (
            "Residuals of the fit. Left: a model that fits leaves no large patches of one colour (grey: no data). "
            "Right: bars that follow the line are noise alone; a wider histogram shows a model error."
        )
        drawn += _illustration(fit_figures.residual_figure(cells, histogram), caption, f"residuals of {term}")
    accuracy = evidence.accuracy(term)
    if accuracy is not None and accuracy.forecast.curves:
        figure = fit_figures.forecast_figure(accuracy.forecast)
        drawn += _illustration(figure, forecast_sentence(accuracy.forecast), f"accuracy of {term} against captures")
    return tuple(drawn)


def _illustration(figure: Figure, caption: str, alt: str) -> tuple[Illustration, ...]:
    return (Illustration(figures.embedded_png(figure), caption, alt),)


def _noise(evidence: Evidence) -> tuple[Illustration, ...]:
    if evidence.transfer is None:
        return ()
    caption = "Pairs of flats at rising exposure. The points should follow the line until they clip (dotted)."
    return _illustration(figures.photon_transfer_figure(evidence.transfer), caption, "photon transfer")


def _geometry(evidence: Evidence) -> tuple[Illustration, ...]:
    if evidence.boards is None:
        return ()
    camera = evidence.calibration.rig.camera
    caption = (
        f"Left: corners of {evidence.boards.views} views; they should reach into every corner of the sensor. "
        "Right: their residuals; they should be round and centred."
    )
    figure = figures.board_figure(evidence.boards, camera.columns, camera.rows)
    return _illustration(figure, caption, "board coverage and residuals")


def _wire(evidence: Evidence) -> tuple[Illustration, ...]:
    caption = (
        "The ripple in the map by which the picture is divided (shown without the lens's shading). "
        "A difference from the truth should show no stripes and no trend."
    )
    return _illustration(figures.wire_figure(evidence.fitted, evidence.true), caption, "wire map")


def _psf(evidence: Evidence) -> tuple[Illustration, ...]:
    sigma = stated_by(evidence.calibration.psf)
    told = "" if sigma is None else " σ is one standard deviation of each sample, on the same scale."
    caption = (
        f"A point of light at places between the captured ones; brightness is logarithmic over five decades.{told}"
    )
    figure = figures.psf_figure(evidence.fitted, evidence.true, sigma)
    return _illustration(figure, caption, "point-spread functions")


def _backscatter(evidence: Evidence) -> tuple[Illustration, ...]:
    caption = (
        "The part of the panel in front of the lens with a picture that was not captured, and the light that it sends "
        "back into the camera (one site of the pattern)."
    )
    return _illustration(figures.backscatter_figure(evidence.fitted, evidence.true), caption, "backscatter")
