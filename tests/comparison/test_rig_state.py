"""The rig as all terms find it: against the truth, with its sigmas, and with terms that contradict or say nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.comparison.perturbed import at_roll, drawn, moved, with_estimates, with_result
from udccal.comparison.combining import combine
from udccal.comparison.rig_state import NAMES, RigState, rig_state
from udccal.errors import ProfileError
from udccal.profiles.profile import Profile
from udccal.result import Estimate, EstimatePrior
from udccal.sessions.schema import TermName
from udccal.simulation.truth import draw_truth


def number(state: RigState, name: str) -> Estimate:
    return state.estimates[NAMES.index(name)]


def silent(profile: Profile, *terms: TermName) -> Profile:
    for term in terms:
        profile = with_result(profile, term, estimates=(), cov=np.zeros((0, 0)))
    return profile


def test_the_state_is_that_of_the_simulated_rig(measured: Profile) -> None:
    state, truth = rig_state(measured), draw_truth(measured.rig, 0)
    true = {
        "standoff_mm": -float(truth.optics.pupil_mm[2]),
        "pitch_mm": truth.panel.pitch_mm,
        "row_open": truth.panel.row_open,
        "column_open": truth.panel.column_open,
        "depth_mm": truth.panel.depth_mm,
        "pupil_diameter_mm": truth.optics.pupil_diameter_mm,
    }
    for name, value in true.items():
        assert abs(number(state, name).value - value) < 3 * number(state, name).sigma, name
    assert (state.terms, state.agreement_dof) == (("geometry", "wire", "psf", "backscatter"), 8)
    assert state.agreement_p_value > 0.01
    assert [one.name for one in state.estimates if one.by_prior] == ["pitch_mm"]
    np.testing.assert_allclose(np.sqrt(np.diag(state.cov)), [one.sigma for one in state.estimates])


def test_terms_together_know_more_than_each(measured: Profile) -> None:
    state = rig_state(measured)
    for term, name in (("geometry", "tilt_deg"), ("wire", "row_open"), ("psf", "row_open")):
        assert number(state, name).sigma <= measured.result(term).estimate(name).sigma * 1.01, name  # type: ignore[arg-type]
    # All lengths have the pitch's error in common, which the rig file alone limits.
    lengths = [NAMES.index(name) for name in ("standoff_mm", "pitch_mm", "pupil_diameter_mm")]
    sigma = np.sqrt(np.diag(state.cov))
    correlation = (state.cov / np.outer(sigma, sigma))[np.ix_(lengths, lengths)]
    assert correlation.min() > 0.95


def test_a_movement_shows_in_the_state(measured: Profile) -> None:
    before, after = (rig_state(one) for one in (measured, moved(measured, (0.0, 0.63, -0.2), (0.1, 0.0, 0.0))))
    change = {name: number(after, name).value - number(before, name).value for name in NAMES}
    assert change["standoff_mm"] == pytest.approx(0.2, rel=0.02)  # the rig file pulls a little
    assert change["panel_y_px"] == pytest.approx(1.0, abs=1e-3)
    assert change["tilt_deg"] == pytest.approx(0.1, abs=1e-3)
    # The pupil's shadow becomes smaller with distance, which ``moved`` leaves out.
    assert after.agreement_chi2 == pytest.approx(before.agreement_chi2, abs=2.0)


@pytest.mark.parametrize(
    ("term", "name", "sigmas"),
    [
        ("wire", "standoff_per_pitch", 2000),
        ("backscatter", "standoff_mm", 20),
        ("psf", "row_open", 20),
        ("geometry", "tilt_deg", 20),
    ],
)
def test_a_term_that_contradicts_the_others_is_noticed(
    measured: Profile, term: TermName, name: str, sigmas: float
) -> None:
    off = with_estimates(measured, term, {name: sigmas * measured.result(term).estimate(name).sigma})
    assert rig_state(off).agreement_p_value < 1e-6


def test_openings_that_are_no_rectangles_are_those_of_the_psf(measured: Profile) -> None:
    psf, sigma = measured.psf, measured.wire.estimate("row_open").sigma
    radius = replace(psf.estimates[-1], name="corner_radius", value=0.1, sigma=0.01)
    cov = np.pad(psf.cov, (0, 1))
    cov[-1, -1] = 1e-4
    rounded = with_result(measured, "psf", estimates=(*psf.estimates, radius), cov=cov)
    states = [rig_state(one) for one in (rounded, with_estimates(rounded, "wire", {"row_open": 50 * sigma}))]
    assert [state.agreement_dof for state in states] == [8 - 3, 8 - 3]
    assert states[0].agreement_chi2 == pytest.approx(states[1].agreement_chi2)
    assert number(states[1], "row_open").value == pytest.approx(number(states[0], "row_open").value)
    assert number(states[0], "row_open").value == pytest.approx(psf.estimate("row_open").value, abs=0.01)


def test_the_width_of_backscatters_footprint_says_nothing_of_the_pupil(measured: Profile) -> None:
    before, sigma = rig_state(measured), measured.backscatter.estimate("pupil_diameter_mm").sigma
    after = rig_state(with_estimates(measured, "backscatter", {"pupil_diameter_mm": 20 * sigma}))
    for name in NAMES:
        assert abs(number(after, name).value - number(before, name).value) < 0.1 * number(before, name).sigma, name


def test_agreement_of_draws_follows_its_degrees_of_freedom(measured: Profile) -> None:
    rng, terms = np.random.default_rng(5), ("wire", "psf", "backscatter")
    states = [rig_state(drawn(silent(measured, "geometry"), rng, terms)) for _ in range(160)]  # type: ignore[arg-type]
    spread = np.std([[one.value for one in state.estimates] for state in states], axis=0)
    told = [NAMES.index(name) for name in ("panel_x_px", "row_open", "column_open", "tilt_deg")]
    stated = np.array([states[0].estimates[i].sigma for i in told])
    np.testing.assert_allclose(spread[told] / stated, 1.0, atol=0.25)


def test_without_terms_the_rig_file_is_left(measured: Profile) -> None:
    state = rig_state(silent(measured, "geometry", "wire", "psf", "backscatter"))
    assert (state.terms, state.agreement_dof, state.agreement_p_value) == ((), 0, 1.0)
    for one in state.estimates:
        assert one.prior is not None
        assert (one.value, one.sigma) == pytest.approx((one.prior.value, one.prior.sigma), rel=1e-2), one.name
        assert one.by_prior


def test_an_estimate_that_repeats_the_rig_file_does_not_count_twice(measured: Profile) -> None:
    wide = with_result(silent(measured, "wire", "geometry", "backscatter"), "psf", estimates=tuple(
        Estimate(one.name, 0.5, 0.02, one.unit, EstimatePrior(0.4, 0.02)) if one.name == "row_open" else one
        for one in measured.psf.estimates
    ))  # fmt: skip
    assert number(rig_state(wide), "row_open").value == pytest.approx(0.4)


def test_hostile_numbers_are_refused_or_combined(measured: Profile) -> None:
    rng, refusals = np.random.default_rng(11), 0
    hostile = [0.0, -1.0, 5e-324, 1e-300, -1e-300, 1e9, -1e9, 1e150, 1e300, -1e300, 2.0**63]
    for _ in range(60):
        term = ("geometry", "wire", "psf", "backscatter")[rng.integers(4)]
        result = measured.result(term)
        cov, at = result.cov.copy(), rng.integers(len(result.cov), size=2)
        cov[at[0], at[1]] = cov[at[1], at[0]] = hostile[rng.integers(len(hostile))]
        numbers = {result.estimates[at[0]].name: hostile[rng.integers(len(hostile))] if rng.random() < 0.3 else 0.0}
        try:
            state = rig_state(with_result(with_estimates(measured, term, numbers), term, cov=cov))  # type: ignore[arg-type]
        except ProfileError:
            refusals += 1
            continue
        assert np.isfinite(
            [state.agreement_chi2, *(number for e in state.estimates for number in (e.value, e.sigma))]
        ).all()
    assert 10 < refusals < 60


def test_combining_is_a_weighted_mean_and_knows_what_it_does_not_know() -> None:
    found = combine(np.array([[1.0, 0.0], [1.0, 0.0]]), np.array([1.0, 2.0]), np.diag([1.0, 0.25]))
    assert found.values[0] == pytest.approx(1.8)
    assert found.cov[0, 0] == pytest.approx(0.2)
    assert (found.chi2, found.dof) == (pytest.approx(0.8), 1)
    assert (found.known.tolist(), bool(np.isnan(found.values[1]))) == ([True, False], True)


def test_terms_agree_on_a_camera_that_stands_on_its_head(measured: Profile) -> None:
    """One term may say 180 degrees and another -180: they are one angle."""
    mounting = measured.rig.mounting
    mounting = mounting.model_copy(update={"roll_deg": mounting.roll_deg.model_copy(update={"value": 180.0})})
    rig = measured.rig.model_copy(update={"mounting": mounting})
    upright = rig_state(measured)
    for roll in (179.9995, -179.9995):
        state = rig_state(replace(at_roll(measured, roll), rig=rig))
        assert abs(number(state, "roll_deg").value - 180.0) < 0.01
        assert state.agreement_dof == upright.agreement_dof
        assert state.agreement_p_value > 0.01


def test_sigmas_of_any_size_have_a_decider() -> None:
    known = Estimate("fx", 1.0, 1e200, "px", EstimatePrior(1.0, 1e200))
    assert known.by_prior
    assert not replace(known, sigma=1e199).by_prior
