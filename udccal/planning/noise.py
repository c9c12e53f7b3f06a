"""Prediction for noise: gain K and read noise from pairs of flats and darks, by the photon transfer's equations."""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import Float

from udccal.arrangements import Dark, FlatLight
from udccal.fitting.noise.data import NoiseRules
from udccal.fitting.noise.transfer import DarkVariance, Levels, Order, TransferProblem, temporal_variance
from udccal.planning.design import Floor
from udccal.planning.state import EvenField, RigState, sensor_samples
from udccal.planning.steps import planned_steps
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
        noise = state.noise
        self._K, sigma_d, row_DN, q_DN, self._dark_e_per_s = (
            float(np.asarray(one))
            for one in (noise.K_DN_per_e, noise.sigma_d_e, noise.sigma_row_DN, noise.q_DN, noise.dark_current_e_per_s)
        )
        self._V0, self._rounding = max((self._K * sigma_d) ** 2 - row_DN**2, 1e-4), q_DN**2 / 12

    def sigma(self, captures: Captures) -> float:
        """Sigma of K in per cent of K; see ``Predictor``."""
        steps = list(planned_steps("noise", self._state.with_captures(captures)))
        pairs = [step for step in steps if len(step.exposures_s) == 2]
        flats = [step for step in pairs if isinstance(step.arrangement, FlatLight)]
        darks = [step for step in pairs if isinstance(step.arrangement, Dark)]
        levels = self._levels(
            np.array([step.level or 0.0 for step in flats]), np.array([step.exposures_s[0] for step in flats])
        )
        if levels.usable.any(axis=1).sum() < _RULES.levels:
            return float("inf")
        dark = self._dark(np.array([step.exposures_s[0] for step in darks]))
        x = np.array([self._K, self._V0, 0.0, 1.0, 0.0])
        sizes = np.array([self._K, self._V0, 1.0, 1.0, 1.0])
        cov = TransferProblem(levels, dark, Order(), _RULES.most_bent, sizes).equations_at(x).cov()
        return 100.0 * float(np.sqrt(cov[0, 0])) / self._K

    def floor(self) -> Floor:
        """0, since every further pair lowers sigma."""
        return Floor(0.0, "")

    def used(self, captures: Captures) -> float:
        """1, since the fit uses all pairs; see ``Predictor``."""
        return 1.0

    def _levels(self, level: Float[np.ndarray, " levels"], exposure_s: Float[np.ndarray, " levels"]) -> Levels:
        """Pairs of flats as the transfer fit takes them: each sampled place is a bin, and the light is unknown."""
        full_DN = self._K * self._state.full_well_e
        dark_DN = self._K * self._dark_e_per_s * exposure_s
        light_DN = full_DN * level[:, None] * self._light
        each = np.full(light_DN.shape, self._state.rig.camera.rows * self._state.rig.camera.columns / len(self._light))
        signal_DN = light_DN + dark_DN[:, None]
        return Levels(
            mean_DN=signal_DN,
            variance_DN2=temporal_variance(signal_DN, self._K, self._V0, 0.0, self._rounding),
            dof=each,
            samples=2 * each,
            usable=light_DN <= _RULES.fit_up_to * full_DN,
            light=np.full(len(level), np.nan),
            dark_DN=dark_DN,
            row_variance_DN2=np.zeros(len(level)),
        )

    def _dark(self, exposure_s: Float[np.ndarray, " pairs"]) -> DarkVariance:
        """Dark variance as the pairs of dark frames would give it."""
        dark_DN = self._K * self._dark_e_per_s * exposure_s
        variance = temporal_variance(dark_DN, self._K, self._V0, 0.0, self._rounding)
        sigma = variance * np.sqrt(2 / (self._state.rig.camera.rows * self._state.rig.camera.columns))
        return DarkVariance(np.full(len(dark_DN), self._V0), sigma, self._rounding, self._K, dark_DN)
