"""The lens's further blur, which grows away from the camera's axis, along the radius and across it."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from tests.scenes.psf import pictures, shots_of, small_scene
from udccal.fitting.psf.data import PsfRules
from udccal.fitting.psf.diffraction import fit_diffraction
from udccal.fitting.psf.kernel import BLUR, BLUR_BLUE, BLUR_RED, GROWTH
from udccal.fitting.psf.start import start_model, start_prior
from udccal.models.diffraction import Diffraction, blur_variance, local_frame
from udccal.models.geometry import Geometry
from udccal.numerics import in_float64

NUMBERS = [*range(GROWTH.start, GROWTH.stop), BLUR_RED, BLUR_BLUE]


@pytest.mark.medium
@pytest.mark.parametrize("blur", [(0.9, 0.3, 0.1, -0.15), (0.0, 0.0, 0.0, 0.0)])
@in_float64
def test_a_blur_that_grows_and_differs_by_colour_is_found(blur: tuple[float, ...]) -> None:
    scene, rng = small_scene(positions=(3, 2), shifts=2, half=(8, 6)), np.random.default_rng(3)
    start = start_model(scene.rig, scene.geometry, scene.wire)
    prior = start_prior(scene.rig, start)
    theta = prior.mean.copy()
    theta[BLUR], theta[NUMBERS] = np.log(0.35), blur
    shots = shots_of(scene, pictures(scene, theta, rng), rng)
    fit = fit_diffraction(shots, scene.geometry, start, prior, replace(PsfRules(), close_px=scene.half))
    found, sigma = fit.theta[NUMBERS], np.sqrt(np.diag(fit.cov())[NUMBERS])
    assert fit.converged
    assert np.abs((found - theta[NUMBERS]) / sigma).max() < 4
    assert sigma.max() < 0.1
    assert abs(np.exp(fit.theta[BLUR]) - 0.35) < 0.01


@in_float64
def ellipse(model: Diffraction, geometry: Geometry, place: tuple[float, float]) -> np.ndarray:
    x, y, both = np.asarray(blur_variance(model, local_frame(geometry, jnp.array(place))))[1]
    return np.array([[x, both], [both, y]])


@pytest.mark.medium
def test_the_blur_is_an_ellipse_along_the_radius() -> None:
    scene = small_scene()
    model = start_model(scene.rig, scene.geometry, scene.wire)
    model = replace(model, blur_px=np.float64(0.3), blur_growth=np.array([0.8, 0.2]))
    centre, focal = np.asarray(scene.geometry.principal_point_px), np.asarray(scene.geometry.focal_px)
    np.testing.assert_allclose(ellipse(model, scene.geometry, tuple(centre)), 0.09 * np.eye(2), rtol=1e-6)
    radius = np.array([0.3, 0.4])
    found = ellipse(model, scene.geometry, tuple(centre + radius * focal))
    for direction, growth in ((radius / 0.5, 0.8), (np.array([-0.8, 0.6]), 0.2)):
        assert np.sqrt(direction @ found @ direction) == pytest.approx(0.3 * np.exp(growth * 0.25), rel=1e-5)
    red, green, blue = np.asarray(
        blur_variance(
            replace(model, blur_colour=np.log([2.0, 1.0, 0.5])), local_frame(scene.geometry, jnp.array([5.0, 700.0]))
        )
    )
    np.testing.assert_allclose([red / green, blue / green], [[4.0] * 3, [0.25] * 3])
    even = replace(model, blur_growth=np.zeros(2))
    np.testing.assert_allclose(ellipse(even, scene.geometry, (5.0, 700.0)), 0.09 * np.eye(2), rtol=1e-6)


@pytest.mark.medium
@in_float64
def test_pictures_sharper_than_the_model_allows_converge_without_blur() -> None:
    """The LED is said to be 6 % wider than it is: the sharpest model is too wide for pictures of a sharp lens."""
    scene, rng = small_scene(positions=(4, 3), shifts=3, half=(8, 6)), np.random.default_rng(5)
    start = start_model(scene.rig, scene.geometry, scene.wire)
    prior = start_prior(scene.rig, start)
    theta = prior.mean.copy()
    theta[BLUR] = np.log(1e-3)
    shots = shots_of(scene, pictures(scene, theta, rng), rng)
    shots = replace(shots, disc_px=1.06 * shots.disc_px)
    fit = fit_diffraction(shots, scene.geometry, start, prior, replace(PsfRules(), close_px=scene.half))
    assert fit.converged
    assert np.exp(fit.theta[BLUR]) < 0.02
    assert fit.solution.equations.step(0.0).gain < 0.3  # without the curvature: 0.54
