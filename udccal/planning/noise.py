"""Prediction for noise: gain K and read noise from pairs of flats and darks, by the photon transfer's equations.

A sample variance with n degrees of freedom tells n / (2 variance^2) about its expectation, which is a straight line
against the signal. Each place that is looked at is a bin of a pair of flats; a pair of darks is one bin.
"""

from __future__ import annotations

import math
from typing import final

import numpy as np

from udccal.arrangements import Dark, FlatLight
from udccal.fitting.engine.gaussian import cramer_rao
from udccal.fitting.noise.data import NoiseRules
from udccal.fitting.noise.response import temporal_variance
from udccal.planning.design import Limits
from udccal.planning.state import EvenField, RigState, sensor_samples
from udccal.rig import Captures

_SAMPLES_ACROSS = 64
_RULES = NoiseRules()


@final
class NoisePredictor:
    """Predicts the relative sigma of K in per cent."""

    def __init__(self, state: RigState) -> None:
        self._state = state
        pixels = sensor_samples(state.rig, _SAMPLES_ACROSS)
        # Samples are neighbours in both directions, so that every site of the CFA is among them.
        sites = np.concatenate([pixels + shift for shift in np.mgrid[0:2, 0:2].reshape(2, -1).T])
        self._light = EvenField(state).signal(sites)

    def sigma(self, captures: Captures) -> float:
        """Sigma of K in per cent of K; see ``Predictor``."""
        noise, camera = self._state.noise, self._state.rig.camera
        K, samples = noise.K_DN_per_e, camera.rows * camera.columns
        pairs = [step for step in self._state.with_captures(captures).steps("noise") if len(step.exposures_s) == 2]
        flats, darks = ([step for step in pairs if isinstance(step.arrangement, kind)] for kind in (FlatLight, Dark))
        per_s = K * noise.dark_current_e_per_s
        flat_DN, dark_DN = (per_s * np.array([step.exposures_s[0] for step in some]) for some in (flats, darks))
        full_DN = K * self._state.full_well_e
        light_DN = full_DN * np.outer([step.level for step in flats], self._light)
        usable = light_DN <= _RULES.fit_up_to * full_DN
        if usable.any(axis=1).sum() < _RULES.levels:
            return math.inf
        signal_DN = np.append((light_DN + flat_DN[:, None])[usable], dark_DN)
        dof = np.append(np.full(usable.sum(), samples / len(self._light)), np.full(len(darks), samples))
        V0 = max((K * noise.sigma_d_e) ** 2 - noise.sigma_row_DN**2, 1e-4)
        variance = temporal_variance(signal_DN, K, V0, 0.0, noise.q_DN**2 / 12)
        slopes = np.stack([signal_DN, np.ones_like(signal_DN)])
        return 100.0 * float(cramer_rao((0.5 * dof / variance**2 * slopes) @ slopes.T)[0]) / K

    def limits(self, captures: Captures) -> Limits:
        """There are none: every further pair lowers sigma, and the fit uses all pairs; see ``Predictor``."""
        return Limits(0.0, "")
