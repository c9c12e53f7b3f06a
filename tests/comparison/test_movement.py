"""The camera's movement: found from all terms, with its sigma, and refused no term's silence."""

from __future__ import annotations

import numpy as np
import pytest

from tests.comparison.perturbed import drawn, moved, with_estimates, with_result
from udccal.comparison.estimates import difference
from udccal.comparison.held import held_estimates
from udccal.comparison.limits import DiffLimits
from udccal.comparison.movement import Movement, movement
from udccal.profiles.profile import Profile

PITCH_MM = 0.63


def movement_of(a: Profile, b: Profile) -> Movement:
    return movement(difference(held_estimates(a), held_estimates(b)), PITCH_MM, DiffLimits())


def values(found: Movement) -> list[float | None]:
    return [part.value for part in found.parts]


def test_no_movement_is_zero(measured: Profile) -> None:
    found = movement_of(measured, measured)
    assert values(found) == [0.0] * 6
    assert (found.distance.value, found.angle.value, found.chi2, found.agreement_chi2) == (0.0, 0.0, 0.0, 0.0)
    assert found.distance.sigma is not None
    assert 1e-4 < found.distance.sigma < 1e-2


@pytest.mark.parametrize(
    ("by_mm", "angles"),
    [
        ((0.05, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((0.0, -0.02, 0.1), (0.2, 0.0, 0.0)),
        ((0.01, 0.3, -0.2), (-0.1, 0.3, 0.4)),
        ((1.3, -2.0, 0.0), (0.0, 0.0, 0.0)),  # two and three pitches
    ],
)
def test_a_movement_is_found(measured: Profile, by_mm, angles) -> None:  # type: ignore[no-untyped-def]
    found = movement_of(measured, moved(measured, by_mm, angles))
    np.testing.assert_allclose(values(found), [*by_mm, *angles], atol=2e-4)
    assert found.whole_pitches == tuple(np.round((np.array(by_mm[:2])) / PITCH_MM))
    assert found.agreement_p_value > 0.9
    assert found.p_value < 1e-6
    assert found.terms == ("geometry", "wire", "backscatter")


def test_there_and_back_are_opposite(measured: Profile) -> None:
    other = moved(measured, (0.05, 0.02, -0.1), (0.1, -0.2, 0.05))
    there, back = movement_of(measured, other), movement_of(other, measured)
    np.testing.assert_allclose(values(there), [-v for v in values(back) if v is not None], rtol=1e-4, atol=1e-7)


def test_five_micrometres_are_many_sigma(measured: Profile) -> None:
    found = movement_of(measured, moved(measured, (0.0, 0.005, 0.0), (0.0, 0.0, 0.0)))
    assert found.distance.value == pytest.approx(0.005, rel=0.02)
    assert found.p_value < 1e-6


def test_sigmas_are_those_of_draws(measured: Profile) -> None:
    """Of a geometry that tells the angles alone: the lens's share of the wire's pose is not drawn here."""
    rng, angles = np.random.default_rng(8), measured.geometry
    still = with_result(measured, "geometry", estimates=angles.estimates[9:], cov=angles.cov[9:, 9:])
    found = [
        movement_of(*(drawn(still, rng, ("geometry", "wire", "backscatter")) for _ in range(2))) for _ in range(100)
    ]
    z = np.array([[part.value / part.sigma for part in one.parts] for one in found])  # type: ignore[operator]
    np.testing.assert_allclose(z.std(axis=0), 1.0, atol=0.25)
    assert np.mean([one.agreement_chi2 for one in found]) == pytest.approx(found[0].agreement_dof, abs=1.0)
    assert np.mean([one.p_value < 0.05 for one in found]) < 0.1


def test_terms_that_disagree_are_told(measured: Profile) -> None:
    """The wire moved, the panel's light did not: no movement of the camera."""
    other = with_estimates(measured, "wire", {"offset_y_periods": 0.1})
    assert movement_of(measured, other).agreement_p_value < 1e-6


def test_without_backscatter_whole_pitches_are_not_told(measured: Profile) -> None:
    silent = with_result(measured, "backscatter", estimates=(), cov=np.zeros((0, 0)))
    found = movement_of(silent, moved(measured, (PITCH_MM + 0.01, 0.0, 0.0), (0.0, 0.0, 0.0)))
    assert found.whole_pitches is None
    assert found.parts[0].value == pytest.approx(0.01, abs=1e-4)


def test_geometry_alone_tells_angles_only(measured: Profile) -> None:
    silent = measured
    for term in ("wire", "backscatter"):
        silent = with_result(silent, term, estimates=(), cov=np.zeros((0, 0)))  # type: ignore[arg-type]
    found = movement_of(silent, moved(measured, (0.1, 0.0, 0.0), (0.2, 0.0, 0.0)))
    assert values(found)[:3] == [None] * 3
    assert found.distance.value is None
    assert found.angle.value == pytest.approx(0.2, rel=1e-3)
    assert (found.dof, found.agreement_dof) == (3, 0)


def test_nothing_tells_nothing(measured: Profile) -> None:
    silent = measured
    for term in ("geometry", "wire", "backscatter"):
        silent = with_result(silent, term, estimates=(), cov=np.zeros((0, 0)))  # type: ignore[arg-type]
    found = movement_of(silent, measured)
    assert values(found) == [None] * 6
    assert (found.terms, found.p_value) == ((), 1.0)
