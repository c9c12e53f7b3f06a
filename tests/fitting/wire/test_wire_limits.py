"""The wire fit on flats of its own model: at the bound, of the right order, and never without a finite answer."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import equinox as eqx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.scenes.unchecked import checked_with
from tests.scenes.wire import (
    COLUMNS,
    PRNU,
    ROWS,
    Flat,
    constant,
    drawn_truth,
    fitted,
    geometry,
    map_at,
    map_sigma,
    noisy,
    places,
    shape_values,
    start,
)
from udccal.errors import FitError
from udccal.fitting.engine.least_squares import LOG
from udccal.fitting.wire import search
from udccal.fitting.wire.data import WireData
from udccal.fitting.wire.fit import fit_wire, unusable_flat
from udccal.fitting.wire.parameters import WireRules, wire_start
from udccal.fitting.wire.search import scan_rows
from udccal.models.wire import Wire, wire_map
from udccal.result import FitResult, FitStatus

# Baseline up to degree 4, three site gains.
_PLAIN = 18


def columns_kept(result: FitResult[Wire]) -> int:
    return int(next(d.value for d in result.diagnostics if d.name == "parameters"))


@pytest.mark.medium
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_scan_that_missed_the_pupil_by_some_periods_leads_to_it(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pupil a period larger, with the origin half a period on, looks nearly the same in the first harmonic."""
    flat = noisy(drawn_truth(seed, start(), geometry()), 1)
    pupil = float(flat.truth.footprint_per_pitch)

    def missed(*arguments: Any) -> tuple[list[Wire], float]:
        found, gain = scan_rows(*arguments)
        return [one for one in found if abs(float(one.footprint_per_pitch) - pupil) > 1.5], gain

    monkeypatch.setattr(search, "scan_rows", missed)
    result = fitted(flat, start(), geometry()).or_raise()
    off = np.array([e.value for e in result.numbers]) - shape_values(flat.truth)
    off[4:6] -= np.round(off[4:6])
    assert np.all(np.abs(off) < 4.5 * np.array([e.sigma for e in result.numbers]))


@pytest.mark.slow
def test_map_and_shape_are_within_their_errors_from_a_start_that_is_a_fifth_off() -> None:
    built = start()
    flat = noisy(drawn_truth(1, built, geometry()), 1)
    wrong = replace(
        built, standoff_per_pitch=0.8 * built.standoff_per_pitch, footprint_per_pitch=1.2 * built.footprint_per_pitch
    )
    fit = fitted(flat, wrong, geometry())
    result = fit.or_raise()
    off = np.array([e.value for e in result.numbers]) - shape_values(flat.truth)
    off[4:6] -= np.round(off[4:6])
    assert np.all(np.abs(off) < 4 * np.array([e.sigma for e in result.numbers]))
    error = map_at(result.term, places()) - map_at(flat.truth, places())
    assert np.all(np.abs(error) < 4.5 * map_sigma(fit, places()))
    assert columns_kept(result) == _PLAIN
    # A start so far beyond its tolerance is doubted in words.
    assert any("standoff_per_pitch" in note for note in result.notes)


@pytest.mark.medium
@pytest.mark.parametrize(("seed", "sharpness"), [(22, 0.0), (21, 1.0)])
def test_openings_without_sharp_edges_are_found_and_told(seed: int, sharpness: float) -> None:
    truth = drawn_truth(seed, start(), geometry(), sharpness=sharpness)
    result = fitted(noisy(truth, seed), start(), geometry())
    assert result.status is FitStatus.CONVERGED
    sigmas = np.array([e.sigma for e in result.numbers])
    begun = shape_values(drawn_truth(seed, start(), geometry(), sharpness=sharpness))[3] - start().standoff_per_pitch
    assert abs(begun) > 10 * sigmas[3]
    off = np.array([e.value for e in result.numbers]) - shape_values(truth)
    off[4:6] -= np.round(off[4:6])
    assert np.all(np.abs(off) < 4.5 * sigmas)
    error = map_at(result.term, places()) - map_at(truth, places())
    assert np.all(np.abs(error) < 4.5 * map_sigma(result, places()))
    assert any("row_open and column_open" in note for note in result.notes) == (sharpness == 0.0)


@pytest.mark.medium
def test_a_fit_goes_on_from_an_earlier_wire_without_a_search(caplog: pytest.LogCaptureFixture) -> None:
    flat = noisy(drawn_truth(1, start(), geometry()), 1)
    data = WireData(flat.signal, flat.variance, geometry(), start(), PRNU)
    rules = WireRules(samples=flat.signal.size)
    first = fit_wire(data, rules)
    with caplog.at_level(logging.DEBUG, logger=LOG.name):
        again = fit_wire(data, rules, first.term)
    assert {line.split(":")[0] for line in caplog.messages} == {"wire, resumed", "wire, joint"}
    assert again.status is FitStatus.CONVERGED
    moved = map_at(again.term, places()) - map_at(first.term, places())
    assert np.all(np.abs(moved) < 0.2 * map_sigma(first, places()))
    # A wire of another rig is no start: the search begins anew.
    other = replace(first.term, harmonics=np.asarray(first.term.harmonics)[::-1])
    assert fit_wire(data, rules, other).status is FitStatus.CONVERGED


@pytest.mark.medium
def test_no_modulation_is_absent_and_costs_nothing() -> None:
    flat = noisy(drawn_truth(2, start(), geometry(), modulated=False), 2)
    fit = fitted(flat, start(), geometry())
    assert fit.status is FitStatus.ABSENT
    assert np.shape(fit.term.harmonics) == (0, 2)
    error = map_at(fit.term, places()) - map_at(flat.truth, places())
    assert np.all(np.abs(error) < 4.5 * map_sigma(fit, places()))
    assert float(np.max(map_sigma(fit, places()))) < 0.002
    assert "too noisy" not in " ".join(fit.notes)


@pytest.mark.parametrize("electrons", [24.0, 100.0])
@pytest.mark.medium
def test_rows_that_noise_may_hide_are_in_the_error_bars(electrons: float) -> None:
    flat = noisy(drawn_truth(854, start(), geometry()), 854, electrons, 0.0)
    fit = fitted(flat, start(), geometry(), 0.0)
    assert fit.status is FitStatus.ABSENT
    assert "too noisy to tell" in " ".join(fit.notes)
    z = (map_at(fit.term, places()) - map_at(flat.truth, places())) / map_sigma(fit, places())
    assert np.abs(z).max() < 3.5
    assert np.std(z) > 0.2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"signal": [[1.0]]}, "the signal as an array .* found list"),
        ({"signal": None}, "found NoneType"),
        ({"signal": np.ones(100)}, r"of shape \(100,\)"),
        ({"variance": np.ones((1, ROWS, COLUMNS))}, "the variance as an array"),
        ({"variance": np.ones((ROWS, COLUMNS)).astype(str)}, "real numbers"),
        ({"variance": np.ones((COLUMNS, ROWS))}, f"numbers, {ROWS} x {COLUMNS}, found"),
        ({"signal": np.ones((ROWS - 1, COLUMNS))}, f"the variance as an array of real numbers, {ROWS - 1} x"),
        ({"variance": np.full((ROWS, COLUMNS), np.nan)}, "variances of 0 or more"),
        ({"variance": np.full((ROWS, COLUMNS), -1.0)}, "variances of 0 or more"),
        ({"PRNU1288": np.nan}, "PRNU1288 from 0 to 1, found nan"),
        ({"PRNU1288": -0.1}, "PRNU1288 from 0 to 1"),
        ({"clipped": np.inf}, "part of clipped pixels"),
        ({"clip": np.nan}, "a signal from which frames clip from -inf to inf, found nan"),
        ({"clip": None}, "a signal from which frames clip .* found NoneType"),
        ({"geometry": None}, "Expected a Geometry, found NoneType"),
        ({"start": "a"}, "Expected a WireStart, found 'a'"),
        ({"cfa": ["RGGB"]}, "Expected one of the patterns"),
        ({"cfa": "WXYZ"}, "found 'WXYZ'"),
    ],
)
def test_what_is_no_flat_is_refused(change: dict[str, Any], words: str) -> None:
    plain = np.ones((ROWS, COLUMNS))
    with pytest.raises(FitError, match=words):
        checked_with(WireData(plain, plain, geometry(), start(), PRNU), change)


@pytest.mark.usefixtures("as_other_programs_call")
def test_what_is_no_rule_start_or_rig_is_refused() -> None:
    plain = np.ones((ROWS, COLUMNS))
    data = WireData(plain, plain, geometry(), start(), PRNU)
    with pytest.raises(FitError, match="Expected a WireRules, found dict"):
        fit_wire(data, {})  # type: ignore[arg-type]
    with pytest.raises(FitError, match="Expected a Wire, found 'a'"):
        fit_wire(data, start="a")  # type: ignore[arg-type]
    with pytest.raises(FitError, match="Expected a RigDescription, found NoneType"):
        wire_start(None)  # type: ignore[arg-type]


@pytest.mark.parametrize("side", [0, 1, 60])
def test_a_flat_of_few_pixels_is_too_few_data(side: int) -> None:
    """Sites without any pixel were told to be clipped."""
    few = np.ones((side, side))
    told = FitStatus.TOO_FEW_DATA, f"There are {side**2} pixels; use a larger region of the sensor."
    assert unusable_flat(WireData(few, few, geometry(), start(), PRNU), WireRules()) == told


@pytest.mark.medium
def test_saturated_flat_says_what_to_do() -> None:
    signal = np.full((ROWS, COLUMNS), 4095.0)
    flat = Flat(drawn_truth(0, start(), geometry()), signal, signal)
    result = fitted(flat, start(), geometry(), clip=4000.0)
    assert result.status is FitStatus.SATURATED
    assert "shorter" in " ".join(result.notes)


@pytest.mark.medium
def test_clipped_light_is_no_misfit_of_the_pixels_held_out() -> None:
    """The mean of what is not clipped is not the map's, which is 1: residuals must not show the difference."""
    flat = noisy(drawn_truth(1, start(), geometry()), 1)
    clip = float(np.quantile(flat.signal, 0.9))
    data = WireData(np.minimum(flat.signal, clip), flat.variance, geometry(), start(), PRNU, clip)
    result = fit_wire(data, WireRules(samples=flat.signal.size // 3)).or_raise()
    assert next(d.value for d in result.diagnostics if d.name == "residual_pattern_p_value") > 1e-3
    error = map_at(result.term, places()) - map_at(flat.truth, places())
    assert np.all(np.abs(error) < 4.5 * map_sigma(result, places()))


def finite_or_told(seed: int, electrons: float, prnu: float, broken: float, level: float) -> None:
    flat = noisy(drawn_truth(seed, start(), geometry()), seed, electrons, prnu)
    signal = flat.signal + level
    rng = np.random.default_rng(seed)
    signal[rng.random(signal.shape) < broken] = rng.choice([np.nan, np.inf, -1e9, 0.0, 1e9])
    fit = fitted(replace(flat, signal=signal), start(), geometry(), prnu)
    numbers = [np.asarray(e) for e in (fit.cov, [e.value for e in fit.estimates])]
    assert all(np.isfinite(part).all() for part in numbers)
    assert np.isfinite(map_at(fit.term, places())).all()
    if fit.ok and not level:
        error = map_at(fit.term, places()) - map_at(flat.truth, places())
        assert np.all(np.abs(error) < 5 * map_sigma(fit, places()))
    if not fit.ok:
        assert fit.notes


_INPUTS = {
    "seed": st.integers(0, 1000),
    "electrons": st.floats(0.3, 1e6),
    "prnu": st.floats(0.0, 0.03),
    "broken": st.sampled_from([0.0, 1e-4, 1e-2]),
    "level": st.sampled_from([0.0, 0.0, -1e3]),
}


@pytest.mark.medium
def test_a_flat_below_black_is_told() -> None:
    """One pixel in a hundred that is stuck at a large number lifts the mean above zero."""
    finite_or_told(seed=0, electrons=1.0, prnu=0.0, broken=0.01, level=-1e3)


@pytest.mark.medium
def test_one_pixel_stuck_high_does_not_make_a_dark_flat_bright() -> None:
    finite_or_told(seed=1, electrons=2.0, prnu=0.0, broken=1e-4, level=0.0)


@pytest.mark.slow
@settings(max_examples=3)
@given(**_INPUTS)
def test_any_flat_is_finite_and_within_its_errors_or_told(
    seed: int, electrons: float, prnu: float, broken: float, level: float
) -> None:
    finite_or_told(seed, electrons, prnu, broken, level)


@pytest.mark.slow
@settings(max_examples=60)
@given(**_INPUTS)
def test_many_flats_are_finite_and_within_their_errors_or_told(
    seed: int, electrons: float, prnu: float, broken: float, level: float
) -> None:
    finite_or_told(seed, electrons, prnu, broken, level)


@pytest.mark.slow
def test_the_right_order_is_chosen() -> None:
    """A shading of degree 6 and a first harmonic that leans over the field, both at ten times what BIC asks for."""
    right = 0
    for seed in range(100):
        truth = drawn_truth(seed, start(), geometry())
        baseline = np.array(truth.baseline)
        leaning = seed % 2 == 0
        if leaning:
            baseline[[0, 3, 6], [6, 3, 0]] += 1.5e-3
        truth = eqx.tree_at(lambda w, b=baseline: w.baseline, truth, baseline)
        result = fitted(noisy(truth, seed), start(), geometry())
        right += columns_kept(result) == _PLAIN + (7 if leaning else 0)
    assert right >= 95


@pytest.mark.slow
@pytest.mark.timeout(3600)  # two hundred fits
def test_absent_and_present_are_told_apart() -> None:
    """Present: the first harmonic explains 200 of chi-squared, twice what is asked for."""
    told = 0
    for seed in range(200):
        present = seed % 2 == 0
        # Fewer electrons: the harmonic explains less.
        flat = noisy(drawn_truth(seed, start(), geometry(), modulated=present), seed, 3e3)
        status = fitted(flat, start(), geometry()).status
        told += status is (FitStatus.CONVERGED if present else FitStatus.ABSENT)
    assert told >= 190


@pytest.mark.medium
def test_a_flat_without_any_noise_or_ripple_is_absent() -> None:
    found = constant(1000.0)
    assert found.status is FitStatus.ABSENT
    assert np.isfinite(wire_map(found.term, ROWS, COLUMNS)).all()
