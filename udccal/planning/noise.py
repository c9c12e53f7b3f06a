"""Prediction for noise: gain K and read noise from pairs of flats and darks, by the photon transfer's equations."""

from __future__ import annotations

import math
from functools import partial
from typing import final

import numpy as np

from udccal.arrangements import Dark, FlatLight
from udccal.fitting.noise.data import NoiseRules
from udccal.fitting.noise.transfer import DarkVariance, Levels, Order, TransferProblem, temporal_variance
from udccal.planning.design import Floor
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
        """Sigma of K in per cent of K, where each sampled place is a bin of a level; see ``Predictor``."""
        noise, camera = self._state.noise, self._state.rig.camera
        K, samples, rounding = noise.K_DN_per_e, camera.rows * camera.columns, noise.q_DN**2 / 12
        V0 = max((K * noise.sigma_d_e) ** 2 - noise.sigma_row_DN**2, 1e-4)
        variance_DN2 = partial(temporal_variance, K_DN_per_e=K, V0_DN2=V0, curvature_per_DN=0.0, rounding_DN2=rounding)
        pairs = [step for step in self._state.with_captures(captures).steps("noise") if len(step.exposures_s) == 2]
        flats, darks = ([step for step in pairs if isinstance(step.arrangement, kind)] for kind in (FlatLight, Dark))
        flat_DN, dark_DN = (
            K * noise.dark_current_e_per_s * np.array([step.exposures_s[0] for step in steps])
            for steps in (flats, darks)
        )
        full_DN = K * self._state.full_well_e
        light_DN = full_DN * np.array([step.level for step in flats])[:, None] * self._light
        each = np.full(light_DN.shape, samples / len(self._light))
        levels = Levels(
            mean_DN=light_DN + flat_DN[:, None],
            variance_DN2=variance_DN2(light_DN + flat_DN[:, None]),
            dof=each,
            samples=2 * each,
            usable=light_DN <= _RULES.fit_up_to * full_DN,
            light=np.full(len(flats), np.nan),
            dark_DN=flat_DN,
            row_variance_DN2=np.zeros(len(flats)),
        )
        if levels.usable.any(axis=1).sum() < _RULES.levels:
            return math.inf
        sigma_DN2 = variance_DN2(dark_DN) * math.sqrt(2 / samples)
        dark = DarkVariance(np.full(len(darks), V0), sigma_DN2, rounding, K, dark_DN)
        x, sizes = np.array([K, V0, 0.0, 1.0, 0.0]), np.array([K, V0, 1.0, 1.0, 1.0])
        cov = TransferProblem(levels, dark, Order(), _RULES.most_bent, sizes).equations_at(x).cov()
        return 100.0 * math.sqrt(cov[0, 0]) / K

    def floor(self) -> Floor:
        """0, since every further pair lowers sigma."""
        return Floor(0.0, "")

    def used(self, captures: Captures) -> float:
        """1, since the fit uses all pairs; see ``Predictor``."""
        return 1.0
