"""Prediction for backscatter: the fit's likelihood at its own positions, for pictures as the procedure shows them.

A few pictures, drawn as the procedure draws them, represent all. Others, which the procedure does not show, are to be
predicted: they are samples without weight.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final, final

import numpy as np

from udccal.arrangements import Dark, PanelPicture
from udccal.bins import Bins
from udccal.displays.pictures import face_picture
from udccal.fitting.backscatter.data import Binned, Profile
from udccal.fitting.backscatter.model import PerBin, Pictures, grid_step, ratios_and_jacobian, sampled_rays, window_for
from udccal.fitting.backscatter.parameters import BackscatterRules, linear_of, linear_slope, prior_of, vector_of
from udccal.fitting.backscatter.read import visible_crop
from udccal.fitting.engine.least_squares import Blocks
from udccal.fitting.nominal import nominal_backscatter
from udccal.numerics import in_float64
from udccal.planning.design import Limits
from udccal.planning.state import WHITE, EvenField, RigState
from udccal.planning.steps import PlannedStep, steps_at
from udccal.rig import Captures

# Number of the procedure's pictures that represent all: drawing takes long, and further ones are of the same kind.
_DRAWN: Final = 6
# Pictures that no calibration shows, whose light is to be predicted.
_NEW_SEEDS: Final = (9001, 9002, 9003)
_SHOWN: Final = slice(1, -1 - len(_NEW_SEEDS))
_NEW: Final = slice(_SHOWN.stop, -1)
_RULES: Final = BackscatterRules()


@final
class BackscatterPredictor:
    """Predicts the sigma of a new picture's light in per cent of the light's peak."""

    @in_float64
    def __init__(self, state: RigState) -> None:
        self._state, rig, step_px = state, state.rig, grid_step(state.rig)
        rays, flat = sampled_rays(state.geometry, rig, step_px, _RULES.positions)
        self._prior = prior_of(rig)
        self._x = self._prior.mean if state.backscatter is None else vector_of(state.backscatter)
        theta = linear_of(self._x)
        template = nominal_backscatter(state.geometry, rig, np.zeros((3, 1, 1)), step_px, window=1)
        template = replace(template, window=window_for(template, theta, rays, slack=1.0))
        self._ratio, jacobian = ratios_and_jacobian(template, theta, rays, _pictures(state))
        self._jacobian = jacobian * linear_slope(self._x)[:, None, None, None]
        # Shading of the scattered light: light that leaves the panel evenly is shaded as all light is.
        grid = rig.camera.rows // step_px, rig.camera.columns // step_px
        rows, columns = np.divmod(flat, grid[1])
        self._shading = EvenField(state).at(step_px * (np.stack([columns, rows], axis=1) + 0.5) - 0.5)
        # Light of white: even, or as a profile's mask has it.
        light = np.tile(WHITE[:, None], len(flat))
        if (white := state.white) is not None:
            light = np.maximum(white.reshape(3, -1)[:, flat], 1e-3 * white.max())
        self._mask = light / (light * self._shading).max()
        # The fit looks at some of the sensor's bins.
        self._every = grid[0] * grid[1] / len(flat)
        # Factors from a sample's variance, and from that of a row's offset, to the variance of a bin's average.
        bins, one = Bins(rig.camera.cfa, step_px), np.ones((rig.camera.rows, rig.camera.columns))
        by_bin = bins.variance(one), bins.row_variance(one)
        self._by_sample, self._by_row = (factor.reshape(3, -1)[:, flat] for factor in by_bin)

    def sigma(self, captures: Captures) -> float:
        """Root mean square over sensor, colours and pictures, relative to the pictures' peaks; see ``Predictor``."""
        return self._light_sigma(self._planned(captures))

    def limits(self, captures: Captures) -> Limits:
        """The floor is the model error that a profile's fit found, of a new picture's peak; see ``Predictor``.

        The fit uses only some of the sensor's bins.
        """
        planned, none = self._planned(captures), np.full(self._mask.shape, 1e-15)
        endless = self._binned(none, none, none), 1_000_000
        return Limits(
            0.0 if self._state.model_errors.backscatter == 0 else self._light_sigma(endless),
            "That much of the light the fit of the present profile could not describe; no further picture changes it.",
            (self._light_sigma(planned, self._every) / self._light_sigma(planned)) ** 2,
        )

    def _light_sigma(self, planned: tuple[Binned, int] | None, count: float = 1.0) -> float:
        """Sigma of new pictures' light in per cent of their peak; bins count ``count`` times for the parameters."""
        if planned is None:
            return math.inf
        (seen, pictures), error = planned, self._state.model_errors.backscatter
        weight = seen.weights(seen.rate, self._mask, error, seen.usable)
        weight[_SHOWN] *= np.sqrt(pictures / len(weight[_SHOWN]))
        weight[_NEW] = 0.0
        profile = Profile.of(seen, self._ratio, weight)
        jacobian = np.sqrt(count) * profile.jacobian(self._jacobian).reshape(len(self._x), -1).T
        equations = Blocks.of_errors(np.zeros(len(jacobian)), jacobian).with_prior(self._prior, self._x)
        cov = equations.cov() * self._state.model_errors.inflation
        variance = profile.light_variance(self._ratio, self._jacobian, cov)[_NEW] + (error * self._mask) ** 2
        peak = seen.rate[_NEW].max(axis=(1, 2))
        return 100.0 * float(np.sqrt(variance.mean() / (peak**2).mean()))

    def _planned(self, captures: Captures) -> tuple[Binned, int] | None:
        """Shots of the pictures drawn, and the number of pictures in all; None where these are too few."""
        steps = self._state.with_captures(captures).steps("backscatter")
        shown, darks = ([step for step in steps if isinstance(step.arrangement, kind)] for kind in (PanelPicture, Dark))
        if len(shown) - 1 < _RULES.fewest_pictures or not darks:
            return None
        full_e = shown[0].level * self._state.full_well_e * self._shading
        rest, in_dark = (self._in_dark_e2(step) / full_e**2 for step in (shown[0], darks[0]))
        return self._binned(self._by_sample / (full_e * len(shown[0].exposures_s)), rest, in_dark), len(shown) - 1

    def _in_dark_e2(self, step: PlannedStep) -> PerBin:
        """Variance of a bin's average without light."""
        noise, sample_e2 = self._state.noise, float(self._state.variance_e(np.zeros(1), step.exposures_s[0])[0])
        row_e2 = (noise.sigma_row_DN / noise.K_DN_per_e) ** 2
        whole_e2 = max(sample_e2 - row_e2, 0.0) * self._by_sample + row_e2 * self._by_row
        return np.asarray(whole_e2 / len(step.exposures_s))

    def _binned(self, shot: PerBin, rest: PerBin, dark: PerBin) -> Binned:
        """Shots with these variances, in units of the brightest light of a shaded white picture."""
        light, one = self._mask * self._ratio, np.ones(len(self._ratio))
        whole = np.stack([*[rest] * (len(light) - 1), dark])
        return Binned(light, np.broadcast_to(shot, light.shape), whole, np.zeros(light.shape, dtype=bool), one, one)


def _pictures(state: RigState) -> Pictures:
    """Pictures as the procedure shows them, followed by those for the prediction."""
    panel, crop = state.rig.panel, visible_crop(state.geometry, state.rig)
    few = state.with_captures(state.rig.captures.model_copy(update={"backscatter_pictures": _DRAWN})).rig
    panels = (step.arrangement for step in steps_at("backscatter", few) if isinstance(step.arrangement, PanelPicture))
    shown = [one.picture for one in panels if one.picture.min() < 255]
    shown += [face_picture(seed, panel.columns, panel.rows) for seed in _NEW_SEEDS]
    return Pictures.of(np.stack([crop.of(picture) for picture in shown]), crop)
