"""Prediction for noise: the gain K from pairs of flats, read noise along with it (EMVA 1288, photon transfer).

The variance of the difference of two frames over n samples is known to its part sqrt(2 / n). With V = K s + V0 at a
signal of s DN above black, each pair brings  n / (2 V^2) [s, 1]^T [s, 1]  on (K, V0), and each dark pair the same at s
of the dark current.
"""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import Float

from udccal.arrangements import Dark, FlatLight
from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.planning.forecast import Floor
from udccal.planning.state import EvenField, RigState, sensor_samples
from udccal.planning.steps import PlannedStep, planned_steps
from udccal.rig import Captures

# Samples brighter than this part of saturation are no part of the photon transfer fit.
_FIT_UP_TO = 0.9
_SAMPLES_ACROSS = 64
_FEWEST_LEVELS = 3


@final
class NoisePredictor:
    """Predicts the relative sigma of K in per cent."""

    def __init__(self, state: RigState) -> None:
        self._state = state
        pixels = sensor_samples(state.rig, _SAMPLES_ACROSS)
        # Neighbours in both directions: every site of the CFA has its share.
        sites = np.concatenate([pixels + shift for shift in np.mgrid[0:2, 0:2].reshape(2, -1).T])
        self._full_e = state.full_well_e * EvenField(state).signal(sites)
        self._each = state.rig.camera.rows * state.rig.camera.columns / len(sites)

    def sigma(self, captures: Captures) -> float:
        """Of K, in per cent; see ``prediction.Predictor``."""
        information, usable = np.zeros((2, 2)), 0
        for step in planned_steps("noise", self._state.with_captures(captures)):
            if len(step.exposures_s) != 2:
                continue
            one = self._information(step)
            information += one
            usable += isinstance(step.arrangement, FlatLight) and bool(one.any())
        if usable < _FEWEST_LEVELS:
            return float("inf")
        K = float(np.asarray(self._state.noise.K_DN_per_e))
        return 100.0 * float(np.sqrt(scaled_inverse(information)[0, 0])) / K

    def floor(self) -> Floor:
        """None: every further pair tells more."""
        return Floor(0.0, "")

    def used(self, captures: Captures) -> float:
        """All pairs; see ``prediction.Predictor``."""
        return 1.0

    def _information(self, step: PlannedStep) -> Float[np.ndarray, "2 2"]:
        """Of one pair, on (K, V0)."""
        noise = self._state.noise
        K = float(np.asarray(noise.K_DN_per_e))
        read_DN2 = (K * float(np.asarray(noise.sigma_d_e))) ** 2 - float(np.asarray(noise.sigma_row_DN)) ** 2
        V0 = max(read_DN2, 1e-4) + float(np.asarray(noise.q_DN)) ** 2 / 12
        dark_e = float(np.asarray(noise.dark_current_e_per_s)) * step.exposures_s[0]
        light_e = np.zeros_like(self._full_e) if isinstance(step.arrangement, Dark) else self._lit(step)
        # Samples above the limit clip in part of the frames and are left out.
        signal = K * (light_e[light_e <= _FIT_UP_TO * self._state.full_well_e] + dark_e)
        weight = self._each / (2 * (K * signal + V0) ** 2)
        by = np.stack([signal, np.ones_like(signal)])
        return np.asarray((by * weight) @ by.T)

    def _lit(self, step: PlannedStep) -> Float[np.ndarray, " n"]:
        return np.asarray((step.level or 0.0) * self._full_e)
