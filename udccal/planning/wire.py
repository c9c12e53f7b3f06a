"""Prediction for the wire: the equations of the joint fit, on a part of the pixels that the fit uses.

The map's sigma follows from the joint covariance of shape, shading and site gains, with the prior of the fit. A
pixel's variance is shot and dark noise over the frames, and PRNU, which no number of frames averages down.
"""

from __future__ import annotations

from typing import final

import equinox as eqx
import numpy as np
from jaxtyping import Float

from udccal.arrangements import Dark, FlatLight
from udccal.cfa import cfa_named
from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.wire.data import Pixels, odd_step, sample_pixels
from udccal.fitting.wire.fit import map_jacobian, mean_one
from udccal.fitting.wire.jacobian import WireProblem, expected_of, with_harmonics
from udccal.fitting.wire.parameters import Parameters, parameters_of
from udccal.fitting.wire.rules import WireRules, ideal_wire, possible_harmonics, wire_start
from udccal.numerics import in_float64
from udccal.planning.design import Floor
from udccal.planning.state import EvenField, RigState, sample_variance_e
from udccal.planning.steps import planned_steps
from udccal.rig import Captures

_PIXELS = 8_000
# The strongest harmonics determine the shape.
_HARMONICS = 24
_RULES = WireRules()


@final
class WirePredictor:
    """Predicts the sigma of the wire map in per cent of its mean."""

    @in_float64
    def __init__(self, state: RigState) -> None:
        self._state = state
        shape = (state.rig.camera.rows, state.rig.camera.columns)
        self._pixels = sample_pixels(np.ones(shape), state.geometry, _PIXELS, state.rig.camera.cfa)
        parameters, x = _expected(state, self._pixels)
        self._parameters, self._x = parameters, mean_one(parameters, x, shape)
        self._prior = parameters.prior(wire_start(state.rig), _RULES)
        self._jacobian = map_jacobian(parameters, self._x, shape)
        self._value = expected_of(parameters.wire(self._x), np.ones(parameters.sites), self._pixels)
        y, x_px = np.divmod(np.maximum(self._pixels.place, 0), shape[1])
        self._signal_e = state.full_well_e * EvenField(state).signal(np.stack([x_px, y], axis=1).astype(float))
        # Each sampled pixel represents this many of the sensor's pixels, and of those that the fit uses.
        self._every = shape[0] * shape[1] / self._pixels.used
        self._spent = self._every / odd_step(shape[0] * shape[1], _RULES.samples)

    def sigma(self, captures: Captures) -> float:
        """Root mean square over the sensor; see ``Predictor``."""
        relative = self._relative_variance(captures)
        return float("inf") if relative is None else self._map_sigma(relative, self._spent)

    def used(self, captures: Captures) -> float:
        """Less than 1 where the sensor has more pixels than the fit uses; see ``Predictor``."""
        relative = self._relative_variance(captures)
        if relative is None:
            return 1.0
        by_all, by_part = (self._map_sigma(relative, count, model=0.0) for count in (self._every, self._spent))
        return min((by_all / by_part) ** 2, 1.0)

    def floor(self) -> Floor:
        """The sigma that PRNU and the model error leave."""
        PRNU1288 = float(np.asarray(self._state.noise.PRNU1288))
        more = "a fit to more of the sensor's pixels (FitEffort's wire_samples)"
        return Floor(
            self._map_sigma(np.full(len(self._value), PRNU1288**2), self._spent),
            f"Pixels differ in their response by {100 * PRNU1288:.2g} % (PRNU), and that does not average over frames: "
            f"{more if self._spent < 0.9 * self._every else 'more pixels'} would lower it.",
        )

    def _relative_variance(self, captures: Captures) -> Float[np.ndarray, " n"] | None:
        """Variance of flat minus dark at each pixel over the signal squared; None without flats or darks."""
        state = self._state
        steps = list(planned_steps("wire", state.with_captures(captures)))
        flat = next((step for step in steps if isinstance(step.arrangement, FlatLight)), None)
        dark = next((step for step in steps if isinstance(step.arrangement, Dark)), None)
        if flat is None or dark is None:
            return None
        signal = np.maximum((flat.level or 0.0) * self._signal_e, 1e-3)
        variance = sample_variance_e(state, signal, flat.exposures_s[0]) / len(flat.exposures_s)
        variance = variance + sample_variance_e(state, np.zeros(1), dark.exposures_s[0]) / len(dark.exposures_s)
        return np.asarray(variance / signal**2 + float(np.asarray(state.noise.PRNU1288)) ** 2)

    @in_float64
    def _map_sigma(self, relative: Float[np.ndarray, " n"], count: float, model: float | None = None) -> float:
        """Sigma in per cent at this relative variance of the pixels, each of which represents ``count`` of them."""
        weight = np.where(self._pixels.place >= 0, count / np.maximum(relative * self._value**2, 1e-12), 0.0)
        pixels = eqx.tree_at(lambda p: p.weight, self._pixels, weight)
        information, _, _ = WireProblem("wire, planned", self._parameters, pixels, self._prior).sums(self._x)
        cov = scaled_inverse(information + self._prior.precision)
        return 100.0 * self._jacobian.sigma(cov, self._state.model_errors.wire if model is None else model)


def _expected(state: RigState, pixels: Pixels) -> tuple[Parameters, Float[np.ndarray, " n"]]:
    """The wire as built, and the parameters that a fit of it is expected to keep.

    A profile's wire contributes the shading and the corrections to a round pupil that its data supported.
    """
    start = wire_start(state.rig)
    possible = possible_harmonics(start)
    harmonics, bounds = possible.orders[:_HARMONICS], possible.bounds[:_HARMONICS]
    built = with_harmonics(ideal_wire(state.geometry, start, harmonics), harmonics, pixels)
    gains = np.ones(len(cfa_named(state.rig.camera.cfa).sites))
    parameters = parameters_of(built, _RULES, gains.size, bounds)
    x = parameters.vector(built, gains)
    keep = parameters.groups < 0
    if state.wire is not None and len(np.asarray(state.wire.harmonics)):
        leaves = _over(built.baseline, state.wire.baseline), _over(built.fields, state.wire.fields)
        keep |= parameters.vector(eqx.tree_at(lambda w: (w.baseline, w.fields), built, leaves), gains) != x
    kept = parameters.kept(keep)
    return kept, kept.vector(built, gains)


def _over(values: object, others: object) -> Float[np.ndarray, "..."]:
    """Values, replaced by the others as far as these reach."""
    made, put = np.array(values), np.asarray(others)
    both = tuple(slice(min(sizes)) for sizes in zip(made.shape, put.shape, strict=True))
    made[both] = put[both]
    return made
