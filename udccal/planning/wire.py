"""Prediction for the wire: the equations of the joint fit, on a part of the pixels that the fit uses.

The map's sigma follows from the joint covariance of shape, shading and site gains, with the prior of the fit. A
pixel's variance is shot and dark noise over the frames, and PRNU, which no number of frames averages down.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.arrangements import Dark, FlatLight
from udccal.cfa import cfa_named
from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.wire.data import Pixels, odd_step, sample_pixels
from udccal.fitting.wire.jacobian import WireProblem, expected_of, with_harmonics
from udccal.fitting.wire.map_error import map_jacobian, mean_one
from udccal.fitting.wire.parameters import (
    Parameters,
    WireRules,
    ideal_wire,
    parameters_of,
    possible_harmonics,
    wire_start,
)
from udccal.numerics import in_float64
from udccal.planning.design import Limits
from udccal.planning.state import EvenField, RigState
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
        self._state, camera = state, state.rig.camera
        shape, size = (camera.rows, camera.columns), camera.rows * camera.columns
        pixels = sample_pixels(np.ones(shape), state.geometry, _PIXELS, camera.cfa)
        parameters, x = _expected(state, pixels)
        prior = parameters.prior(wire_start(state.rig), _RULES)
        self._problem = WireProblem("wire, planned", parameters, pixels, prior)
        self._x = mean_one(parameters, x, shape)
        self._jacobian = map_jacobian(parameters, self._x, shape)
        self._value = expected_of(parameters.wire(self._x), np.ones(parameters.sites), pixels)
        places = np.stack(np.divmod(np.maximum(pixels.place, 0), camera.columns)[::-1], axis=1)
        self._signal_e = state.full_well_e * EvenField(state).signal(places.astype(float))
        # Each sampled pixel represents this many of the sensor's pixels, and of those that the fit uses.
        self._every = size / pixels.used
        full = size / odd_step(size, _RULES.samples) / pixels.used
        self._spent = state.wire_pixels / pixels.used if state.wire_pixels else full
        share = self._spent / self._every
        self._lowered_by = (
            "more pixels" if share > 0.9 else f"a fit to more than {100 * share:.0f} % of the sensor's pixels"
        )
        if self._spent < 0.9 * full:
            self._lowered_by = "udccal fit takes more of the sensor's pixels, which"

    def sigma(self, captures: Captures) -> float:
        """Root mean square over the sensor; see ``Predictor``."""
        return self._map_sigma(self._noise(captures), self._spent, self._state.model_errors.wire)

    def limits(self, captures: Captures) -> Limits:
        """PRNU and the model error, and sensors of more pixels than the fit uses; see ``Predictor``."""
        noise = self._noise(captures)
        used = min((self._map_sigma(noise, self._every) / self._map_sigma(noise, self._spent)) ** 2, 1.0)
        return Limits(
            self._map_sigma(np.zeros(1), self._spent, self._state.model_errors.wire),
            f"Pixels differ in their response by {100 * self._state.noise.PRNU1288:.2g} % (PRNU), and that does not "
            f"average over frames: {self._lowered_by} would lower it.",
            used,
        )

    def _noise(self, captures: Captures) -> Float[np.ndarray, " n"] | None:
        """Variance of flat minus dark by noise over the signal squared, pixel by pixel; None without flats or darks."""
        state, steps = self._state, self._state.with_captures(captures).steps("wire")
        flat, dark = (next((s for s in steps if isinstance(s.arrangement, kind)), None) for kind in (FlatLight, Dark))
        if flat is None or dark is None:
            return None
        signal = np.maximum(flat.level * self._signal_e, 1e-3)
        lights = (flat, signal), (dark, np.zeros(1))
        variances = (state.variance_e(light, step.exposures_s[0]) / len(step.exposures_s) for step, light in lights)
        return sum(variances) / signal**2

    @in_float64
    def _map_sigma(self, noise: Float[np.ndarray, " some"] | None, count: float, model: float = 0.0) -> float:
        """Sigma in per cent where each pixel represents ``count`` of them; ``model`` is the model error."""
        if noise is None:
            return math.inf
        problem, relative = self._problem, noise + self._state.noise.PRNU1288**2
        weight = np.where(problem.pixels.place >= 0, count / np.maximum(relative * self._value**2, 1e-12), 0.0)
        information = replace(problem, pixels=replace(problem.pixels, weight=weight)).sums(self._x)[0]
        return 100.0 * self._jacobian.sigma(scaled_inverse(information + problem.prior.precision), model)


def _expected(state: RigState, pixels: Pixels) -> tuple[Parameters, Float[np.ndarray, " n"]]:
    """The wire as built, and the parameters that a fit of it is expected to keep.

    A profile's wire contributes the shading and the corrections to a round pupil that its data supported.
    """
    start = wire_start(state.rig)
    possible = possible_harmonics(start)
    harmonics = possible.orders[:_HARMONICS]
    built = with_harmonics(ideal_wire(state.geometry, start, harmonics), harmonics, pixels)
    gains = np.ones(len(cfa_named(state.rig.camera.cfa).sites))
    parameters = parameters_of(built, _RULES, gains.size, possible.bounds[:_HARMONICS])
    keep = parameters.groups < 0
    if state.wire is not None and len(state.wire.harmonics):
        baseline, fields = built.baseline.copy(), built.fields.copy()
        for made, measured in ((baseline, state.wire.baseline), (fields, state.wire.fields)):
            both = tuple(slice(size) for size in np.minimum(made.shape, np.shape(measured)))
            made[both] = measured[both]
        corrected = replace(built, baseline=baseline, fields=fields)
        keep |= parameters.vector(corrected, gains) != parameters.vector(built, gains)
    kept = parameters.kept(keep)
    return kept, kept.vector(built, gains)
