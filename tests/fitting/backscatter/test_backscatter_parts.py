"""Slopes, profiles and shares of the backscatter fit against other ways to work them out."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from udccal.fitting.backscatter.blocks import BLOCK, in_blocks
from udccal.fitting.backscatter.checks import typical_share
from udccal.fitting.backscatter.data import PanelCrop, grid_step, sampled_rays, visible_crop
from udccal.fitting.backscatter.evidence import Evidence, pictures_of, weights
from udccal.fitting.backscatter.likelihood import reweighed
from udccal.fitting.backscatter.profile import mask_slopes, profiled, whitened
from udccal.fitting.backscatter.ratios import ratios, ratios_and_slopes, window_logs, windows_at
from udccal.fitting.backscatter.solve import corners_of, window_for, with_room
from udccal.fitting.backscatter.vector import KERNELS, TWO_PLANES, mix_and_slopes, mix_of, prior_of, without_crosstalk
from udccal.fitting.nominal import nominal_backscatter, nominal_geometry
from udccal.fitting.solvers import Solution
from udccal.rig import load_rig

RIG = load_rig("lg55-reduced")
PRIOR = prior_of(RIG)
X = PRIOR.mean + 0.3 * PRIOR.sigma * np.random.default_rng(3).normal(size=18)


def _seen(shots: int = 5, n: int = 4, seed: int = 0) -> tuple[np.ndarray, Evidence]:
    """Ratios, and light that follows them with noise."""
    rng = np.random.default_rng(seed)
    ratio = np.concatenate([np.ones((1, 3, n)), rng.uniform(0.1, 0.9, (shots - 1, 3, n))])
    mask, dark = rng.uniform(50, 100, (3, n)), rng.uniform(1, 2, (3, n))
    rest = np.full(ratio.shape, 0.3)
    light = mask * ratio + 0.5 * dark + np.sqrt(rest) * rng.normal(size=ratio.shape)
    shown = pictures_of(np.zeros((shots - 1, 1, 1, 3), np.uint8), PanelCrop(0, 0, 1, 1))
    return ratio, Evidence(
        rays=np.zeros((n, 3)),
        light=light,
        shot=np.full(ratio.shape, 0.01),
        rest=rest,
        usable=np.ones(ratio.shape, dtype=bool),
        dark=dark + 0.1 * rng.normal(size=dark.shape),
        dark_variance=np.full(dark.shape, 0.01),
        exposure=np.full(shots, 0.5),
        shown=shown,
    )


def test_slopes_of_ratios_are_those_of_differences() -> None:
    geometry = nominal_geometry(RIG)
    rays, _ = sampled_rays(geometry, RIG, grid_step(RIG), 7)
    crop = visible_crop(geometry, RIG)
    shown = np.random.default_rng(0).integers(0, 256, (3, crop.rows, crop.columns, 3)).astype(np.uint8)
    pictures = pictures_of(shown, crop)
    template = nominal_backscatter(geometry, RIG, np.zeros((3, 1, 1)), grid_step(RIG), window=1)
    template = replace(template, window=window_for(template, X, rays, 1.0))
    at = windows_at(template.window, rays, corners_of(template, X, rays), pictures)
    ratio, slope = ratios_and_slopes(template, X, at, window_logs(at, pictures))
    np.testing.assert_allclose(ratio, ratios(template, X, at, pictures), rtol=1e-12)
    for k in range(18):
        step = 1e-5 * np.eye(18)[k]
        up, down = (ratios(template, X + sign * step, at, pictures) for sign in (1, -1))
        np.testing.assert_allclose(slope[k], (up - down) / 2e-5, atol=1e-6)


def test_nothing_comes_from_beyond_the_crop() -> None:
    pictures = pictures_of(np.full((1, 2, 3, 3), 255, np.uint8), PanelCrop(10, 20, 3, 2))
    at = windows_at(3, np.zeros((2, 3)), np.array([[9, 19], [100, 100]]), pictures)
    assert at.inside.sum(axis=1).tolist() == [4, 0]
    assert (window_logs(at, pictures)[1] < -100).all()


def test_the_mix_has_the_slopes_of_its_model() -> None:
    with jax.enable_x64(True):
        wanted = np.moveaxis(np.asarray(jax.jacfwd(mix_of)(jnp.asarray(X)))[..., 12:], -1, 0)
        value = np.asarray(mix_of(jnp.asarray(X)))
    mix, slopes = mix_and_slopes(X)
    np.testing.assert_allclose(mix, value, rtol=1e-13)
    np.testing.assert_allclose(slopes, wanted, atol=1e-13)


def test_mask_and_dark_are_those_of_least_squares() -> None:
    ratio, seen = _seen()
    weight = weights(seen, seen.light, seen.light[0], 0.0, seen.usable)
    best = profiled(ratio, seen, weight)
    for c, n in np.ndindex(best.mask.shape):
        rows = np.stack([ratio[:, c, n], seen.exposure], axis=1) * weight[:, c, n, None]
        rows = np.concatenate([rows, [[0.0, 10.0]]])
        wanted = np.concatenate([seen.light[:, c, n] * weight[:, c, n], [10.0 * seen.dark[c, n]]])
        found, *_ = np.linalg.lstsq(rows, wanted, rcond=None)
        np.testing.assert_allclose([best.mask[c, n], best.dark[c, n]], found, rtol=1e-10)
        assert best.information[c, n] == pytest.approx(1 / np.linalg.inv(rows.T @ rows)[0, 0], rel=1e-10)


def test_the_mask_follows_ratios_as_said() -> None:
    ratio, seen = _seen()
    weight = weights(seen, seen.light, seen.light[0], 0.0, seen.usable)
    best = profiled(ratio, seen, weight)
    expected = replace(seen, light=best.mask * ratio, dark=np.zeros_like(best.dark))
    way = np.random.default_rng(1).normal(size=(2, *ratio.shape))
    found = mask_slopes(ratio, way, best, seen, weight)
    for k in range(2):
        up, down = (profiled(ratio + sign * 1e-6 * way[k], expected, weight).mask for sign in (1, -1))
        np.testing.assert_allclose(found[k], (up - down) / 2e-6, rtol=1e-4, atol=1e-3)


def test_whitened_errors_are_at_right_angles_to_mask_and_dark() -> None:
    ratio, seen = _seen()
    weight = weights(seen, seen.light, seen.light[0], 0.0, seen.usable)
    slope = np.random.default_rng(1).normal(size=(2, *ratio.shape))
    errors, by_ratio = whitened(ratio, slope, seen, weight)
    ways = [np.concatenate([ratio * weight, np.zeros((1, 3, 4))])]
    ways.append(np.concatenate([seen.exposure[:, None, None] * weight, np.full((1, 3, 4), 10.0)]))
    for way in ways:
        np.testing.assert_allclose((way * errors).sum(axis=0), 0.0, atol=1e-6)
        np.testing.assert_allclose((way * by_ratio).sum(axis=1), 0.0, atol=1e-6)


def test_a_typical_share_is_that_of_most_pictures() -> None:
    """A model error of 3 % in all pictures is found, one picture that is another altogether is not counted."""
    ratio, seen = _seen(shots=12, n=60)
    rng = np.random.default_rng(2)
    off = ratio + 0.03 * np.concatenate([np.zeros((1, 3, 60)), rng.normal(size=(11, 3, 60))])
    nothing = Solution(np.zeros(18), np.zeros((18, 18)), 0.0, 0, True, np.zeros(1))
    weight = weights(seen, seen.light, seen.light[0], 0.0, seen.usable)
    corner = np.zeros((60, 2), dtype=np.int64)
    assert typical_share(reweighed(nothing, corner, ratio, seen, weight), seen) < 0.004
    assert typical_share(reweighed(nothing, corner, off, seen, weight), seen) == pytest.approx(0.03, rel=0.15)
    off[3] = rng.uniform(0.1, 0.9, (3, 60))
    assert typical_share(reweighed(nothing, corner, off, seen, weight), seen) == pytest.approx(0.03, rel=0.5)


def test_an_order_without_something_has_to_be_better_for_it() -> None:
    plain = without_crosstalk(KERNELS[0])
    assert TWO_PLANES.against == 0
    assert 0 < KERNELS[1].against < KERNELS[0].against < plain.against


def test_a_window_does_not_follow_a_fit_gone_astray() -> None:
    geometry = nominal_geometry(RIG)
    rays, _ = sampled_rays(geometry, RIG, grid_step(RIG), 7)
    template = nominal_backscatter(geometry, RIG, np.zeros((3, 1, 1)), grid_step(RIG), window=1)
    template = replace(template, window=window_for(template, PRIOR.mean, rays, 1.0))
    wider, astray = PRIOR.mean.copy(), PRIOR.mean.copy()
    wider[2] += np.log(2.2)
    astray[2] += np.log(50.0)
    assert with_room(template, wider, rays).window > template.window
    assert with_room(template, astray, rays).window == template.window


def test_blocks_give_what_the_whole_gives() -> None:
    numbers = np.arange(2.0 * BLOCK + 5)
    shapes = []

    def function(part: np.ndarray) -> tuple[np.ndarray, ...]:
        shapes.append(part.shape)
        return (jnp.asarray(part) ** 2, jnp.asarray(part) + 1)

    square, more = in_blocks(function, numbers)
    np.testing.assert_array_equal(square, numbers**2)
    np.testing.assert_array_equal(more, numbers + 1)
    assert set(shapes) == {(BLOCK,)}
