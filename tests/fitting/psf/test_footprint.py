"""The pupil's footprint: its place on the rows, in which the data are periodic, and its width."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import Float

from tests.scenes.psf import Scene, pictures, shots_of, small_scene
from udccal.effort import FitEffort
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.orders import Choice
from udccal.fitting.psf import diffraction
from udccal.fitting.psf.approach import Approach, approach
from udccal.fitting.psf.data import PsfRules, Shots
from udccal.fitting.psf.diffraction import DiffractionFit, fit_diffraction
from udccal.fitting.psf.kernel import FOOTPRINT, HEAD, PUPIL, SLANT
from udccal.fitting.psf.problem import DiffractionProblem
from udccal.fitting.psf.start import some_shots, start_model, start_prior
from udccal.numerics import in_float64


def _drawn(scene: Scene, prior: Prior, seed: int, interference: bool = True) -> tuple[Float[np.ndarray, " p"], Shots]:
    """Parameters of plain openings drawn from the prior, and what the fit works on."""
    rng = np.random.default_rng(seed)
    cov = np.linalg.inv(prior.precision)
    drawn = np.insert(rng.standard_normal(len(cov) - 2), SLANT.start, [0.0, 0.0])
    true = prior.mean + np.linalg.cholesky(cov) @ drawn
    return true, shots_of(scene, pictures(scene, true, rng, interference), rng)


@pytest.mark.medium
@in_float64
def test_a_descent_that_leaves_the_footprint_for_another_period_begins_there_again() -> None:
    """Of this specimen, the first descent ended 12 sigma of the prior away: openings were 38 of their sigmas off."""
    scene = small_scene(positions=(3, 1), shifts=8, half=(14, 7))
    start = start_model(scene.rig, scene.geometry, scene.wire)
    prior = start_prior(scene.rig, start)
    true, shots = _drawn(scene, prior, 80)
    every_other = np.arange(len(shots.position)) % 2 == 0
    rules = replace(FitEffort().psf, close_px=scene.half, iterations=60)
    fit = fit_diffraction(shots.pick(every_other), scene.geometry, start, prior, rules)
    assert fit.converged
    z = (fit.theta - true) / np.sqrt(np.diag(fit.noise_cov))
    assert np.abs(z[:HEAD]).max() < 4.5


def _started_off(factor: float, seed: int, interference: bool = True) -> tuple[DiffractionFit, Float[np.ndarray, " p"]]:
    """A fit from a footprint whose width is off by a factor, and its errors in units of sigma."""
    scene = small_scene(positions=(3, 2), shifts=2, half=(14, 7))
    prior = start_prior(scene.rig, start_model(scene.rig, scene.geometry, scene.wire))
    true, shots = _drawn(scene, prior, seed, interference)
    wire = replace(scene.wire, footprint_per_pitch=scene.wire.footprint_per_pitch * factor)
    start = start_model(scene.rig, scene.geometry, wire)
    rules = PsfRules(positions=8, close_px=scene.half, far_fraction=1.0, iterations=60)
    some = shots.pick(some_shots(shots, rules))
    fit = fit_diffraction(some, scene.geometry, start, start_prior(scene.rig, start), rules)
    return fit, (fit.theta - true) / np.sqrt(np.diag(fit.cov()))


@pytest.mark.medium
@pytest.mark.parametrize(("wider", "seed"), [(1.2, 1), (1.5, 2)])
@in_float64
def test_a_footprint_that_starts_too_wide_does_not_end_beside_the_minimum(wider: float, seed: int) -> None:
    """A descent ended where a model error of a hundredth let a pupil 11 and 13 of its sigmas too wide fit."""
    fit, z = _started_off(wider, seed)
    assert fit.converged
    assert fit.model_error == 0.0
    assert np.abs(z[:HEAD]).max() < 4.5


@pytest.mark.medium
@pytest.mark.parametrize("wider", [0.6, 1.4])
@in_float64
def test_a_first_descent_beside_the_minimum_is_mended_from_where_it_ended(
    wider: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A third of a period away with a pupil of another width, a descent stays, with a model error of a hundredth."""
    scene = small_scene(positions=(3, 2), shifts=2, half=(14, 7))
    start = start_model(scene.rig, scene.geometry, scene.wire)
    prior = start_prior(scene.rig, start)
    true, shots = _drawn(scene, prior, 3)

    def misled(problem: DiffractionProblem, rules: PsfRules) -> Choice[Approach]:
        found = approach(problem, rules).best.fit
        theta = found.end.place.theta.copy()
        theta[PUPIL] *= wider
        theta[FOOTPRINT][1] += 0.3
        end = replace(found.end, place=replace(found.end.place, theta=theta))
        attempt = replace(found, end=end).attempt()
        return Choice(attempt, (attempt,))

    rules = PsfRules(close_px=scene.half)
    monkeypatch.setattr(diffraction, "approach", misled)
    fits = []
    for far in (lambda *_: False, diffraction.far_from_prior):
        monkeypatch.setattr(diffraction, "far_from_prior", far)
        fits.append(fit_diffraction(shots, scene.geometry, start, prior, rules))
    assert fits[0].model_error > 0.005
    z = (fits[1].theta - true) / np.sqrt(np.diag(fits[1].cov()))
    assert fits[1].converged
    assert fits[1].model_error == 0.0
    assert np.abs(z[:HEAD]).max() < 4.5


@pytest.mark.medium
@in_float64
def test_a_fit_averaged_over_the_phase_holds_nothing_of_interference() -> None:
    """Light that is averaged over the phase shows none. Its numbers are right without it."""
    fit, z = _started_off(1.0, 2, interference=False)
    assert fit.converged
    assert fit.phase
    assert "averaged" in fit.phase.best.name
    assert not fit.problem.samples.correction.any()
    assert np.abs(z[1:6]).max() < 4.5
