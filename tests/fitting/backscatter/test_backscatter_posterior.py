"""Moments of the backscatter values over their posterior, and predictions of pictures that took no part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import expit

from tests.scenes.backscatter import PICTURES, RULES, panel_pictures, shots_of, small_rig, world
from udccal.fitting.backscatter.parameters import NAMES, REFLECTION, TWO_PLANES, MostProbable, most_probable, prior_of
from udccal.fitting.backscatter.posterior import Moments, moments_along_reflection
from udccal.fitting.backscatter.search import held_out, search
from udccal.fitting.backscatter.solve import Problem
from udccal.rig import load_rig

PRIOR = prior_of(load_rig("lg55-reduced"))
DISTANCE, GAMMA = NAMES.index("standoff_mm"), NAMES.index("gamma")
FREE = np.isin(np.arange(18), [DISTANCE, REFLECTION])
# Sigma of the reflected share of the light, and of where light comes from as a share of the distance.
_SHARE, _PLACE = 0.08, 2e-3


def _errors_at(share: float, place: float):  # type: ignore[no-untyped-def]
    """Pictures that determine the fraction of the light through the glass, and a mean of both planes' distances."""

    def errors_at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        reflected = expit(x[REFLECTION])
        slope = reflected * (1 - reflected)
        errors = np.array([(reflected - share) / _SHARE, (x[DISTANCE] + 0.1 * reflected - place) / _PLACE])
        slopes = np.zeros((2, 18))
        slopes[:, REFLECTION] = slope / _SHARE, 0.1 * slope / _PLACE
        slopes[1, DISTANCE] = 1 / _PLACE
        return errors, slopes

    return errors_at


def _by_counting(share: float, place: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of distance and reflection as sums over a fine grid of both."""
    pair = [DISTANCE, REFLECTION]
    mean, sigma = PRIOR.mean[pair], PRIOR.sigma[pair]
    grid = np.stack(np.meshgrid(*(np.linspace(m - 7 * s, m + 7 * s, 1201) for m, s in zip(mean, sigma, strict=True))))
    distance, reflected = grid[0], expit(grid[1])
    chi2 = ((reflected - share) / _SHARE) ** 2 + ((distance + 0.1 * reflected - place) / _PLACE) ** 2
    chi2 += (((grid - mean[:, None, None]) / sigma[:, None, None]) ** 2).sum(axis=0)
    weights = np.exp(-0.5 * (chi2 - chi2.min())).ravel()
    values = np.exp(grid.reshape(2, -1))
    return np.average(values, axis=1, weights=weights), np.cov(values, aweights=weights, ddof=0)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.85])
def test_a_skewed_posterior_has_the_moments_of_a_sum_over_it(share: float) -> None:
    place = float(PRIOR.mean[DISTANCE] + 0.1 * share)
    errors_at = _errors_at(share, place)
    found = most_probable(errors_at, PRIOR.mean, FREE, PRIOR)
    moments, wanted = moments_along_reflection(errors_at, found, FREE, PRIOR), _by_counting(share, place)
    pair = np.ix_([DISTANCE, REFLECTION], [DISTANCE, REFLECTION])
    np.testing.assert_allclose(moments.mean[[DISTANCE, REFLECTION]], wanted[0], rtol=0.02)
    np.testing.assert_allclose(moments.cov[pair], wanted[1], rtol=0.05)
    # The parabola at the minimum says something else.
    assert abs(Moments.log_normal(found.x, found.cov).cov[REFLECTION, REFLECTION] / wanted[1][1, 1] - 1) > 0.1


def test_a_narrow_posterior_is_normal() -> None:
    narrow = MostProbable(PRIOR.mean, np.diag(np.full(18, 1e-4)), 0.0, True)
    moments = moments_along_reflection(_errors_at(0.5, 0.0), narrow, FREE, PRIOR)
    np.testing.assert_array_equal(moments.cov, Moments.log_normal(narrow.x, narrow.cov).cov)


def test_logarithms_that_are_normal_give_log_normal_values() -> None:
    rng = np.random.default_rng(0)
    root = 0.1 * rng.normal(size=(18, 18)) / np.sqrt(18)
    moments = Moments.log_normal(PRIOR.mean, root @ root.T)
    drawn = PRIOR.mean + rng.normal(size=(200_000, 18)) @ root.T
    logarithmic = np.arange(18) != GAMMA
    logarithmic[6:12] = False
    values = np.where(logarithmic, np.exp(drawn), drawn)
    np.testing.assert_allclose(moments.mean, values.mean(axis=0), atol=0.01 * np.sqrt(np.diag(moments.cov)).max())
    scale = np.sqrt(np.outer(np.diag(moments.cov), np.diag(moments.cov)))
    np.testing.assert_allclose(moments.cov / scale, np.cov(values.T) / scale, atol=0.02)


def test_a_mixture_is_as_wide_as_its_parts_and_their_distance() -> None:
    parts = [Moments(np.full(18, float(k)), np.eye(18)) for k in (0, 4)]
    both = Moments.mixture(parts, np.array([0.75, 0.25]))
    np.testing.assert_allclose(both.mean, 1.0)
    np.testing.assert_allclose(both.cov, np.eye(18) + 3.0)


@pytest.mark.medium
def test_held_out_pictures_of_the_model_leave_nothing_undescribed() -> None:
    """Few pictures determine 18 parameters: their uncertainty is not a model error."""
    rng = np.random.default_rng([0, 0x4E1D])
    of = world(rng, small_rig())
    shots = shots_of(of, rng, panel_pictures(of.rig, 0, PICTURES))
    found = search(Problem.of(shots, of.term.geometry, of.rig, RULES), (TWO_PLANES,))
    fitted = found.fitted
    assert held_out(found.problem, fitted)[1] == 0.0
    # The pictures that are held out, with an error of 1 % of white that differs from place to place.
    seen = found.problem.seen
    light, out = seen.rate.copy(), slice(RULES.held_out, -1, RULES.held_out)
    light[out] += 0.01 * light[0] * rng.choice([-1.0, 1.0], light[out].shape)
    problem = replace(found.problem, seen=replace(seen, rate=light))
    off = problem.solved(TWO_PLANES, fitted.found.x, fitted.best.weight)
    assert held_out(problem, off)[1] == pytest.approx(0.01, rel=0.2)
