"""Prediction for the psf: the equations of the diffraction fit, for LEDs as they are expected to be seen.

A few places represent all. Each shot's nuisance parameters (place, light per colour, background) are eliminated. The
variance of a sample is that of its bracket's rate, and PRNU. The fit uses no more positions and shifts than its rules
state, so that further ones do not lower sigma.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, final

import numpy as np
from jaxtyping import Float

from udccal.arrangements import Led
from udccal.cfa import cfa_named
from udccal.fitting.engine.gaussian import Prior, scaled_inverse
from udccal.fitting.psf.data import PsfRules, Shots, held_out_positions
from udccal.fitting.psf.kernel import Evaluator, fit_lattice, start_model, start_prior
from udccal.fitting.psf.problem import DiffractionProblem, Place
from udccal.fitting.psf.samples import Samples, choose_samples, gather, stands_for, weighed
from udccal.numerics import in_float64
from udccal.planning.design import DESIGN_VARIABLES, Floor
from udccal.planning.state import WHITE, RigState, built_wire, sample_variance_e
from udccal.planning.steps import PlannedStep, planned_steps
from udccal.rig import Captures

# Steps of the term differ only in their place: a design of this few shows how each is exposed.
_SAMPLE: Final = {"psf_columns": 1, "psf_rows": 1, "psf_shifts": 1}
_EXPOSURES: Final = next(one for one in DESIGN_VARIABLES["psf"] if one.name == "psf_exposures")
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
        self._state = state
        wire = built_wire(state) if state.wire is None else state.wire
        start = start_model(state.rig, state.geometry, wire)
        self._prior = start_prior(state.rig, start)
        half = _half(state.rig.captures)
        evaluator = Evaluator(np.asarray(start.wavelengths_nm), fit_lattice(_RULES.close(half)), bool(start.visibility))
        shots = _dark_shots(state, half)
        problem, place = _expected(state, shots, evaluator, self._prior)
        field, field_place = _part(problem, place, slice(len(_FIELD)))
        self._captured, self._place = _part(problem, place, slice(len(_FIELD), None))
        # With weights that give every colour's kernel the norm 1, the equations hold its squared derivatives.
        relative = replace(field, samples=_relative(field.samples, shots))
        self._of_kernel = _per_shot([one.shared for one in relative.by_position(field_place)])
        self._known: dict[tuple[float, ...], Float[np.ndarray, "p p"]] = {}

    def sigma(self, captures: Captures) -> float:
        """Root mean square over colours and field; see ``Predictor``."""
        shots = self._shots_used(captures)
        return self._kernel_sigma(captures, shots) if shots else float("inf")

    def used(self, captures: Captures) -> float:
        """Less than 1 where there are more positions and shifts than the fit uses; see ``Predictor``."""
        shots = self._shots_used(captures)
        every = captures.psf_columns * captures.psf_rows * captures.psf_shifts
        return self._of_noise(captures, every) / self._of_noise(captures, shots) if shots else 1.0

    def floor(self) -> Floor:
        """The sigma of all positions and shifts that the fit uses, at endless light."""
        most, shots = _EXPOSURES.set(self._state.rig.captures, _EXPOSURES.most), _RULES.positions * _RULES.shifts
        if self._state.model_errors.psf_kernel**2 > self._of_noise(most, shots):
            why = "That much of the kernel the fit of the present profile could not describe; no capture changes it."
        else:
            why = (
                f"The fit of diffraction looks at {_RULES.positions} positions and {_RULES.shifts} shifts of each, and "
                "pixels differ in their response (PRNU): a larger effort (FitEffort's psf) would lower it."
            )
        return Floor(self._kernel_sigma(most, shots), why)

    def _shots_used(self, captures: Captures) -> int:
        """Number of pictures that the diffraction fit uses; 0 where there are too few positions."""
        positions = captures.psf_columns * captures.psf_rows
        fitted = int((~held_out_positions(positions)).sum())
        used = min(fitted, _RULES.positions) * min(captures.psf_shifts, _RULES.shifts)
        return used if positions >= _RULES.least_positions else 0

    def _kernel_sigma(self, captures: Captures, shots: int) -> float:
        return 100.0 * float(np.sqrt(self._of_noise(captures, shots) + self._state.model_errors.psf_kernel**2))

    def _of_noise(self, captures: Captures, shots: int) -> float:
        """Squared relative L2 error of the kernel by noise, averaged over places and colours."""
        few = self._state.with_captures(captures.model_copy(update=_SAMPLE))
        step = next(step for step in planned_steps("psf", few) if isinstance(step.arrangement, Led))
        if step.exposures_s not in self._known:
            self._known[step.exposures_s] = self._information(step)
        cov = scaled_inverse(self._prior.precision + shots * self._known[step.exposures_s])
        return float(np.sum(self._of_kernel * cov))

    @in_float64
    def _information(self, step: PlannedStep) -> Float[np.ndarray, "p p"]:
        """Information of one shot on the diffraction parameters, averaged over the places that represent all."""
        merged = replace(self._captured, samples=_merged(self._state, self._captured.samples, step))
        return _per_shot([one.marginal()[0] for one in merged.by_position(self._place)])


def _per_shot(matrices: list[Float[np.ndarray, "p p"]]) -> Float[np.ndarray, "p p"]:
    return np.asarray(np.mean(matrices, axis=0) / len(_SHIFTS_PX))


def _merged(state: RigState, samples: Samples, step: PlannedStep) -> Samples:
    """The samples weighted by their brackets' noise, PRNU, and the model error that a profile's fit found.

    Exposures that would fill a sample's well do not count for it.
    """
    full_e, light = (step.level or 0.0) * state.full_well_e, np.maximum(np.asarray(samples.rate), 0.0)
    known = np.zeros_like(light)
    for exposure_s in step.exposures_s:
        ratio = exposure_s / step.exposures_s[0]
        signal_e = full_e * ratio * light
        variance = sample_variance_e(state, signal_e, exposure_s)
        known += np.where(signal_e < state.full_well_e, (full_e * ratio) ** 2 / variance, 0.0)
    known /= 1 + known * (float(np.asarray(state.noise.PRNU1288)) * light) ** 2
    return weighed(replace(samples, known=known * (np.asarray(samples.known) > 0)), state.model_errors.psf)


def _relative(samples: Samples, shots: Shots) -> Samples:
    """The samples with weights under which squared errors sum to the squared relative L2 error, mean over colours."""
    count, light, colour = (
        stands_for(shots, _RULES)[samples.index],
        np.asarray(samples.rate),
        np.asarray(samples.colour),
    )
    size = np.einsum("psn,psnc,psn->psc", light**2, colour, count)
    return replace(samples, weight=count * np.einsum("psnc,psc->psn", colour, 1 / size) / 3)


def _expected(state: RigState, shots: Shots, evaluator: Evaluator, prior: Prior) -> tuple[DiffractionProblem, Place]:
    """The diffraction fit's problem at each place; the light is that of its start, 1 for the brightest sample."""
    made = gather(shots, state.geometry, choose_samples(shots, _RULES))
    problem = DiffractionProblem(made, evaluator, prior).with_overlaps(prior.mean)
    own = np.tile([0.0, 0.0, *WHITE, 0.0], (shots.positions, len(_SHIFTS_PX), 1))
    own[..., 2:5] /= problem.at(prior.mean, own).light.max(axis=2, keepdims=True)
    place = problem.at(prior.mean, own)
    return replace(problem, samples=replace(problem.samples, rate=place.light)), place


def _part(problem: DiffractionProblem, place: Place, which: slice) -> tuple[DiffractionProblem, Place]:
    parts = (part[which] for part in (place.own, place.light, place.by_theta, place.by_own))
    return replace(problem, samples=problem.samples.at(which)), Place(place.theta, *parts)


def _half(captures: Captures) -> tuple[int, int]:
    """(rows, columns) of the fit's region to either side of the LED."""
    sides = (captures.psf_region_rows, captures.psf_region_columns)
    rows, columns = (max(4, min(most, side // 2 - 4)) for most, side in zip(_RULES.half_px, sides, strict=True))
    return rows, columns


def _dark_shots(state: RigState, half: tuple[int, int]) -> Shots:
    """Shots with the places and colours of their samples, still without light."""
    rig, captures = state.rig, state.rig.captures
    middles = np.floor(np.array([*_FIELD, *_CAPTURED]) * [rig.camera.columns, rig.camera.rows] / 2) * 2
    aims = (middles[:, None] + _SHIFTS_PX).reshape(-1, 2)
    origins = np.round(aims).astype(np.int64)
    rows, columns = 2 * half[0] + 1, 2 * half[1] + 1
    whole = cfa_named(rig.camera.cfa).channel_map(rows + 1, columns + 1)
    first = (origins - np.array([half[1], half[0]])) % 2
    nothing = np.zeros((len(aims), rows, columns))
    disc = captures.psf_led_mm / (captures.psf_distance_mm + rig.mounting.standoff_mm.value) * rig.focal_px
    return Shots(
        centre_px=aims,
        origin_px=origins,
        position=np.repeat(np.arange(len(middles)), len(_SHIFTS_PX)),
        disc_px=np.full(len(aims), disc),
        rate=nothing,
        weight=nothing + 1.0,
        channel=np.stack([whole[y : y + rows, x : x + columns] for x, y in first]),
        noise_per_rate=nothing,
    )
