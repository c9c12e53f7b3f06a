"""Prediction for the psf: the equations of the diffraction fit, for LEDs as they are expected to be seen.

A few places represent all. Each shot's nuisance parameters (place, light per colour, background) are eliminated. The
variance of a sample is that of its bracket's rate, and PRNU. The fit uses no more positions and shifts than its rules
state, so that further ones do not lower sigma.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import Final, final

import numpy as np
from jaxtyping import Float

from udccal.arrangements import Led
from udccal.cfa import cfa_named
from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.psf.data import PsfRules, Shots, held_out_positions
from udccal.fitting.psf.kernel import Evaluator, fit_lattice
from udccal.fitting.psf.problem import DiffractionProblem
from udccal.fitting.psf.samples import Samples, gather
from udccal.fitting.psf.start import choose_samples, stands_for, start_model, start_prior
from udccal.fitting.wire.parameters import ideal_wire, possible_harmonics, wire_start
from udccal.numerics import in_float64
from udccal.planning.design import DESIGN_VARIABLES, Limits
from udccal.planning.state import WHITE, RigState
from udccal.planning.steps import PlannedStep
from udccal.rig import Captures, RigDescription

# Steps of the term differ only in their place: a design of this few shows how each is exposed.
_SAMPLE: Final = {"psf_columns": 1, "psf_rows": 1, "psf_shifts": 1}
_MOST_EXPOSURES: Final = {one.name: one.most for one in DESIGN_VARIABLES["psf"] if one.name == "psf_exposures"}
# Places in fractions of the sensor and shifts in px that represent all, for the field and for the procedure's grid.
# The grid reaches nearly to the border.
_FIELD: Final = ((0.45, 0.55), (0.15, 0.2), (0.85, 0.7))
_CAPTURED: Final = ((0.05, 0.06), (0.5, 0.94), (0.9, 0.5))
_SHIFTS_PX: Final = np.array([[0.4, 1.3], [1.7, 0.2]])
_RULES: Final = PsfRules()


@final
class PsfPredictor:
    """Predicts the relative L2 sigma of the kernel in per cent."""

    @in_float64
    def __init__(self, state: RigState) -> None:
        self._state, rig, wire = state, state.rig, state.wire
        if wire is None:
            built = wire_start(rig)
            wire = ideal_wire(state.geometry, built, possible_harmonics(built).orders)
        start, shots = start_model(rig, state.geometry, wire), _dark_shots(rig)
        samples, prior = gather(shots, state.geometry, choose_samples(shots, _RULES)), start_prior(rig, start)
        lattice = fit_lattice(_RULES.close(shots.half))
        evaluator = Evaluator(start.wavelengths_nm, lattice, bool(start.visibility))
        problem = DiffractionProblem(samples, evaluator, prior).with_overlaps(prior.mean)
        # The light is that of the start, 1 for the brightest sample.
        own = np.tile([0.0, 0.0, *WHITE, 0.0], (shots.positions, len(_SHIFTS_PX), 1))
        own[..., 2:5] /= problem.at(prior.mean, own).light.max(axis=2, keepdims=True)
        self._place = problem.at(prior.mean, own)
        self._problem = replace(problem, samples=replace(problem.samples, rate=self._place.light))
        # With weights that give every colour's kernel the norm 1, the equations hold its squared derivatives.
        relative = replace(self._problem, samples=_relative(self._problem.samples, shots))
        in_field = [one.shared for one in relative.by_position(self._place)[: len(_FIELD)]]
        self._of_kernel = np.mean(in_field, axis=0) / len(_SHIFTS_PX)
        self._information = functools.cache(self._information_by)

    def sigma(self, captures: Captures) -> float:
        """Root mean square over colours and field; see ``Predictor``."""
        shots = _shots_used(captures)
        return self._kernel_sigma(captures, shots) if shots else math.inf

    def limits(self, captures: Captures) -> Limits:
        """The floor is that of all positions and shifts that the fit uses, at endless light; see ``Predictor``."""
        most, shots = captures.model_copy(update=_MOST_EXPOSURES), _RULES.positions * _RULES.shifts
        every = captures.psf_columns * captures.psf_rows * captures.psf_shifts
        used = self._of_noise(captures, every) / self._of_noise(captures, _shots_used(captures))
        why = (
            f"The fit of diffraction looks at {_RULES.positions} positions and {_RULES.shifts} shifts of each, and "
            "pixels differ in their response (PRNU): a larger effort (FitEffort's psf) would lower it."
        )
        if self._state.model_errors.psf_kernel**2 > self._of_noise(most, shots):
            why = "That much of the kernel the fit of the present profile could not describe; no capture changes it."
        return Limits(self._kernel_sigma(most, shots), why, used)

    def _kernel_sigma(self, captures: Captures, shots: int) -> float:
        return 100.0 * math.sqrt(self._of_noise(captures, shots) + self._state.model_errors.psf_kernel**2)

    def _of_noise(self, captures: Captures, shots: int) -> float:
        """Squared relative L2 error of the kernel by noise, averaged over places and colours."""
        steps = self._state.with_captures(captures.model_copy(update=_SAMPLE)).steps("psf")
        information = self._information(next(step for step in steps if isinstance(step.arrangement, Led)))
        return float(np.sum(self._of_kernel * scaled_inverse(self._problem.prior.precision + shots * information)))

    @in_float64
    def _information_by(self, step: PlannedStep) -> Float[np.ndarray, "p p"]:
        """Information of one shot on the diffraction parameters, averaged over the places that represent all.

        Samples are weighted by their brackets' noise, PRNU, and the model error that a profile's fit found. Exposures
        that would fill a sample's well do not count for it.
        """
        state, samples = self._state, self._problem.samples
        light, known = np.maximum(samples.rate, 0.0), np.zeros_like(samples.rate)
        for exposure_s in step.exposures_s:
            full_e = step.level * state.full_well_e * exposure_s / step.exposures_s[0]
            counts = full_e * light < state.full_well_e
            known += np.where(counts, full_e**2 / state.variance_e(full_e * light, exposure_s), 0.0)
        known *= (samples.known > 0) / (1 + known * (state.noise.PRNU1288 * light) ** 2)
        merged = replace(self._problem, samples=replace(samples, known=known).weighed(state.model_errors.psf))
        by_place = [one.marginal()[0] for one in merged.by_position(self._place)[len(_FIELD) :]]
        return np.mean(by_place, axis=0) / len(_SHIFTS_PX)


def _shots_used(captures: Captures) -> int:
    """Number of pictures that the diffraction fit uses; 0 where there are too few positions."""
    positions = captures.psf_columns * captures.psf_rows
    fitted = int((~held_out_positions(positions)).sum())
    used = min(fitted, _RULES.positions) * min(captures.psf_shifts, _RULES.shifts)
    return used if positions >= _RULES.least_positions else 0


def _relative(samples: Samples, shots: Shots) -> Samples:
    """The samples with weights under which squared errors sum to the squared relative L2 error, mean over colours."""
    count, colour = stands_for(shots, _RULES)[samples.index], samples.colour
    size = np.einsum("psn,psnc,psn->psc", samples.rate**2, colour, count)
    return replace(samples, weight=count * np.einsum("psnc,psc->psn", colour, 1 / size) / 3)


def _dark_shots(rig: RigDescription) -> Shots:
    """Shots with the places and colours of the samples in the fit's region about each LED, still without light."""
    captures, cfa = rig.captures, cfa_named(rig.camera.cfa)
    sides = (captures.psf_region_rows, captures.psf_region_columns)
    rows, columns = (max(4, min(most, side // 2 - 4)) for most, side in zip(_RULES.half_px, sides, strict=True))
    middles = np.floor(np.array([*_FIELD, *_CAPTURED]) * [rig.camera.columns, rig.camera.rows] / 2) * 2
    aims = (middles[:, None] + _SHIFTS_PX).reshape(-1, 2)
    origins = np.round(aims).astype(np.int64)
    x, y = origins.T[:, :, None, None] + np.mgrid[-rows : rows + 1, -columns : columns + 1][::-1, None]
    nothing = np.zeros(x.shape)
    disc = captures.psf_led_mm / (captures.psf_distance_mm + rig.mounting.standoff_mm.value) * rig.focal_px
    return Shots(
        centre_px=aims,
        origin_px=origins,
        position=np.repeat(np.arange(len(middles)), len(_SHIFTS_PX)),
        disc_px=np.full(len(aims), disc),
        rate=nothing,
        weight=nothing + 1.0,
        channel=cfa.channels[y % cfa.rows, x % cfa.columns],
        noise_per_rate=nothing,
    )
