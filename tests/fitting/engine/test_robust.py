from __future__ import annotations

import numpy as np

from udccal.fitting.engine.robust import Cauchy, Huber, OutlierRule, outliers, robust_sigma


def test_hits_are_left_out_and_normal_noise_is_not() -> None:
    z = np.random.default_rng(0).standard_normal(10_000)
    rule = OutlierRule("samples")
    assert not rule.off(z).any()
    z[[3, 70]] = 9.0, np.nan
    assert np.flatnonzero(rule.off(z)).tolist() == [3, 70]


def test_noise_larger_than_stated_makes_no_outliers() -> None:
    z = 30 * np.random.default_rng(1).standard_normal(10_000)
    assert not OutlierRule("samples").off(z).any()
    assert abs(robust_sigma(z) / 30 - 1) < 0.03


def test_what_is_not_used_has_no_say() -> None:
    z, used = np.array([0.5, -1.0, 40.0, 8.0]), np.array([True, True, False, True])
    assert OutlierRule("samples").off(z, used).tolist() == [False, False, False, True]


def test_all_are_counted_and_the_first_are_named() -> None:
    (found,) = outliers("pictures that moved", (f"picture {k}" for k in range(11)))
    assert (found.count, found.places[0], len(found.places)) == (11, "picture 0", 8)
    assert outliers("pictures that moved", ()) == ()


def test_robust_losses_are_squares_near_zero_and_smooth() -> None:
    z = np.linspace(-20, 20, 4001)
    for rule in (Huber(), Cauchy()):
        loss = rule.loss(z)
        assert np.allclose(loss[np.abs(z) < 0.05], z[np.abs(z) < 0.05] ** 2, rtol=1e-3)
        assert (loss <= z**2 + 1e-12).all()
        assert np.abs(np.diff(loss, 2)).max() < 3e-4


def test_a_weight_is_the_loss_by_its_square() -> None:
    z, step = np.array([0.1, 2.5, 30.0]), 1e-6
    slope = (Cauchy().loss(z + step) - Cauchy().loss(z - step)) / ((z + step) ** 2 - (z - step) ** 2)
    assert np.allclose(Cauchy().weight(z), slope, rtol=1e-6)
