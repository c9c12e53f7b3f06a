"""The wire's shape: where the rays meet the panel, and how large pupil and openings are.

A scan by demodulation finds stand-off and origin; Gauss-Newton refines them with everything else, on a sample.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from udccal.fitting.wire_basis import (
    SHAPE_PARAMETERS,
    SITES,
    Basis,
    Normal,
    Pixels,
    accumulate,
    merit,
    move,
    residuals,
)
from udccal.fitting.wire_harmonics import FIELD_DEGREES, SMOOTH_DEGREE, WireStart, free_basis, plain_basis
from udccal.models.geometry import Geometry
from udccal.models.wire import Wire, carriers, kappa, slopes, waves

# How far the geometry's own rotation may be off (rad); origin in periods: unknown.
_ROTATION_PRIOR, _ORIGIN_PRIOR = 0.02, 0.5
# The rig's tolerances are bounds on a careful build; the fit may go somewhat beyond.
_PRIOR_WIDENING = 2.0
_SCAN_STEP = 0.003
_PUPILS = 7
_OUTLIER = 6.0
_ROUNDS = 15
# Gauss-Newton ends when no shape parameter moves by more than this part of its sigma.
_SETTLED = 0.05
# Beyond this residual variance amplitudes that no pupil explains are tried; they must lower it by the second factor.
_DOUBTFUL, _WORTH = 1.15, 0.95
_FREE_HARMONICS, _FREE_DEGREE = 3, 3
_AMPLITUDE_PRIOR = 0.05
# Chi-squared that the first harmonic must explain in the scan; chance does not reach a third of it in 300 trials.
LEAST_GAIN = 100.0


@dataclass(frozen=True)
class PhaseFit:
    """A wire whose shape is final, the site gains, the covariance of the shape parameters, and the evidence.

    ``basis`` are the linear columns that went with the shape.
    """

    wire: Wire
    gains: Float[np.ndarray, "4"]
    cov: Float[np.ndarray, "10 10"]
    gain_in_chi2: float
    variance: float
    converged: bool
    iterations: int
    basis: Basis


_kappa = jax.jit(lambda wire, ideal: kappa(wire, slopes(wire, ideal)))


def ideal_wire(geometry: Geometry, start: WireStart, harmonics: Float[np.ndarray, "harmonics 2"]) -> Wire:
    """The rig as built, with a round pupil."""
    fields = np.zeros((len(harmonics), 2, 2, FIELD_DEGREES))
    fields[:, 0, 0, 0] = 1.0
    return Wire(
        geometry=geometry,
        rotation=np.zeros(3),
        standoff_per_pitch=np.float64(start.standoff_per_pitch),
        offset=np.zeros(2),
        pupil_per_pitch=np.float64(start.pupil_per_pitch),
        row_open=np.float64(start.row_open),
        column_open=np.float64(start.column_open),
        depth_per_pitch=np.float64(start.depth_per_pitch),
        harmonics=harmonics,
        frequency=np.tile([0.0, 1.0], (len(harmonics), 1)),
        fields=fields,
        amplitudes=np.zeros((0, 2, 1, 1)),
        baseline=np.zeros((SMOOTH_DEGREE + 1, SMOOTH_DEGREE + 1)),
    )


def with_harmonics(wire: Wire, harmonics: Float[np.ndarray, "harmonics 2"], pixels: Pixels) -> Wire:
    """The same shape with other harmonics of a round pupil, and their ranges of kappa over the sample."""
    fields = np.zeros((len(harmonics), 2, 2, FIELD_DEGREES))
    fields[:, 0, 0, 0] = 1.0
    unknown = np.tile([0.0, 1.0], (len(harmonics), 1))
    wire = eqx.tree_at(lambda w: (w.harmonics, w.frequency, w.fields), wire, (harmonics, unknown, fields))
    seen = np.asarray(_kappa(wire, pixels.ideal[:: max(1, len(pixels.ideal) // 2048)][:2048]))
    low, high = seen.min(axis=1), seen.max(axis=1)
    frequency = np.stack([(low + high) / 2, np.maximum(0.51 * (high - low), 0.01)], axis=1)
    return eqx.tree_at(lambda w: w.frequency, wire, frequency)


def add_increment(
    wire: Wire, gains: Float[np.ndarray, "4"], basis: Basis, values: Float[np.ndarray, " n"]
) -> tuple[Wire, Float[np.ndarray, "4"]]:
    """Apply a solution of the linear problem (columns of ``basis`` only)."""
    smooth = len(basis.baseline)
    baseline, amplitudes, fields = np.array(wire.baseline), np.array(wire.amplitudes), np.array(wire.fields)
    baseline[basis.baseline[:, 0], basis.baseline[:, 1]] += values[:smooth]
    site = values[smooth : smooth + SITES - 1]
    amplitudes[tuple(basis.amplitudes.T)] += values[smooth + SITES - 1 : basis.fixed]
    fields[tuple(basis.fields.T)] += values[basis.fixed : basis.size]
    leaves = (baseline, amplitudes, fields)
    wire = eqx.tree_at(lambda w: (w.baseline, w.amplitudes, w.fields), wire, leaves)
    return wire, gains * np.exp(np.append(site, -site.sum()))


def reject_outliers(wire: Wire, gains: Float[np.ndarray, "4"], pixels: Pixels) -> Pixels:
    """Leave out pixels further than 6 robust sigma from the present model (hot, dead, dusty)."""
    residual = np.abs(residuals(wire, gains, pixels))
    spread = 1.4826 * float(np.median(residual[pixels.weight > 0]))
    return eqx.tree_at(lambda p: p.weight, pixels, np.where(residual <= _OUTLIER * spread, pixels.weight, 0.0))


def solve(normal: Normal, prior: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """Solution and inverse of normal equations; ``prior`` is a sigma about zero per parameter (0: none)."""
    matrix = normal.matrix + np.diag(np.where(prior > 0, 1.0 / np.where(prior > 0, prior, 1.0) ** 2, 0.0))
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    # The tiny ridge only decides between columns that the data cannot tell apart.
    inverse = np.linalg.inv(matrix / np.outer(scale, scale) + 1e-12 * np.eye(len(scale))) / np.outer(scale, scale)
    return inverse @ normal.right, inverse


def fit_phase(
    geometry: Geometry,
    start: WireStart,
    few: Pixels,
    many: Pixels,
    harmonics: Float[np.ndarray, "harmonics 2"],
    strongest: int,
) -> PhaseFit:
    """Baseline alone; stand-off and origin by demodulation of the first harmonics; then all of it together.

    Searches on ``few`` pixels, and finishes on ``many``, with the ``strongest`` of ``harmonics``.
    """
    # Without any panel: no waves, and nothing that narrows with obliquity. All harmonics are there, at nothing, so that
    # what is compiled here serves the final fit, too.
    bare = with_harmonics(ideal_wire(geometry, start, harmonics), harmonics, few)
    bare = eqx.tree_at(lambda w: (w.fields, w.depth_per_pitch), bare, (np.zeros_like(bare.fields), np.float64(0.0)))
    gains, plain = np.ones(4), plain_basis()
    for _ in range(4):
        values, _inverse = solve(accumulate(bare, gains, few, plain), np.zeros(plain.size))
        bare, gains = add_increment(bare, gains, plain, values)
    few = reject_outliers(bare, gains, few)
    shape, gain = _scan(bare, gains, start, few, (0.0, 1.0))
    if gain < LEAST_GAIN:
        variance = merit(bare, gains, few) / max(int(np.count_nonzero(few.weight)) - plain.size, 1)
        return PhaseFit(bare, gains, np.zeros((10, 10)), gain, variance, True, 0, plain)
    shape, _gain = _scan(shape, gains, start, few, (1.0, 0.0))
    shape = eqx.tree_at(lambda w: w.depth_per_pitch, shape, np.float64(start.depth_per_pitch))
    wire = with_harmonics(shape, harmonics[:strongest], few)
    tried = _gauss_newton(wire, gains, few, start, plain)
    if tried.variance > _DOUBTFUL:
        free = free_basis(_FREE_HARMONICS, _FREE_DEGREE)
        room = np.zeros((_FREE_HARMONICS, 2, _FREE_DEGREE + 1, _FREE_DEGREE + 1))
        other = _gauss_newton(eqx.tree_at(lambda w: w.amplitudes, wire, room), gains, few, start, free)
        tried = other if other.variance < _WORTH * tried.variance else tried
    many = reject_outliers(tried.wire, tried.gains, many)
    last = _gauss_newton(tried.wire, tried.gains, many, start, tried.basis)
    cov = last.inverse[-SHAPE_PARAMETERS:, -SHAPE_PARAMETERS:] * last.variance
    rounds = tried.rounds + last.rounds
    return PhaseFit(last.wire, last.gains, cov, gain, last.variance, last.converged, rounds, tried.basis)


_carrier = jax.jit(lambda wire, ideal: carriers(wire, slopes(wire, ideal), kappa(wire, slopes(wire, ideal)))[0, 0])
_wave = jax.jit(lambda wire, ideal: waves(wire, slopes(wire, ideal))[:, 0])


def _scan(
    wire: Wire, gains: Float[np.ndarray, "4"], start: WireStart, pixels: Pixels, harmonic: tuple[float, float]
) -> tuple[Wire, float]:
    """Stand-off, pupil and origin that put most of the signal into one harmonic; along X only the origin is open.

    Also how much chi-squared that harmonic would explain, in units of the residual variance.
    """
    residual = residuals(wire, gains, pixels) * (pixels.weight > 0)
    wire = with_harmonics(wire, np.array([harmonic]), pixels)
    along_y = harmonic[1] > 0
    standoffs, pupils = np.array([wire.standoff_per_pitch]), np.array([wire.pupil_per_pitch])
    if along_y:
        reach = 1.2 * start.standoff_tolerance + 0.01
        standoffs = start.standoff_per_pitch * np.arange(1 - reach, 1 + reach, _SCAN_STEP)
        pupils = start.pupil_per_pitch * (1 + 1.2 * start.pupil_tolerance * np.linspace(-1, 1, _PUPILS))
    trials = [eqx.tree_at(lambda w: w.pupil_per_pitch, wire, np.float64(pupil)) for pupil in pupils]
    sizes = np.stack([np.asarray(_carrier(trial, pixels.ideal)) for trial in trials])
    trials = [eqx.tree_at(lambda w: w.standoff_per_pitch, wire, np.float64(standoff)) for standoff in standoffs]
    waves_seen = [np.asarray(_wave(trial, pixels.ideal)) for trial in trials]
    # residual = a cos(phase + t) = a (cos t cos(phase) - sin t sin(phase)): the angle found is t.
    found = np.stack([(sizes * residual) @ (wave[0] - 1j * wave[1]) for wave in waves_seen])
    gain = np.abs(found) / np.sqrt(np.sum(sizes**2, axis=1))
    i, j = np.unravel_index(int(np.argmax(gain)), gain.shape)
    offset = np.array(wire.offset)
    offset[1 if along_y else 0] = float(np.angle(found[i, j])) / (2 * np.pi)
    found_wire = eqx.tree_at(
        lambda w: (w.standoff_per_pitch, w.pupil_per_pitch, w.offset),
        wire,
        (np.float64(standoffs[i]), np.float64(pupils[j]), offset),
    )
    variance = float(np.sum(residual**2)) / max(int(np.count_nonzero(pixels.weight)), 1)
    return found_wire, 2 * float(gain[i, j]) ** 2 / variance


@dataclass(frozen=True)
class _Descent:
    """Where Gauss-Newton ended, with the inverse of its last normal matrix and the residual variance."""

    wire: Wire
    gains: Float[np.ndarray, "4"]
    basis: Basis
    inverse: Float[np.ndarray, "n n"]
    variance: float
    converged: bool
    rounds: int


def _gauss_newton(
    wire: Wire, gains: Float[np.ndarray, "4"], pixels: Pixels, start: WireStart, basis: Basis
) -> _Descent:
    beside = np.full(basis.fixed, 0.0)
    beside[len(basis.baseline) + SITES - 1 :] = _AMPLITUDE_PRIOR
    prior = np.concatenate([beside, _prior(start)])
    samples = max(int(np.count_nonzero(pixels.weight)) - len(prior), 1)
    now = merit(wire, gains, pixels)
    values, inverse, rounds = np.zeros(len(prior)), np.eye(len(prior)), 0
    largest, gained = np.inf, np.inf
    while largest > _SETTLED and rounds < _ROUNDS:
        rounds += 1
        values, inverse = solve(accumulate(wire, gains, pixels, basis, shape=True), prior)
        largest = float(np.max(_steps_in_sigma(values, inverse)))
        for halving in range(6):
            step = values * 0.5**halving
            trial, trial_gains = add_increment(wire, gains, basis, step)
            trial = _numpy(move(trial, step[-SHAPE_PARAMETERS:]))
            then = merit(trial, trial_gains, pixels)
            if then < now:
                wire, gains, now, gained = trial, trial_gains, then, now - then
                break
        else:
            # At the minimum up to rounding, or stuck.
            break
    # What the data hardly show, such as columns that leave no trace, may creep on for ever. A step of one sigma in each
    # shape parameter, or what that gains in chi-squared, is no matter.
    variance = now / samples
    return _Descent(
        wire, gains, basis, inverse, variance, min(largest, gained / (SHAPE_PARAMETERS * variance)) < 1.0, rounds
    )


def _steps_in_sigma(values: Float[np.ndarray, " n"], inverse: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "10"]:
    return np.abs(values[-SHAPE_PARAMETERS:]) / np.sqrt(np.diag(inverse)[-SHAPE_PARAMETERS:])


def _prior(start: WireStart) -> Float[np.ndarray, "10"]:
    sizes = [
        start.standoff_tolerance,
        _ORIGIN_PRIOR,
        _ORIGIN_PRIOR,
        start.pupil_tolerance,
        start.row_tolerance,
        start.column_tolerance,
        start.depth_tolerance,
    ]
    return np.array([_ROTATION_PRIOR] * 3 + sizes) * _PRIOR_WIDENING


def _numpy(wire: Wire) -> Wire:
    return jax.tree.map(lambda leaf: np.asarray(leaf, dtype=np.float64), wire)
