"""Derivatives, profiles and model errors of the backscatter fit against other ways to work them out."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from udccal.fitting.backscatter.data import Binned, Profile
from udccal.fitting.backscatter.model import (
    PanelCrop,
    Pictures,
    Shares,
    directions,
    grid_step,
    ratios,
    ratios_and_jacobian,
    sampled_rays,
    window_for,
)
from udccal.fitting.backscatter.parameters import (
    KERNELS,
    PUPIL,
    REFLECTION,
    SOFTNESS,
    TWO_PLANES,
    MostProbable,
    linear_of,
    linear_slope,
    prior_of,
    vector_of,
    with_linear,
)
from udccal.fitting.backscatter.read import visible_crop
from udccal.fitting.backscatter.search import typical_error
from udccal.fitting.backscatter.solve import Fitted
from udccal.fitting.nominal import nominal_backscatter, nominal_geometry
from udccal.models.backscatter import emitter_shares, panel_response, response_grid, window_corners
from udccal.models.geometry import panel_directions
from udccal.rig import load_rig

RIG = load_rig("lg55-reduced")
PRIOR = prior_of(RIG)
X = PRIOR.mean + 0.3 * PRIOR.sigma * np.random.default_rng(3).normal(size=18)
THETA = linear_of(X)


def _seen(shots: int = 5, n: int = 4, seed: int = 0) -> tuple[np.ndarray, Binned]:
    """Ratios, and light that follows them with noise; dark comes last."""
    rng = np.random.default_rng(seed)
    ratio = rng.uniform(0.1, 0.9, (shots + 1, 3, n))
    ratio[0], ratio[-1] = 1.0, 0.0
    mask, dark = rng.uniform(50, 100, (3, n)), rng.uniform(1, 2, (3, n))
    rest = np.full(ratio.shape, 0.3)
    rest[-1] = 0.01
    exposure = np.append(np.full(shots, 0.5), 1.0)
    light = mask * ratio + exposure[:, None, None] * dark + np.sqrt(rest) * rng.normal(size=ratio.shape)
    clipped = np.zeros(ratio.shape, dtype=bool)
    return ratio, Binned(light, np.full(ratio.shape, 0.01), rest, clipped, 1 / exposure, np.full(shots + 1, np.nan))


def _weights(seen: Binned) -> np.ndarray:
    light = seen.rate.copy()
    light[-1] = 0.0
    return seen.weights(light, light[0], 0.0, seen.usable)


def test_derivatives_of_ratios_are_those_of_differences() -> None:
    geometry = nominal_geometry(RIG)
    rays, _ = sampled_rays(geometry, RIG, grid_step(RIG), 7)
    crop = visible_crop(geometry, RIG)
    shown = np.random.default_rng(0).integers(0, 256, (3, crop.rows, crop.columns, 3)).astype(np.uint8)
    pictures = Pictures.of(shown, crop)
    template = nominal_backscatter(geometry, RIG, np.zeros((3, 1, 1)), grid_step(RIG), window=1)
    template = replace(template, window=window_for(template, THETA, rays, 1.0))
    ratio, jacobian = ratios_and_jacobian(template, THETA, rays, pictures)
    np.testing.assert_allclose(ratio[0], 1.0, rtol=1e-12)
    np.testing.assert_array_equal(ratio[-1], 0.0)
    np.testing.assert_allclose(ratio, ratios(template, THETA, rays, pictures), rtol=1e-12)
    for k in range(18):
        step = 1e-5 * np.eye(18)[k]
        up, down = (ratios(template, THETA + sign * step, rays, pictures) for sign in (1, -1))
        np.testing.assert_allclose(jacobian[k], (up - down) / 2e-5, atol=1e-6)


@pytest.mark.parametrize(("softness", "window"), [(0.1, 41), (0.3, 41), (2.0, 5)])
def test_shares_are_those_of_the_model(softness: float, window: int) -> None:
    """In all of a wide window, and in one that is cut to less than the footprints."""
    geometry = replace(nominal_geometry(RIG), distortion=np.array([-0.1, 0.05, 0.001, -0.002, 0.01]))
    rays, _ = sampled_rays(geometry, RIG, grid_step(RIG), 7)
    template = nominal_backscatter(geometry, RIG, np.zeros((3, 1, 1)), grid_step(RIG), window=window)
    theta = np.where(np.arange(18) == SOFTNESS, np.log(softness), THETA)
    with jax.enable_x64(True):
        term = with_linear(template, theta)
        corner = np.asarray(window_corners(term, rays))
        wanted = np.moveaxis(np.asarray(emitter_shares(term, rays, corner)), 1, 2)
    shares, found = Shares.of(template, theta, rays), np.zeros((len(rays) * 6, window**2))
    column, row = (shares.panel_px - corner[shares.row // 6]).T
    found[shares.row, row * window + column] = shares.values[0]
    direct, reflected = np.moveaxis(found.reshape(len(rays), 2, 3, -1), 1, 0)
    whole = (1 - theta[REFLECTION]) * direct + theta[REFLECTION] * reflected
    np.testing.assert_allclose(whole, wanted, atol=1e-12)


def test_rays_are_those_of_the_model() -> None:
    geometry = replace(nominal_geometry(RIG), distortion=np.array([-0.1, 0.05, 0.001, -0.002, 0.01]))
    pixels = np.random.default_rng(0).uniform(0, 700, (50, 2))
    with jax.enable_x64(True):
        wanted = np.asarray(panel_directions(geometry, pixels))
    np.testing.assert_allclose(directions(geometry, pixels), wanted, atol=1e-12)


def test_nothing_comes_from_beyond_the_crop() -> None:
    pictures = Pictures.of(np.full((1, 2, 3, 3), 255, np.uint8), PanelCrop(1, 1, 3, 2))
    column, row = np.divmod(np.arange(9), 3)
    panel_px = np.stack([column, row], axis=1)
    sums = Shares(2, np.zeros(9, int), panel_px, np.ones((1, 9))).light(pictures, pictures.light(2.2)[0])[0]
    np.testing.assert_array_equal(sums[0, 0, 0], [4.0, 4.0, 0.0])
    assert not sums[1].any()


@pytest.mark.medium
def test_ratios_are_those_of_the_model() -> None:
    """The model's own pictures over its white, crosstalk included."""
    geometry, crop = nominal_geometry(RIG), visible_crop(nominal_geometry(RIG), RIG)
    rays, flat = sampled_rays(geometry, RIG, grid_step(RIG), 7)
    shape = RIG.camera.rows // grid_step(RIG), RIG.camera.columns // grid_step(RIG)
    template = nominal_backscatter(geometry, RIG, np.ones((3, *shape)), grid_step(RIG), window=1)
    template = replace(template, window=window_for(template, THETA, rays, 1.0))
    shown = np.random.default_rng(0).integers(0, 256, (RIG.panel.rows, RIG.panel.columns, 3)).astype(np.uint8)
    with jax.enable_x64(True):
        response = panel_response(with_linear(template, THETA), RIG.panel.rows, RIG.panel.columns)
        wanted = np.asarray(response_grid(response, shown)).reshape(3, -1)[:, flat]
    found = ratios(template, THETA, rays, Pictures.of(crop.of(shown)[None], crop))
    np.testing.assert_allclose(found[1], wanted, rtol=1e-9)


def test_linear_parameters_have_the_slopes_of_differences() -> None:
    for start in (X, TWO_PLANES.without_crosstalk().start(X, PRIOR), KERNELS[0].start(X, PRIOR)):
        wanted = (linear_of(start + 1e-6) - linear_of(start - 1e-6)) / 2e-6
        np.testing.assert_allclose(linear_slope(start), wanted, atol=1e-8)


def test_a_term_has_the_parameters_that_made_it() -> None:
    template = nominal_backscatter(nominal_geometry(RIG), RIG, np.zeros((3, 1, 1)), 8, window=5)
    np.testing.assert_allclose(vector_of(with_linear(template, THETA)), X, rtol=1e-12, atol=1e-12)


def test_mask_and_dark_are_those_of_least_squares() -> None:
    ratio, seen = _seen()
    weight = _weights(seen)
    best = Profile.of(seen, ratio, weight)
    for c, n in np.ndindex(best.mask.shape):
        rows = np.stack([ratio[:, c, n], 1 / seen.exposure_s], axis=1) * weight[:, c, n, None]
        found, *_ = np.linalg.lstsq(rows, seen.rate[:, c, n] * weight[:, c, n], rcond=None)
        np.testing.assert_allclose([best.mask[c, n], best.dark[c, n]], found, rtol=1e-10)
        assert best.information[c, n] == pytest.approx(1 / np.linalg.inv(rows.T @ rows)[0, 0], rel=1e-10)


def test_the_mask_follows_ratios_as_said() -> None:
    ratio, seen = _seen()
    weight = _weights(seen)
    best = Profile.of(seen, ratio, weight)
    expected = replace(seen, rate=best.mask * ratio)
    way = np.random.default_rng(1).normal(size=(2, *ratio.shape))
    found = best.mask_jacobian(way)
    for k in range(2):
        up, down = (Profile.of(expected, ratio + sign * 1e-6 * way[k], weight).mask for sign in (1, -1))
        np.testing.assert_allclose(found[k], (up - down) / 2e-6, rtol=1e-4, atol=1e-3)


def test_whitened_errors_are_at_right_angles_to_mask_and_dark() -> None:
    ratio, seen = _seen()
    weight = _weights(seen)
    best = Profile.of(seen, ratio, weight)
    errors = best.errors * weight
    jacobian = best.jacobian(np.random.default_rng(1).normal(size=(2, *ratio.shape)))
    for way in (ratio * weight, (1 / seen.exposure_s)[:, None, None] * weight):
        np.testing.assert_allclose((way * errors).sum(axis=0), 0.0, atol=1e-6)
        np.testing.assert_allclose((way * jacobian).sum(axis=1), 0.0, atol=1e-6)


def test_a_typical_error_is_that_of_most_pictures() -> None:
    """A model error of 3 % in all pictures is found, one picture that is another altogether is not counted."""
    ratio, seen = _seen(shots=12, n=60)
    rng = np.random.default_rng(2)
    off = ratio.copy()
    off[1:-1] += 0.03 * rng.normal(size=(11, 3, 60))
    nothing = MostProbable(np.zeros(18), np.zeros((18, 18)), 0.0, True)

    def error_of(ratios_of: np.ndarray) -> float:
        best = Profile.of(seen, ratios_of, _weights(seen))
        return typical_error(Fitted(TWO_PLANES, nothing, ratios_of, best), seen)

    assert error_of(ratio) < 0.004
    assert error_of(off) == pytest.approx(0.03, rel=0.15)
    off[3] = rng.uniform(0.1, 0.9, (3, 60))
    assert error_of(off) == pytest.approx(0.03, rel=0.5)


def test_an_order_without_something_has_to_be_better_for_it() -> None:
    plain = KERNELS[0].without_crosstalk()
    assert TWO_PLANES.against == 0
    assert 0 < KERNELS[1].against < KERNELS[0].against < plain.against


def test_a_window_does_not_follow_a_fit_gone_astray() -> None:
    geometry, most = nominal_geometry(RIG), 31
    rays, _ = sampled_rays(geometry, RIG, grid_step(RIG), 7)
    template = nominal_backscatter(geometry, RIG, np.zeros((3, 1, 1)), grid_step(RIG), window=most)
    widths = []
    for pupils in (1.0, 2.2, 50.0):
        shares = Shares.of(template, linear_of(PRIOR.mean + np.log(pupils) * np.eye(18)[PUPIL]), rays)
        widths.append(np.ptp(shares.panel_px[shares.row < 6], axis=0).max() + 1)
    assert widths[0] < widths[1] < widths[2] == most
