"""The last step of the wire fit: shape, pupil's corrections and shading together, on all the pixels that are spent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.iteration_log import LOG
from udccal.fitting.wire.basis import LEAST_VARIANCE, Basis, Normal, Pixels, accumulate
from udccal.fitting.wire.noise import FlatNoise, Judged, judge
from udccal.fitting.wire.phase import PhaseFit, add_increment, moved, solve
from udccal.fitting.wire.prior import Prior
from udccal.fitting.wire.select import select
from udccal.fitting.wire.slopes import SHAPE_PARAMETERS
from udccal.models.wire import Wire
from udccal.result import Candidate

# A step that moves no parameter by more of its sigma than this is the last; one that still moves some by more than
# the second number when the rounds are over has not converged.
_SETTLED, _UNSETTLED = 0.1, 1.0
_ROUNDS = 6
_HALVINGS = 5


@final
@dataclass(frozen=True)
class Joint:
    """A fitted wire with the covariance of everything that was fitted.

    ``cov`` goes by the columns of ``basis`` and then, where there is a panel, by the ten shape parameters; so do
    ``precision`` (of the prior) and the tiles' parts of the score.
    """

    wire: Wire
    gains: Float[np.ndarray, "4"]
    basis: Basis
    shape: bool
    cov: Float[np.ndarray, "n n"]
    variance: float
    judged: Judged
    candidates: tuple[Candidate, ...]
    converged: bool
    rounds: int
    precision: Float[np.ndarray, " n"]
    by_tile: Float[np.ndarray, "tiles n"]


@final
@dataclass(frozen=True)
class _State:
    """Where the fit is; ``objective`` is chi-squared and what the prior adds."""

    wire: Wire
    gains: Float[np.ndarray, "4"]
    normal: Normal
    objective: float


def fit_joint(phase: PhaseFit, pixels: Pixels, noise: FlatNoise, basis: Basis, wire: Wire) -> Joint:
    """Choose the columns of ``basis`` that the data ask for, and fit them with the shape until nothing moves.

    Args:
        phase: shape and prior; its amplitudes are in ``wire``.
        pixels: to spend.
        noise: weighs them.
        basis: everything that may be needed, in groups.
        wire: where to start, with all harmonics.
    """
    shape = phase.present
    judged = judge(wire, phase.gains, pixels, noise)
    state = _at(wire, phase.gains, judged.pixels, basis, shape, phase.prior, phase.variance)
    kept, values, candidates = _choose(state, basis, shape, phase.prior, phase.variance)
    wire, gains = _stepped(state, basis, values, shape)
    return settle(phase, wire, gains, pixels, noise, kept, candidates)


def settle(
    phase: PhaseFit,
    wire: Wire,
    gains: Float[np.ndarray, "4"],
    pixels: Pixels,
    noise: FlatNoise,
    basis: Basis,
    candidates: tuple[Candidate, ...],
) -> Joint:
    """Gauss-Newton on all columns of ``basis`` and the shape, from a wire that has them."""
    shape, prior = phase.present, phase.prior
    judged = judge(wire, gains, pixels, noise)
    state = _at(wire, gains, judged.pixels, basis, shape, prior, phase.variance)
    for rounds in range(1, _ROUNDS + 1):
        variance = _variance(state.normal)
        precision, offsets = prior.precision(basis, shape), prior.offsets(state.wire, basis, shape)
        values, inverse = solve(state.normal, precision, offsets, variance)
        largest = float(np.max(np.abs(values) / np.sqrt(np.diag(inverse))))
        LOG.debug("wire, joint: iteration %d, residual variance %.9g, to move by %.3g sigma", rounds, variance, largest)
        following = None
        if largest > _SETTLED and rounds < _ROUNDS:
            following = _downhill(state, values, judged.pixels, basis, shape, prior, variance)
        if following is None:
            break
        state = following
    settled = largest < _UNSETTLED
    wire, gains = _stepped(state, basis, values, shape) if settled else (state.wire, state.gains)
    tiles = state.normal.by_tile
    return Joint(wire, gains, basis, shape, inverse, variance, judged, candidates, settled, rounds, precision, tiles)


def _variance(normal: Normal) -> float:
    return max(normal.power / max(normal.samples - len(normal.right), 1), LEAST_VARIANCE)


def _at(
    wire: Wire, gains: Float[np.ndarray, "4"], pixels: Pixels, basis: Basis, shape: bool, prior: Prior, variance: float
) -> _State:
    normal = accumulate(wire, gains, pixels, basis, shape)
    return _State(wire, gains, normal, normal.power / variance + prior.cost(wire, basis, shape))


def _stepped(
    state: _State, basis: Basis, values: Float[np.ndarray, " n"], shape: bool
) -> tuple[Wire, Float[np.ndarray, "4"]]:
    wire, gains = add_increment(state.wire, state.gains, basis, values)
    return (moved(wire, values[-SHAPE_PARAMETERS:]) if shape else wire), gains


def _downhill(
    state: _State,
    values: Float[np.ndarray, " n"],
    pixels: Pixels,
    basis: Basis,
    shape: bool,
    prior: Prior,
    variance: float,
) -> _State | None:
    """After the step, or as much of it as lowers the objective; none where nothing of it does."""
    now = state.normal.power / variance + prior.cost(state.wire, basis, shape)
    for halving in range(_HALVINGS):
        wire, gains = _stepped(state, basis, values * 0.5**halving, shape)
        then = _at(wire, gains, pixels, basis, shape, prior, variance)
        if then.objective <= now:
            return then
    return None


def _choose(
    state: _State, basis: Basis, shape: bool, prior: Prior, variance: float
) -> tuple[Basis, Float[np.ndarray, " all"], tuple[Candidate, ...]]:
    """The columns that pay for themselves, and the step to their solution, on which the others go to nothing.

    The shape always stays.
    """
    precision, offsets = prior.precision(basis, shape), prior.offsets(state.wire, basis, shape)
    matrix = state.normal.matrix / variance + np.diag(precision)
    right = state.normal.right / variance - precision * offsets
    groups = np.concatenate([basis.groups, np.full(SHAPE_PARAMETERS if shape else 0, -1)])
    # What is in the wire already counts as the column's own: the equations are moved to where there is none of it.
    already = np.where(groups >= 0, _already(state.wire, basis, offsets), 0.0)
    moved_right = right + matrix @ already
    power = state.objective + float((right + moved_right) @ already)
    chosen = select(matrix, moved_right, power, state.normal.samples, groups)
    return basis.kept(chosen.keep[: basis.size]), chosen.values - already, chosen.candidates


def _already(wire: Wire, basis: Basis, offsets: Float[np.ndarray, " all"]) -> Float[np.ndarray, " all"]:
    """The present coefficients; the prior's centre is where there is nothing of amplitudes and fields."""
    found = offsets.copy()
    found[: basis.gains_at] = np.asarray(wire.baseline)[tuple(basis.baseline.T)]
    return found
