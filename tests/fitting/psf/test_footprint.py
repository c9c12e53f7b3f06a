"""The footprint's place on the rows, in which the data are periodic."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.psf import pictures, shots_of, small_scene
from udccal.effort import FitEffort
from udccal.fitting.psf.diffraction import fit_diffraction
from udccal.fitting.psf.kernel import start_model, start_prior
from udccal.numerics import in_float64


@pytest.mark.medium
@in_float64
def test_a_descent_that_leaves_the_footprint_for_another_period_begins_there_again() -> None:
    """Of this specimen, the first descent ended 12 sigma of the prior away: openings were 38 of their sigmas off."""
    scene, rng = small_scene(positions=(3, 1), shifts=8, half=(14, 7)), np.random.default_rng(80)
    start = start_model(scene.rig, scene.geometry, scene.wire)
    prior = start_prior(scene.rig, start)
    cov = np.linalg.inv(prior.precision)
    true = prior.mean + np.linalg.cholesky(cov) @ rng.standard_normal(len(cov))
    shots = shots_of(scene, pictures(scene, true, rng), rng)
    every_other = np.arange(len(shots.position)) % 2 == 0
    rules = replace(FitEffort().psf, close_px=scene.half, iterations=60)
    fit = fit_diffraction(shots.pick(every_other), scene.geometry, start, prior, rules)
    assert fit.converged
    z = (fit.theta - true) / np.sqrt(np.diag(fit.noise_cov))
    assert np.abs(z[:13]).max() < 4.5
