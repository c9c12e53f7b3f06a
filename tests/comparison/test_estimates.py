"""Chi-squared of two profiles' estimates: its size, its distribution, and the covariances that are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from tests.comparison.perturbed import at_roll, drawn, with_estimates, with_result
from udccal.comparison.estimates import ORDER, chi2_of, difference, not_covered
from udccal.comparison.held import held_estimates
from udccal.comparison.limits import DiffLimits
from udccal.comparison.movement import movement
from udccal.errors import ProfileError
from udccal.profiles.profile import Profile
from udccal.result import Estimate
from udccal.sessions.schema import TermName


def test_a_profile_does_not_differ_from_itself(measured: Profile) -> None:
    held = held_estimates(measured)
    found = difference(held, held)
    kept = [[e for e in r.estimates[: len(r.cov)] if e in r.numbers and e.sigma > 0] for r in measured.results]
    assert [found.of(term).chi2() for term in ORDER] == [(0.0, len(some)) for some in kept]
    assert min(map(len, kept)) >= 6
    assert not found.values.any()


@pytest.mark.parametrize(("term", "name"), [("noise", "black_DN"), ("geometry", "k2"), ("psf", "row_open")])
def test_one_estimate_off_gives_its_part_of_chi2(measured: Profile, term: TermName, name: str) -> None:
    """By hand: d in one coordinate gives d² times that coordinate's element of the joint inverse."""
    result = measured.result(term)
    at = [one.name for one in result.estimates].index(name)
    keep = np.diag(result.cov) > 0
    inverse = np.linalg.inv(2 * result.cov[np.ix_(keep, keep)])
    step = 3.0 * result.estimates[at].sigma
    place = int(keep[:at].sum())
    other = with_estimates(measured, term, {name: step})
    found = difference(held_estimates(measured), held_estimates(other)).of(term)
    assert found.chi2()[0] == pytest.approx(step**2 * inverse[place, place], rel=1e-6)
    assert found.values[place] == pytest.approx(step, rel=1e-9)


def test_correlated_estimates_are_judged_jointly(measured: Profile) -> None:
    """Tilt and offset of the wire correlate by 1.00: together within a sigma each, they may be far off."""
    sigma = {one.name: one.sigma for one in measured.wire.estimates}
    apart = {"rotation_x_deg": sigma["rotation_x_deg"], "offset_y_periods": -sigma["offset_y_periods"]}
    together = {"rotation_x_deg": sigma["rotation_x_deg"], "offset_y_periods": sigma["offset_y_periods"]}
    held = held_estimates(measured)
    chi2 = [
        difference(held, held_estimates(with_estimates(measured, "wire", one))).of("wire").chi2()[0]
        for one in (apart, together)
    ]
    assert chi2[0] > 5 * chi2[1]


def test_places_on_the_panel_count_modulo_a_period(measured: Profile) -> None:
    other = with_estimates(measured, "wire", {"offset_x_periods": 0.999})
    found = difference(held_estimates(measured), held_estimates(other)).of("wire")
    assert found.values[[name for _, name in found.names].index("offset_x_periods")] == pytest.approx(-0.001, abs=1e-9)


@pytest.mark.medium
@pytest.mark.parametrize("term", ["noise", "geometry", "psf", "backscatter"])
def test_chi2_of_draws_follows_its_degrees_of_freedom(measured: Profile, term: TermName) -> None:
    rng, count, found = np.random.default_rng(3), 150, []
    for _ in range(count):
        pair = [
            with_result(drawn(measured, rng, (term,)), "wire", estimates=(), cov=np.zeros((0, 0))) for _ in range(2)
        ]
        one = difference(*map(held_estimates, pair)).of(term)
        found.append(one.chi2())
    values, (dof,) = np.array([chi2 for chi2, _ in found]), {dof for _, dof in found}
    assert abs(values.mean() - dof) < 4 * np.sqrt(2 * dof / count)
    assert 0.6 < values.var() / (2 * dof) < 1.6


def test_chi2_of_draws_with_too_small_a_covariance_is_noticed(measured: Profile) -> None:
    """The check above fails where sigmas are 20 % too small."""
    cov, rng = measured.psf.cov[:6, :6], np.random.default_rng(3)
    draws = rng.multivariate_normal(np.zeros(6), 2 * cov, size=300)
    values = np.array([chi2_of(one, 2 * 0.8**2 * cov)[0] for one in draws])
    assert abs(values.mean() - 6) > 4 * np.sqrt(2 * 6 / 300)


def test_what_has_no_covariance_is_told(measured: Profile) -> None:
    older = replace(measured.psf, cov=measured.psf.cov[:-1, :-1])
    assert not_covered(older, measured.psf) == ("kernel_relative_l2",)
    assert not_covered(measured.noise, measured.noise) == ("q_DN",)
    element = Estimate("fields.0.0.0.1", 0.5, 0.1, "1")
    with_field = replace(
        measured.wire, estimates=(*measured.wire.estimates, element), cov=block_diag(measured.wire.cov, 0.01)
    )
    assert not_covered(with_field, with_field) == ()
    names = held_estimates(replace(measured, wire=with_field)).names
    assert names == held_estimates(measured).names
    shorter = replace(
        measured.geometry, estimates=measured.geometry.estimates[:11], cov=measured.geometry.cov[:11, :11]
    )
    assert not_covered(shorter, measured.geometry) == ("yaw_deg",)


def _asymmetric(cov: np.ndarray) -> np.ndarray:
    changed = cov.copy()
    changed[0, 1] *= -1
    return changed


@pytest.mark.parametrize(
    "broken",
    [
        pytest.param(lambda cov: -cov, id="negative variances"),
        pytest.param(_asymmetric, id="asymmetric"),
        pytest.param(lambda cov: cov - 10 * np.diag(np.diag(cov))[::-1], id="not positive"),
        pytest.param(
            lambda cov: np.where(np.eye(12) > 0, cov, 5 * np.sqrt(np.outer(np.diag(cov), np.diag(cov)))), id="beyond 1"
        ),
        pytest.param(lambda cov: np.eye(40), id="more than there are estimates"),
        pytest.param(lambda cov: cov * np.nan, id="not numbers"),
    ],
)
def test_a_matrix_that_is_no_covariance_is_refused(measured: Profile, broken) -> None:  # type: ignore[no-untyped-def]
    other = with_result(measured, "geometry", cov=broken(measured.geometry.cov))
    with pytest.raises(ProfileError, match="Expected a covariance of the geometry estimates"):
        held_estimates(other)


def test_numbers_that_overflow_are_refused(measured: Profile) -> None:
    other = with_estimates(measured, "noise", {"black_DN": 1e300})
    with pytest.raises(ProfileError, match="finite numbers"):
        difference(held_estimates(measured), held_estimates(other))


def test_hostile_numbers_are_refused_or_compared(measured: Profile) -> None:
    rng, held, refusals = np.random.default_rng(11), held_estimates(measured), 0
    hostile = [0.0, -1.0, 5e-324, 1e-300, -1e-300, 1e9, -1e9, 1e150, 1e300, -1e300, 2.0**63]
    for _ in range(60):
        term = ORDER[rng.integers(len(ORDER))]
        result = measured.result(term)
        cov, at = result.cov.copy(), rng.integers(len(result.cov), size=2)
        cov[at[0], at[1]] = cov[at[1], at[0]] = hostile[rng.integers(len(hostile))]
        numbers = {result.estimates[at[0]].name: hostile[rng.integers(len(hostile))] if rng.random() < 0.3 else 0.0}
        try:
            found = difference(
                held, held_estimates(with_result(with_estimates(measured, term, numbers), term, cov=cov))
            )
            moved = movement(found, 0.63, DiffLimits())
        except ProfileError:
            refusals += 1
            continue
        assert all(np.isfinite(found.of(one).chi2()[0]) and found.of(one).chi2()[0] >= 0 for one in ORDER)
        assert np.isfinite([moved.chi2, moved.agreement_chi2]).all()
    assert 10 < refusals < 60


def test_half_a_turn_is_the_same_from_both_sides(measured: Profile) -> None:
    """180 and -180 degrees are one angle, in differences and in the derivatives behind a covariance."""
    a, b = (held_estimates(at_roll(measured, roll)) for roll in (179.999, -179.999))
    found = difference(a, b)
    for term in ("geometry", "wire"):
        roll = found.names.index((term, "roll_deg"))
        assert found.values[roll] == pytest.approx(0.002, abs=1e-6)
        assert found.sigma[roll] < 0.01
    beside = held_estimates(at_roll(measured, 179.9))
    np.testing.assert_allclose(np.diag(a.cov), np.diag(beside.cov), rtol=1e-2)
