"""Accuracy of a term as a technician reads it: figures, tables and sentences, by hand-made forecasts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from udccal.fitting.nominal import nominal_geometry
from udccal.planning.design import DESIGN_VARIABLES
from udccal.planning.forecast import QUANTITIES, Curve, Forecast, Limits
from udccal.reports.accuracy import Accuracy, accuracy_table, forecast_sentence, stated
from udccal.reports.fit_figures import forecast_figure
from udccal.reports.fit_tables import MOST_ORDERS, more_orders, orders_table
from udccal.result import Candidate, Diagnostic, Estimate, FitResult, FitStatus
from udccal.rig import load_rig


def _forecast(floor: float = 0.05, gain: float = 0.5) -> Forecast:
    """Sigma falls as counts to the power of -gain, from 0.1 % at 100 flats, towards a floor."""
    counts = np.array([25.0, 50.0, 100.0, 200.0, 400.0])
    sigma = 0.1 * (counts / 100) ** -gain
    curve = Curve(DESIGN_VARIABLES["wire"][0], 100, counts, sigma)
    return Forecast("wire", QUANTITIES["wire"], 0.1, Limits(floor, "More pixels would lower it.", 0.33), (curve,), ())


def _result(*candidates: Candidate) -> FitResult[None]:
    estimates = (Estimate("K_DN_per_e", 0.5, 0.001, "DN/e"),)
    made = (Diagnostic("wire_map_rms_sigma", 0.2, "%"),)
    return FitResult("noise", None, FitStatus.CONVERGED, estimates, np.eye(1), 1.0, 9, candidates, made)


def _cells(accuracy: Accuracy) -> dict[str, str]:
    return dict(accuracy_table(accuracy).rows)


def test_the_curve_is_drawn_with_what_was_captured() -> None:
    pictures = []
    for ahead in (_forecast(), _forecast(gain=1.5)):
        canvas = FigureCanvasAgg(forecast_figure(ahead))
        canvas.draw()
        pictures.append(np.asarray(canvas.buffer_rgba())[..., :3].astype(int))
    red = (np.abs(pictures[0] - [192, 57, 43]).sum(axis=-1) < 30).sum()
    assert red > 20
    assert np.abs(pictures[0] - pictures[1]).mean() > 0.5


def test_every_number_of_the_captures_has_its_panel() -> None:
    one = _forecast().curves[0]
    figure = forecast_figure(replace(_forecast(), curves=(one, replace(one, variable=DESIGN_VARIABLES["psf"][2]))))
    assert [axes.get_xlabel() for axes in figure.axes] == ["flats", "shifts at each position"]
    assert figure.axes[0].get_ylim() == figure.axes[1].get_ylim()


def test_the_sentence_names_what_helps_most() -> None:
    weak = replace(
        _forecast().curves[0], variable=DESIGN_VARIABLES["psf"][2], sigma=np.array([0.102, 0.101, 0.1, 0.099, 0.098])
    )
    said = forecast_sentence(replace(_forecast(), curves=(weak, _forecast().curves[0]), idle=("frames of a stack",)))
    assert "More flats, 400 instead of 100, lower sigma most: 0.05 % instead of 0.1 %" in said
    assert "does not depend on frames of a stack" in said


def test_where_nothing_helps_the_floor_is_explained() -> None:
    said = forecast_sentence(_forecast(floor=0.0995, gain=0.001))
    assert "hardly lower sigma" in said
    assert "More pixels would lower it." in said
    assert "More pixels" not in forecast_sentence(_forecast(floor=0.001))


def test_what_a_fit_wastes_is_the_unused_part() -> None:
    cells = _cells(Accuracy(_forecast(), None, 0.25))
    assert cells["unused part of the information"] == "75 %"
    assert "sigma of the fit" not in cells
    twice = _cells(Accuracy(_forecast(), 0.2, 1.0))
    assert twice["sigma of the fit"] == "0.2 %"
    assert twice["unused part of the information"] == "75 %"
    # A fit's sigma below the forecast is within the forecast's accuracy, and adds no information.
    assert _cells(Accuracy(_forecast(), 0.09, 1.0))["unused part of the information"] == "0 %"


def test_a_forecast_is_said_to_be_accurate_only_where_that_was_checked() -> None:
    assert "forecast for the captured frames (within 15 %)" in _cells(Accuracy(_forecast(), None, 1.0))
    assert "forecast for the captured frames" in _cells(Accuracy(_forecast(), None, 1.0, full=False))


def test_what_fits_state_is_in_the_unit_of_the_target() -> None:
    rig = load_rig("lg55-reduced")
    assert stated("noise", _result(), rig) == pytest.approx(0.2)
    assert stated("wire", _result(), rig) == pytest.approx(0.2)
    assert stated("wire", replace(_result(), diagnostics=()), rig) is None
    assert stated("psf", _result(), rig) is None
    failed = replace(_result(), term=nominal_geometry(rig), cov=np.zeros((0, 0)))
    assert stated("geometry", failed, rig) is None


def test_one_choice_is_shown_best_first_with_distances() -> None:
    tried = [Candidate(f"order {k}", k, 100.0 + (k - 3) ** 2, k == 3) for k in range(12)]
    table = orders_table(_result(*tried))
    assert table.rows[0] == ("order 3", "3", "+0", "chosen")
    assert [row[2] for row in table.rows] == ["+0", "+1", "+1", "+4", "+4", "+9"]
    assert len(table.rows) == MOST_ORDERS
    assert more_orders(_result(*tried))


def test_a_choice_that_is_not_the_best_is_shown_all_the_same() -> None:
    tried = [Candidate(f"order {k}", k, float(k), k == 11) for k in range(12)]
    assert orders_table(_result(*tried)).rows[-1] == ("order 11", "11", "+11", "chosen")


def test_several_choices_stay_in_their_order() -> None:
    tried = [Candidate("without a", 0, 7.0, False), Candidate("with a", 1, 0.0, True), Candidate("b", 1, 3.0, True)]
    table = orders_table(_result(*tried))
    assert [row[0] for row in table.rows] == ["without a", "with a", "b"]
    assert not more_orders(_result(*tried))


def test_of_many_choices_those_made_are_shown_and_the_others_under_the_fit_itself() -> None:
    tried = [Candidate(f"{axis} within {k}", k, float(k), k == 4) for axis in ("rows", "columns") for k in range(9)]
    table = orders_table(_result(*tried))
    assert [row[0] for row in table.rows] == ["rows within 4", "columns within 4"]
    assert more_orders(_result(*tried))
