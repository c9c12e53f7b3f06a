from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from udccal.fitting.engine.misfit import (
    chi2_tail,
    chi2_test,
    clustered_cov,
    excess_sigma,
    excess_variance,
    f_tail,
    f_test,
    group_means_test,
    robust_excess_sigma,
    sharper,
)


def test_chance_alone_is_flagged_once_in_a_thousand() -> None:
    rng = np.random.default_rng(0)
    p = [chi2_test(float(rng.chisquare(20)), 20.0).p_value for _ in range(4000)]
    assert np.mean(np.array(p) < 0.05) == pytest.approx(0.05, abs=0.012)
    assert np.mean(np.array(p) < 1e-3) < 0.003


def test_f_test_with_an_estimated_scale_holds_its_level() -> None:
    rng = np.random.default_rng(1)
    draws = 7.0 * rng.chisquare(1, (4000, 40))
    p = np.array([f_test(float(d[:5].sum() / d.mean()), 5, 40.0).p_value for d in draws])
    assert np.mean(p < 0.05) == pytest.approx(0.05, abs=0.012)


def test_a_pattern_is_found_in_groups_and_noise_has_none() -> None:
    rng = np.random.default_rng(2)
    group, z = np.arange(4000) % 40, rng.standard_normal(4000)
    used = np.ones(4000, dtype=bool)
    assert not group_means_test(z, group, used).found
    assert group_means_test(z + 0.3 * np.sin(group), group, used).found
    assert not group_means_test(z + 100.0 * (group == 3), group, used & (group != 3)).found


def test_the_sharper_of_two_tests_pays_for_the_choice() -> None:
    dull, sharp = chi2_test(10.0, 10.0), chi2_test(40.0, 10.0)
    assert sharper(dull, sharp).p_value == pytest.approx(2 * sharp.p_value)


@pytest.mark.parametrize("size", [0.0, 0.02, 0.5])
def test_an_error_beside_noise_is_measured(size: float) -> None:
    rng = np.random.default_rng(3)
    light = rng.uniform(1, 30, 5000)
    noise = 0.01 * light
    residual = np.sqrt(noise) * rng.standard_normal(5000) + size * light * rng.standard_normal(5000)
    assert excess_sigma(residual**2, noise, light**2, 5000.0) == pytest.approx(size, rel=0.05, abs=1e-12)


def test_an_error_that_chance_may_explain_is_estimated_only_where_asked() -> None:
    residual = 1.05 * np.random.default_rng(8).standard_normal(200)
    ones = np.ones(200)
    assert excess_sigma(residual**2, ones, ones, 200.0) == 0.0
    assert excess_sigma(residual**2, ones, ones, 200.0, chance=0.5) > 0.1
    assert excess_sigma(0.8 * ones, ones, ones, 200.0, chance=0.5) == 0.0


def test_a_robust_size_is_that_of_most_residuals() -> None:
    rng = np.random.default_rng(4)
    light = rng.uniform(1, 30, 5000)
    noise = 0.01 * light
    residual = np.sqrt(noise) * rng.standard_normal(5000) + 0.02 * light * rng.standard_normal(5000)
    residual[:100] += 50.0
    assert robust_excess_sigma(residual**2, noise, light**2) == pytest.approx(0.02, rel=0.15)
    assert excess_sigma(residual**2, noise, light**2, 5000.0) > 0.1


def test_the_noise_of_groups_does_not_count_twice() -> None:
    """Along each direction the larger of noise and scatter counts: never below either, and not their sum."""
    rng, cov = np.random.default_rng(6), np.array([[2e-6, 1e-4], [1e-4, 3e-2]])
    root, groups = np.linalg.cholesky(np.linalg.inv(cov) / 40), 40
    ratios = [np.diag(clustered_cov(cov, rng.standard_normal((groups, 2)) @ root.T)) / np.diag(cov) for _ in range(200)]
    assert np.min(ratios) >= 1.0
    assert np.mean(ratios) < 1.2


@pytest.mark.parametrize("with_information", [True, False])
def test_groups_that_differ_widen_the_covariance_to_the_true_scatter(with_information: bool) -> None:
    """A straight line through groups that each have an offset of their own, which the model lacks."""
    rng, groups, each = np.random.default_rng(5), 30, 20
    x = rng.uniform(-1, 1, (groups, each))
    slopes = np.stack([np.ones_like(x), x], axis=-1)
    own = np.einsum("gei,gej->gij", slopes, slopes)
    cov = np.linalg.inv(own.sum(axis=0))
    found, stated = [], []
    for _ in range(400):
        y = rng.standard_normal((groups, each)) + 0.8 * rng.standard_normal((groups, 1))
        best = cov @ np.einsum("gei,ge->i", slopes, y)
        scores = np.einsum("gei,ge->gi", slopes, y - slopes @ best)
        wide = clustered_cov(cov, scores, own if with_information else None)
        assert (np.diag(wide) >= np.diag(cov)).all()
        found.append(best)
        stated.append(wide[0, 0])
    assert np.sqrt(np.mean(stated)) == pytest.approx(np.std(np.array(found)[:, 0]), rel=0.15)
    assert np.sqrt(cov[0, 0]) < 0.5 * np.std(np.array(found)[:, 0])


def test_an_excess_variance_is_found_within_its_error_and_none_where_there_is_none() -> None:
    rng = np.random.default_rng(3)
    known, dof = np.array([1.0, 2.0, 4.0]), np.array([200.0, 400.0, 100.0])
    draws = rng.chisquare(dof, (400, 3)) / dof
    found = np.array([excess_variance(one * (known + 0.5), known, dof) for one in draws])
    z = (found[:, 0] - 0.5) / np.sqrt(found[:, 1])
    assert abs(z.mean()) < 0.2
    assert z.std() == pytest.approx(1.0, abs=0.15)
    none = np.array([excess_variance(one * known, known, dof) for one in draws])
    assert np.mean(none[:, 0] == 0) == pytest.approx(0.5, abs=0.1)
    # Half of a chi-squared of one degree of freedom (Chernoff, Ann. Math. Stat. 25, 1954).
    assert np.mean(none[:, 2] > 2.71) == pytest.approx(0.05, abs=0.03)


@pytest.mark.parametrize("dof", [1.0, 3.0, 47.5, 1e6])
@pytest.mark.parametrize("per_dof", [0.0, 0.5, 1.0, 1.3, 40.0, np.inf])
def test_tails_are_those_of_the_distributions(dof: float, per_dof: float) -> None:
    assert chi2_tail(per_dof * dof, dof) == pytest.approx(stats.chi2.sf(per_dof * dof, dof), rel=1e-9, abs=1e-300)
    assert f_tail(per_dof, dof, 20.0) == pytest.approx(stats.f.sf(per_dof, dof, 20.0), rel=1e-9, abs=1e-300)


@pytest.mark.parametrize(
    "tail", [chi2_tail(-0.1, 3.0), chi2_tail(5.0, 0.0), f_tail(-0.1, 3.0, 9.0), f_tail(5.0, 0.0, 9.0)]
)
def test_nothing_compared_is_never_unlikely(tail: float) -> None:
    assert tail == 1.0
