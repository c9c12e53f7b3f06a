"""The wire's shape: where the rays meet the panel, and how large pupil and openings are.

A scan by demodulation finds stand-off and origin; Gauss-Newton refines them with everything else, on a sample.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.iteration_log import LOG
from udccal.fitting.wire.basis import LEAST_VARIANCE, SITES, Basis, Normal, Pixels, accumulate, merit
from udccal.fitting.wire.harmonics import WireStart, free_basis, plain_basis
from udccal.fitting.wire.noise import FlatNoise, judge
from udccal.fitting.wire.prior import Prior, rig_prior
from udccal.fitting.wire.scan import Place, beside, ideal_wire, scan_columns, scan_rows, with_harmonics
from udccal.fitting.wire.slopes import SHAPE_PARAMETERS, move
from udccal.models.geometry import Geometry
from udccal.models.wire import Wire

_ROUNDS, _TRIAL_ROUNDS = 15, 3
# Of minus twice the logarithm of the posterior: places that differ by less may change their order with more pixels.
_RIVAL = 60.0
# After a few rounds only, this much.
_UNFINISHED = 400.0
# Gauss-Newton ends when no shape parameter moves by more than this part of its sigma.
_SETTLED = 0.05
# Beyond this residual variance amplitudes that no pupil explains are tried; they must lower it by the second factor.
_DOUBTFUL, _WORTH = 1.15, 0.95
_FREE_HARMONICS, _FREE_DEGREE = 3, 3
# Chi-squared that the first harmonic must explain in the scan; chance does not reach a third of it in 300 trials.
LEAST_GAIN = 100.0
# The columns are faint: their origin is looked for anew where more pixels speak.
_SHIFTS = tuple(np.arange(8) / 8)


@final
@dataclass(frozen=True)
class PhaseFit:
    """A wire whose shape is nearly final, the site gains, the prior around it, and the evidence.

    ``basis`` are the linear columns that went with the shape; ``converged`` is of the shape on the sample seen so far.
    """

    wire: Wire
    gains: Float[np.ndarray, "4"]
    prior: Prior
    gain_in_chi2: float
    variance: float
    converged: bool
    iterations: int
    basis: Basis

    @property
    def present(self) -> bool:
        """Whether rows are seen at all."""
        return self.gain_in_chi2 >= LEAST_GAIN


@final
@dataclass(frozen=True)
class _Descent:
    """Where Gauss-Newton ended, with chi-squared, residual variance and the prior's cost there."""

    wire: Wire
    gains: Float[np.ndarray, "4"]
    basis: Basis
    chi2: float
    variance: float
    cost: float
    converged: bool
    rounds: int


def fit_phase(
    geometry: Geometry,
    start: WireStart,
    noise: FlatNoise,
    few: Pixels,
    many: Pixels,
    harmonics: Float[np.ndarray, "harmonics 2"],
    strongest: int,
) -> PhaseFit:
    """Baseline alone; stand-off and origin by demodulation of the first harmonics; then all of it together.

    Searches on ``few`` pixels with the ``strongest`` of ``harmonics``, and finishes on ``many`` with all of them. Rows
    that ``few`` do not show are looked for in ``many``.
    """
    prior = rig_prior(start)
    for sample in (few, many):
        bare, gains, sample = _shading(geometry, start, noise, sample, harmonics)
        places = scan_rows(bare, gains, start, prior, sample)
        if places and places[0].gain >= LEAST_GAIN:
            break
    best = places[0].gain if places else 0.0
    if best < LEAST_GAIN:
        variance = max(merit(bare, gains, sample) / max(sample.used - plain_basis().size, 1), LEAST_VARIANCE)
        return PhaseFit(bare, gains, prior, best, variance, True, 0, plain_basis())
    rivals = _search(places, gains, start, prior, sample, harmonics[:strongest])
    wire = with_harmonics(rivals[0].wire, harmonics, few)
    many = judge(wire, rivals[0].gains, many, noise).pixels
    finished = []
    for tried in rivals:
        wire = _best_columns(with_harmonics(tried.wire, harmonics, few), tried.gains, many, prior)
        finished.append(_gauss_newton(wire, tried.gains, many, prior.around(wire), tried.basis, _ROUNDS))
    last = _rivals(finished)[0]
    rounds = max(tried.rounds for tried in rivals) + last.rounds
    prior = prior.around(last.wire)
    return PhaseFit(last.wire, last.gains, prior, best, last.variance, last.converged, rounds, last.basis)


def _rivals(tried: list[_Descent], margin: float = _RIVAL) -> list[_Descent]:
    """Those that the data seen so far cannot tell from the best, best first."""
    unit = min(t.variance for t in tried)
    scores = [t.chi2 / unit + t.cost for t in tried]
    order = np.argsort(scores, kind="stable")
    return [tried[i] for i in order if scores[i] - scores[order[0]] < margin]


def _shading(
    geometry: Geometry, start: WireStart, noise: FlatNoise, sample: Pixels, harmonics: Float[np.ndarray, "harmonics 2"]
) -> tuple[Wire, Float[np.ndarray, "4"], Pixels]:
    """Without any panel: no waves, and nothing that narrows with obliquity."""
    # All harmonics are there, at nothing, so that what is compiled here serves the final fit, too.
    bare = with_harmonics(ideal_wire(geometry, start, harmonics), harmonics, sample)
    bare = eqx.tree_at(lambda w: (w.fields, w.depth_per_pitch), bare, (np.zeros_like(bare.fields), np.float64(0.0)))
    bare = _open(bare)
    gains, plain = np.ones(4), plain_basis()
    for _ in range(4):
        values = solve(accumulate(bare, gains, sample, plain), np.zeros(plain.size), np.zeros(plain.size), 1.0)[0]
        bare, gains = add_increment(bare, gains, plain, values)
        sample = judge(bare, gains, sample, noise).pixels
    return bare, gains, sample


def _open(bare: Wire) -> Wire:
    """The baseline made up for what the openings let through."""
    baseline = np.array(bare.baseline)
    baseline[0, 0] = -np.log(float(bare.row_open) * float(bare.column_open))
    return eqx.tree_at(lambda w: w.baseline, bare, baseline)


def _search(
    places: list[Place],
    gains: Float[np.ndarray, "4"],
    start: WireStart,
    prior: Prior,
    sample: Pixels,
    harmonics: Float[np.ndarray, "harmonics 2"],
) -> list[_Descent]:
    """Gauss-Newton from the places that a scan found: a few rounds from each, and to the end from the best.

    A pupil one period larger, with the origin half a period on, has nearly the same first harmonic: where few pixels
    cannot tell, all such rivals come back, best first.
    """
    plain = plain_basis()
    tried = []
    for place in (places[0], *beside(places[0]), *places[1:]):
        placed = scan_columns(place.wire, gains, sample)
        placed = eqx.tree_at(lambda w: w.depth_per_pitch, placed, np.float64(start.depth_per_pitch))
        wire = with_harmonics(placed, harmonics, sample)
        tried.append(_gauss_newton(wire, gains, sample, prior.around(wire), plain, _TRIAL_ROUNDS))
    ended = [
        _gauss_newton(t.wire, t.gains, sample, prior.around(t.wire), plain, _ROUNDS)
        for t in _rivals(tried, _UNFINISHED)
    ]
    rivals = _rivals(ended)
    best = rivals[0]
    if best.variance <= _DOUBTFUL:
        return rivals
    free = free_basis(_FREE_HARMONICS, _FREE_DEGREE)
    room = np.zeros((_FREE_HARMONICS, 2, _FREE_DEGREE + 1, _FREE_DEGREE + 1))
    wire = eqx.tree_at(lambda w: w.amplitudes, best.wire, room)
    other = _gauss_newton(wire, best.gains, sample, prior.around(wire), free, _ROUNDS)
    return [other] if other.variance < _WORTH * best.variance else rivals


def _best_columns(wire: Wire, gains: Float[np.ndarray, "4"], pixels: Pixels, prior: Prior) -> Wire:
    """Origin along X, with the columns as wide as built.

    In few pixels, faint columns may have been seen half a period off, with openings wider than their period.
    """
    at, built = np.asarray(wire.offset), np.float64(prior.centre[8])
    shifted = [
        eqx.tree_at(lambda w: (w.offset, w.column_open), wire, (at + np.array([shift, 0.0]), built))
        for shift in _SHIFTS
    ]
    return min(shifted, key=lambda w: merit(w, gains, pixels))


def _gauss_newton(
    wire: Wire, gains: Float[np.ndarray, "4"], pixels: Pixels, prior: Prior, basis: Basis, rounds: int
) -> _Descent:
    samples = max(pixels.used - basis.size - SHAPE_PARAMETERS, 1)
    precision = prior.precision(basis, shape=True)
    chi2 = merit(wire, gains, pixels)
    variance = max(chi2 / samples, LEAST_VARIANCE)
    now = chi2 / variance + prior.cost(wire, basis, shape=True)
    largest, gained, done = np.inf, np.inf, 0
    while largest > _SETTLED and done < rounds:
        done += 1
        normal = accumulate(wire, gains, pixels, basis, shape=True)
        values, inverse = solve(normal, precision, prior.offsets(wire, basis, shape=True), variance)
        largest = float(np.max(steps_in_sigma(values, inverse)))
        LOG.debug("wire, phase: iteration %d, chi2 %.9g, to move by %.3g sigma", done, now, largest)
        for halving in range(6):
            step = values * 0.5**halving
            trial, trial_gains = add_increment(wire, gains, basis, step)
            trial = moved(trial, step[-SHAPE_PARAMETERS:])
            chi2 = merit(trial, trial_gains, pixels)
            then = chi2 / variance + prior.cost(trial, basis, shape=True)
            if then < now:
                wire, gains, gained = trial, trial_gains, now - then
                variance = max(chi2 / samples, LEAST_VARIANCE)
                now = chi2 / variance + prior.cost(wire, basis, shape=True)
                break
        else:
            # At the minimum up to rounding, or stuck.
            break
    # What the data hardly show may creep on for ever. A step of one sigma in each shape parameter, or what that gains
    # in chi-squared, is no matter.
    settled = min(largest, gained / SHAPE_PARAMETERS) < 1.0
    cost = prior.cost(wire, basis, shape=True)
    return _Descent(wire, gains, basis, variance * samples, variance, cost, settled, done)


def add_increment(
    wire: Wire, gains: Float[np.ndarray, "4"], basis: Basis, values: Float[np.ndarray, " n"]
) -> tuple[Wire, Float[np.ndarray, "4"]]:
    """Apply a solution of the linear problem (columns of ``basis`` only)."""
    smooth = basis.gains_at
    baseline, amplitudes, fields = np.array(wire.baseline), np.array(wire.amplitudes), np.array(wire.fields)
    baseline[basis.baseline[:, 0], basis.baseline[:, 1]] += values[:smooth]
    site = values[smooth : smooth + SITES - 1]
    amplitudes[tuple(basis.amplitudes.T)] += values[smooth + SITES - 1 : basis.fixed]
    fields[tuple(basis.fields.T)] += values[basis.fixed : basis.size]
    leaves = (baseline, amplitudes, fields)
    wire = eqx.tree_at(lambda w: (w.baseline, w.amplitudes, w.fields), wire, leaves)
    return wire, gains * np.exp(np.append(site, -site.sum()))


def moved(wire: Wire, steps: Float[np.ndarray, "10"]) -> Wire:
    """``move`` with numpy leaves."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, dtype=np.float64), move(wire, steps))


def solve(
    normal: Normal, precision: Float[np.ndarray, " n"], offsets: Float[np.ndarray, " n"], variance: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """Step to the maximum of the posterior, and its covariance.

    Args:
        normal: the data's equations in units of the expected noise.
        precision: inverse prior variance per parameter (0: none).
        offsets: where the parameters are, from the prior's centre.
        variance: of the residuals in units of the expected one.
    """
    matrix = normal.matrix / variance + np.diag(precision)
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    # The tiny ridge only decides between columns that the data cannot tell apart.
    inverse = np.linalg.inv(matrix / np.outer(scale, scale) + 1e-12 * np.eye(len(scale))) / np.outer(scale, scale)
    return inverse @ (normal.right / variance - precision * offsets), inverse


def steps_in_sigma(values: Float[np.ndarray, " n"], inverse: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "10"]:
    """The last ten of a step, the shape's, over their sigma."""
    return np.abs(values[-SHAPE_PARAMETERS:]) / np.sqrt(np.diag(inverse)[-SHAPE_PARAMETERS:])
