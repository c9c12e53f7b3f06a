"""Slopes of the kernel, steps along them, and what is known of the pitch beforehand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import softmax

from tests.scenes.psf import Scene, pictures, shots_of, small_scene
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.psf.data import PsfData, PsfRules, Shots
from udccal.fitting.psf.fit import fit_psf
from udccal.fitting.psf.kernel import (
    BAR_WIDTH,
    CORNER,
    HEAD,
    PER_PX,
    PITCH,
    PUPIL,
    SLANT,
    WAVELENGTHS_NM,
    Evaluator,
    fit_lattice,
)
from udccal.fitting.psf.problem import DiffractionProblem, kernel_of, stepped
from udccal.fitting.psf.samples import gather
from udccal.fitting.psf.start import start_model, start_prior, wavelengths_nm
from udccal.models.lattice import lattice_for
from udccal.numerics import in_float64
from udccal.result import FitStatus
from udccal.rig import RigDescription

_HALF = (8, 6)
# Forward and backward, of each parameter before the spectra.
_LENS = [1e-4, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3]
_STEPS = np.array([1e-6, 1e-5, 1e-5, 1e-5, *_LENS, 1e-3, *4 * [1e-5], *6 * [1e-4]])
_SHAPE = slice(BAR_WIDTH.start, SLANT.stop)
# Their logarithms are parameters.
_SHAPES = range(CORNER, SLANT.stop)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return small_scene(positions=(3, 1), shifts=1, half=_HALF)


@pytest.fixture(scope="module")
def prior(scene: Scene) -> Prior:
    return start_prior(scene.rig, start_model(scene.rig, scene.geometry, scene.wire))


@pytest.fixture(scope="module")
def shots(scene: Scene, prior: Prior) -> Shots:
    rng = np.random.default_rng(4)
    return shots_of(scene, pictures(scene, prior.mean, rng), rng)


@pytest.mark.parametrize(
    ("interference", "shaped"),
    [pytest.param(True, False, marks=pytest.mark.slow), (False, False), (False, True), (True, True)],
)
@pytest.mark.medium
def test_slopes_of_the_kernel_are_those_of_differences(
    scene: Scene, prior: Prior, shots: Shots, interference: bool, shaped: bool
) -> None:
    found, wanted = slopes_both_ways(scene, prior, shots, interference, shaped)
    assert (np.abs(found[_SHAPE]).max(axis=(1, 2, 3)) > 0).all() == shaped
    if not shaped:
        assert not found[_SHAPE].any()
        found, wanted = (np.delete(one, _SHAPE, axis=0) for one in (found, wanted))
    for own, other in zip(found, wanted, strict=True):
        assert np.abs(own - other).max() <= 0.01 * np.abs(other).max()
    swapped = np.abs(found[1] - wanted[2]).max()
    assert swapped > 0.1 * np.abs(wanted[2]).max()  # that the comparison can fail


@in_float64
def slopes_both_ways(
    scene: Scene, prior: Prior, shots: Shots, interference: bool, shaped: bool
) -> tuple[np.ndarray, np.ndarray]:
    problem = problem_of(scene, prior, shots, interference)
    one, theta, evaluator = problem.samples.at(0), prior.mean.copy(), replace(problem.evaluator, shaped=shaped)
    theta[_SHAPE] = np.array([0.03, 0.05, 0.1, -0.08, *np.log([0.12, 0.03, 0.02])]) * shaped
    made, chain = (np.asarray(p) for p in evaluator.jacobian(theta, one.frame, one.disc_px, one.overlaps))
    by_factor = made[..., len(WAVELENGTHS_NM) :].reshape(*made.shape[:2], -1, 3)
    found = np.einsum("yxfc,fcp->pyxc", by_factor, chain)
    wanted = []
    for step in np.eye(HEAD, theta.size) * _STEPS[:, None]:
        more, less = (
            np.asarray(evaluator.kernel(theta + sign * step, one.frame, one.disc_px, one.overlaps)) for sign in (1, -1)
        )
        wanted.append((more - less) / (2 * step.sum()))
    return found, np.stack(wanted)


def problem_of(scene: Scene, prior: Prior, shots: Shots, interference: bool) -> DiffractionProblem:
    """Of the first position alone, overlaps at the prior's mean."""
    evaluator = Evaluator(WAVELENGTHS_NM, fit_lattice(_HALF), interference)
    made = gather(shots, scene.geometry, np.ones(shots.rate.shape, dtype=bool)).at(slice(1))
    return DiffractionProblem(made, evaluator, prior).with_overlaps(prior.mean)


@pytest.mark.medium
def test_light_on_the_fits_lattice_is_that_of_a_finer_one(scene: Scene, prior: Prior, shots: Shots) -> None:
    kept, coarse = light_errors(scene, prior, shots)
    assert kept < 0.001
    assert coarse > 0.002  # that 4 nodes to a pixel would not do


@in_float64
def light_errors(scene: Scene, prior: Prior, shots: Shots) -> list[float]:
    """Relative L2 error of samples' light on the fit's lattice, and on one of 4 nodes to a pixel."""
    problem, lit = problem_of(scene, prior, shots, True), []
    one, kept = problem.samples.at(0), problem.evaluator.lattice
    rows, columns = kept.rows / kept.per_px_y, kept.columns / kept.per_px_x
    for per_px in (12, PER_PX, 4):
        evaluator = replace(problem.evaluator, lattice=lattice_for(rows, columns, per_px, per_px))
        overlaps = evaluator.overlaps(prior.mean, one.frame)
        kernel = kernel_of(evaluator, prior.mean, replace(one, overlaps=np.asarray(overlaps)))
        lit.append(one.unit_light(kernel, np.zeros((len(one.points), 2))).ravel())
    return [float(np.linalg.norm(light - lit[0]) / np.linalg.norm(lit[0])) for light in lit[1:]]


@pytest.mark.medium
def test_slopes_by_pupil_and_pitch_follow_overlaps(scene: Scene, prior: Prior, shots: Shots) -> None:
    found, wanted = overlap_slopes(scene, prior, shots)
    for own, other in zip(found, wanted, strict=True):
        assert np.linalg.norm(own - other) <= 0.01 * np.linalg.norm(other)
    assert np.linalg.norm(wanted[0]) > 0.0


@in_float64
def overlap_slopes(scene: Scene, prior: Prior, shots: Shots) -> tuple[np.ndarray, np.ndarray]:
    """What the fit adds for interference per mm of (pitch, pupil) and unit of light, and differences of kernels."""
    problem, theta = problem_of(scene, prior, shots, True), prior.mean
    own = np.zeros((1, shots.position.tolist().count(0), 6))
    one = problem.about(theta, own).samples.at(0)
    wanted = []
    for number, step_mm in ((PITCH, 0.0004), (PUPIL, 0.002)):
        lit = []
        for move in (step_mm, -step_mm):
            other = theta.copy()
            other[number] += move
            # The kernel of the same numbers: what changes is the overlaps.
            overlaps = problem.evaluator.overlaps(other, one.frame)
            kernel = kernel_of(problem.evaluator, theta, replace(one, overlaps=np.asarray(overlaps)))
            lit.append(one.unit_light(kernel, own[0, :, :2]))
        wanted.append((lit[0] - lit[1]) / (2 * step_mm))
    return np.moveaxis(np.asarray(one.by_overlaps), -1, 0), np.stack(wanted)


@pytest.mark.medium
def test_derivatives_of_a_place_nearby_serve_with_the_light_of_the_place_itself(
    scene: Scene, prior: Prior, shots: Shots
) -> None:
    (cost, right), (near_cost, near_right), (far_cost, far_right) = equations_near(scene, prior, shots)
    assert near_cost == pytest.approx(cost, rel=1e-9)
    assert far_cost == pytest.approx(cost, rel=1e-9)
    assert np.linalg.norm(near_right - right) < 1e-4 * np.linalg.norm(right)
    assert np.linalg.norm(far_right - right) > 1e-3 * np.linalg.norm(right)  # that the comparison can fail


@in_float64
def equations_near(scene: Scene, prior: Prior, shots: Shots) -> list[tuple[float, np.ndarray]]:
    """Cost and right side at one place: with its own derivatives, with those of a place nearby, and of one far off."""
    problem, theta = problem_of(scene, prior, shots, False), prior.mean
    own = np.zeros((1, shots.position.tolist().count(0), 6))
    own[..., 2:5] = shots.rate.max()
    alone, found = problem.equations_at(problem.at(theta, own)), []
    for off in (1e-4, 0.1):
        other = theta.copy()
        other[PUPIL] *= 1.0 + off
        made = problem.equations_at(problem.at(theta, own, problem.at(other, own)))
        found.append((made.cost, made.right))
    return [(alone.cost, alone.right), *found]


@pytest.mark.medium
def test_derivatives_of_a_place_nearby_follow_the_growth_of_shapes(scene: Scene, prior: Prior, shots: Shots) -> None:
    for here, near, kept in shaped_slopes_near(scene, prior, shots):
        assert np.linalg.norm(near - here) < 0.2 * np.linalg.norm(here)
        assert np.linalg.norm(kept - here) > 0.25 * np.linalg.norm(here)  # that the comparison can fail


@in_float64
def shaped_slopes_near(scene: Scene, prior: Prior, shots: Shots) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Derivatives by each shape: at a place, there by one where that shape is smaller, and of that other place."""
    problem = problem_of(scene, prior, shots, False)
    problem = replace(problem, evaluator=replace(problem.evaluator, shaped=True))
    theta, own = prior.mean.copy(), np.zeros((1, shots.position.tolist().count(0), 6))
    theta[_SHAPES], own[..., 2:5] = np.log([0.12, 0.03, 0.02]), shots.rate.max()
    here, found = problem.at(theta, own), []
    for number in _SHAPES:
        other = theta.copy()
        other[number] -= 0.3
        far = problem.at(other, own)
        near = problem.at(theta, own, far)
        found.append((here.by_theta[..., number], near.by_theta[..., number], far.by_theta[..., number]))
    return found


@pytest.mark.parametrize("wanted", [0.2, 0.9, 1.1, 40.0])
def test_a_step_brings_a_shape_to_the_lowest_cost(wanted: float) -> None:
    """Of a cost that is quadratic in a power of the shape, which is 1 now."""
    change, power = 1.0 - wanted, np.array([2.0, 1.0, 1.0])
    # Half the gradient and half the Hessian of change^2 by the logarithm, as the equations of a step have them.
    right = -power * change
    curvature = power**2 + power * np.maximum(-right, 0.0)
    theta, step = np.zeros(HEAD + 15), np.zeros(HEAD + 15)
    step[_SHAPES] = right / curvature
    np.testing.assert_allclose(np.exp(power * stepped(theta, step)[_SHAPES]), wanted, rtol=1e-9)


def test_a_step_lets_no_shape_vanish_at_once() -> None:
    theta, step = np.zeros(HEAD + 15), np.full(HEAD + 15, -5.0)
    np.testing.assert_allclose(np.exp(stepped(theta, step)[_SHAPES]), [0.1**0.5, 0.1, 0.1])
    small = np.where(np.arange(HEAD + 15) % 2, 1e-5, -1e-5)
    np.testing.assert_allclose(stepped(theta, small)[_SHAPES], small[_SHAPES], rtol=1e-4)


def test_a_step_makes_spectra_grow_by_what_it_says() -> None:
    rng = np.random.default_rng(1)
    logs = rng.normal(0, 1, (3, 5))
    theta, step = np.concatenate([np.zeros(HEAD), logs.ravel()]), np.zeros(HEAD + 15)
    step[HEAD : HEAD + 5] = [30.0, 0.0, 0.0, 0.0, 0.0]
    before = softmax(logs, axis=1)
    after = softmax(stepped(theta, step)[HEAD:].reshape(3, 5), axis=1)
    np.testing.assert_allclose(after[1:], before[1:])
    # Thirty-fold, not by the thirtieth power of e.
    ratio = after[0, 0] / after[0, 1:] / (before[0, 0] / before[0, 1:])
    assert (ratio > 10).all()
    assert np.log(ratio.max()) < 30 * 0.99
    small = stepped(theta, 1e-4 * step)
    np.testing.assert_allclose(small, theta + 1e-4 * step, atol=1e-5)


def test_a_step_keeps_lengths_and_openings_positive() -> None:
    theta, step = np.full(HEAD + 15, 0.8), np.full(HEAD + 15, -2.0)
    moved = stepped(theta, step)
    np.testing.assert_allclose(moved[[0, 1, 2, PUPIL]], 0.4)
    assert moved[3] == pytest.approx(-1.2)  # the depth has a sign
    np.testing.assert_allclose(stepped(theta, -step)[[0, 1, 2, PUPIL]], 1.6)


def with_pitch_tolerance(rig: RigDescription, share: float) -> RigDescription:
    pitch = rig.panel.pitch_mm
    known = pitch.model_copy(update={"tolerance": share * pitch.value})
    return rig.model_copy(update={"panel": rig.panel.model_copy(update={"pitch_mm": known})})


def test_a_pitch_that_may_be_far_off_takes_more_wavelengths(scene: Scene) -> None:
    assert wavelengths_nm(scene.rig, PsfRules()) is WAVELENGTHS_NM
    wide = wavelengths_nm(with_pitch_tolerance(scene.rig, 0.25), PsfRules())
    assert (wide[0], wide[-1]) == (300.0, 875.0)
    np.testing.assert_allclose(np.diff(wide), 25.0)


def test_a_pitch_of_which_nothing_is_known_is_said(scene: Scene, shots: Shots) -> None:
    rig = with_pitch_tolerance(scene.rig, 0.7)
    rules = PsfRules(half_px=_HALF, close_px=_HALF)
    result = fit_psf(PsfData(shots), rig, scene.geometry, scene.wire, rules)
    assert result.status is FitStatus.POOR_FIT
    assert "0.63 ± 0.441 mm" in result.notes[0]
    assert np.isfinite(np.asarray(result.term.diffraction.spectrum)).all()
    few = PsfData(shots.pick(shots.position < 2))
    assert fit_psf(few, scene.rig, scene.geometry, scene.wire).status is FitStatus.TOO_FEW_DATA
