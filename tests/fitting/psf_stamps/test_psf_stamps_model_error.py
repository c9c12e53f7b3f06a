"""What error bars of a psf from stamps hold beside noise: errors of a few stars, light beyond the reach of images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.stamps import drawn as whole
from tests.scenes.two_gaussians import READ_E, make
from udccal.fitting.psf_stamps.data import StampsRules
from udccal.fitting.psf_stamps.field import Changes
from udccal.fitting.psf_stamps.fit import fit_psf_stamps
from udccal.fitting.psf_stamps.model_error import _larger, _surely_off, add_model_error, widen
from udccal.fitting.psf_stamps.probability import expectation, faintest, with_error
from udccal.fitting.psf_stamps.search import start
from udccal.numerics import in_float64
from udccal.result import FitStatus


def test_the_noise_of_all_stars_together_is_also_that_of_the_background() -> None:
    stamps, light_e = make(1, count=25)[0], np.full((25, 1), 1e4)
    for level_e, noise_e in ((0.0, READ_E), (-20.0, READ_E), (100.0 - READ_E**2, 10.0)):
        found = faintest(stamps, light_e, np.full((25, 1), level_e))
        assert found == pytest.approx(noise_e / 5e4)


def test_an_error_of_a_few_stars_counts() -> None:
    rng = np.random.default_rng(3)
    variance = np.repeat([1.0, 25.0], 5000)
    noise = np.sqrt(variance) * rng.standard_normal(10000)
    few, every = np.where(np.arange(10000) % 10, 0.0, 3.0), np.full(10000, 0.9)
    assert abs(_larger(noise**2, variance)) < 0.1
    for error in (few, every):
        found = _larger((noise + error) ** 2, variance)
        assert found == pytest.approx((error**2).mean(), rel=0.25)


def test_stars_left_out_are_off_by_no_more_than_is_sure() -> None:
    rng, shape = np.random.default_rng(4), (20, 225)
    light = 1e5 * np.exp(-np.linspace(0.0, 15.0, 225)) * np.ones(shape)
    variance, used = light + 25.0, np.ones(shape, dtype=bool)
    noise = np.sqrt(variance) * rng.standard_normal(shape)
    assert _surely_off(noise**2, variance, light, used) < 0.002
    off = noise + np.where(np.arange(20) < 3, 0.1, 0.0)[:, None] * light
    assert 0.03 < _surely_off(off**2, variance, light, used) < 0.1 * np.sqrt(3 / 20)
    assert _surely_off(off**2, variance, light, ~used) == 0.0


@pytest.mark.medium
def test_positions_that_are_exchanged_are_told() -> None:
    stamps = whole("undersampled", 2, 20, 15, 2.5e5, 4.0, (0.0, 0.0), varies=1.0).stamps
    assert fit_psf_stamps(stamps).status is FitStatus.CONVERGED
    exchanged = fit_psf_stamps(replace(stamps, position_px=np.roll(stamps.position_px, 7, axis=0)))
    assert exchanged.status is FitStatus.POOR_FIT
    assert "has its own position" in exchanged.notes[0]


@in_float64
def test_likelihood_is_smooth_although_the_model_error_is_not() -> None:
    """Otherwise no step of a fit with a model error would be taken whole."""
    stamps, rules = make(1)[0], StampsRules()
    state = start(stamps, rules, 1)
    state = with_error(stamps, state, 0.1 * state.size * np.random.default_rng(6).uniform(0.0, 1.0, state.size.shape))
    moved = (replace(state, centre_px=state.centre_px + 0.002 * step) for step in range(20))
    second = np.diff([expectation(stamps, there).log_likelihood for there in moved], 2)
    assert np.ptp(second) < 0.1 * np.abs(second).max()


@in_float64
def test_nodes_that_only_the_prior_determines_scatter_more() -> None:
    stamps, rules = make(1)[0], StampsRules()
    state, rng = start(stamps, rules, 1), np.random.default_rng(5)
    for scale, factor in ((1e-6, 1.0), (1e6, np.sqrt(1.5))):
        before = scale * rng.standard_normal((state.vector.size, 8))
        after = before.copy()
        widen(state, after, 0.5)
        old, new = (Changes.of(state.field, len(stamps.unit), each) for each in (before, after))
        np.testing.assert_allclose(new.nodes, factor * old.nodes, rtol=1e-3)
        np.testing.assert_array_equal(new.stars, old.stars)
        np.testing.assert_array_equal(new.maps, old.maps)


@in_float64
def test_light_beyond_the_reach_of_an_image_may_follow_that_within() -> None:
    stamps, rules = make(1)[0], StampsRules(most_work=1e5)
    state = start(stamps, rules, 1).with_images(np.eye(3)[:2], rules)
    assert state.margin > 3
    nodes = state.field.nodes.copy()
    nodes[:, 1] = 0.2 * nodes[:, 0].sum() / state.kept[..., 1].sum() * state.kept[..., 1]
    # Of precisions so large, nothing but the step that both share is left.
    of_images = np.full(state.of_images.shape, 1e12).ravel()
    precisions = np.concatenate([of_images, state.precisions[of_images.size :]])
    state = replace(state, field=replace(state.field, nodes=nodes), precisions=precisions)
    draws = np.zeros((state.vector.size, 2000))
    add_model_error(state, draws)
    changes = Changes.of(state.field, len(stamps.unit), draws)
    relative = changes.nodes[0, 1] / nodes[0, 0, ..., None]
    beyond = ~state.kept[..., 1]
    np.testing.assert_allclose(relative[beyond].std(axis=1), 0.2, rtol=0.1)
    np.testing.assert_array_equal(relative[~beyond], 0.0)
