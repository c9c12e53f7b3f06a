"""Prediction for the psf: the normal equations of the diffraction fit, for LEDs as they are expected to be seen.

A few places stand for all; each shot's own unknowns (place, light per colour, background) are estimated along. A sample
has what its bracket tells of its rate, and PRNU. The fit looks at no more positions and shifts than its effort says, so
that more of them bring nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np
from jaxtyping import Float

from udccal.arrangements import Led
from udccal.fitting.calibrate import FitEffort
from udccal.fitting.psf_descent import Prior, without_locals
from udccal.fitting.psf_normal import normal_equations
from udccal.fitting.psf_start import start_model, start_prior, wire_shows
from udccal.numerics import in_float64
from udccal.planning.algebra import covariance
from udccal.planning.led_shots import ExpectedShots, expected_shots, sample_information
from udccal.planning.prediction import Floor
from udccal.planning.state import RigState, built_wire
from udccal.planning.steps import PlannedStep, planned_steps
from udccal.rig import Captures

_FEWEST_POSITIONS: Final = 3
# Every so many positions one is held out of the fit while orders are compared.
_HELD_OUT_EVERY: Final = 4
# Steps of one term are alike but for their place: a design of so few shows how each is exposed.
_SAMPLE: Final = {"psf_columns": 1, "psf_rows": 1, "psf_shifts": 1}


@final
@dataclass(frozen=True)
class _Effort:
    """Positions and shifts that the fit looks at."""

    positions: int
    shifts: int


@final
class PsfPredictor:
    """Predicts the relative L2 sigma of the kernel in per cent."""

    @in_float64
    def __init__(self, state: RigState) -> None:
        self._state = state
        wire = built_wire(state) if state.wire is None else state.wire
        start = start_model(state.rig, state.geometry, wire)
        prior: Prior = start_prior(state.rig, start, wire_shows(wire))
        self._precision = prior.root.T @ prior.root
        self._shots: ExpectedShots = expected_shots(state, prior.mean, wire_shows(wire))
        effort = FitEffort().psf
        self._most = _Effort(effort.positions, effort.shifts)
        self._by_sample = self._of_kernel()
        self._known: dict[tuple[float, ...], Float[np.ndarray, "p p"]] = {}

    def sigma(self, captures: Captures) -> float:
        """Root mean square over colours and field; see ``prediction.Predictor``."""
        positions = captures.psf_columns * captures.psf_rows
        if positions < _FEWEST_POSITIONS:
            return float("inf")
        held_out = len(range(1, positions, _HELD_OUT_EVERY))
        used = min(positions - held_out, self._most.positions) * min(captures.psf_shifts, self._most.shifts)
        return self._kernel_sigma(self._information(captures), used)

    def floor(self) -> Floor:
        """All that the fit looks at, endlessly bright."""
        most = self._state.rig.captures.model_copy(update={"psf_exposures": 12})
        return Floor(
            self._kernel_sigma(self._information(most), self._most.positions * self._most.shifts),
            f"The fit of diffraction looks at {self._most.positions} positions and {self._most.shifts} shifts of each, "
            "and pixels differ in their response (PRNU): a larger effort (FitEffort's psf) would lower it.",
        )

    @in_float64
    def _information(self, captures: Captures) -> Float[np.ndarray, "p p"]:
        """Of one shot on the numbers of diffraction, mean over the places that stand for all."""
        few = self._state.with_captures(captures.model_copy(update=_SAMPLE))
        step = next(step for step in planned_steps("psf", few) if isinstance(step.arrangement, Led))
        if step.exposures_s not in self._known:
            self._known[step.exposures_s] = self._mean_information(step)
        return self._known[step.exposures_s]

    def _mean_information(self, step: PlannedStep) -> Float[np.ndarray, "p p"]:
        total, count = np.zeros_like(self._precision), 0
        for block, local, overlaps in self._shots.parts():
            weight = sample_information(self._state, np.asarray(block.rate), step)
            here = replace(block, weight=weight * (np.asarray(block.known) > 0))
            normal = normal_equations(self._shots.evaluator, self._shots.theta, here, local, overlaps)
            total += without_locals(normal)[0]
            count += len(local.flux)
        return total / count

    def _of_kernel(self) -> Float[np.ndarray, "p p"]:
        """Takes a covariance to the squared relative L2 error of the kernel, mean over places and colours."""
        total = np.zeros_like(self._precision)
        for block, local, overlaps in self._shots.parts():
            here = replace(block, weight=self._shots.relative_weight(block))
            # The slopes of light by the numbers of diffraction, at weights that make every colour's kernel count 1.
            normal = normal_equations(self._shots.evaluator, self._shots.theta, here, local, overlaps)
            total += np.asarray(normal.gg) / len(np.asarray(block.index))
        return total / len(self._shots.blocks)

    def _left_out(self) -> float:
        """Squared relative L2 error that a profile's fit has found its model to have."""
        shares = [
            float(np.sum(self._shots.relative_weight(block) * np.asarray(block.rate) ** 1.5)) / len(block.rate)
            for block in self._shots.blocks
        ]
        return self._state.unexplained.psf**2 * float(np.mean(shares))

    def _kernel_sigma(self, one: Float[np.ndarray, "p p"], shots: int) -> float:
        cov = covariance(self._precision + shots * one)
        return 100.0 * float(np.sqrt(float(np.sum(self._by_sample * cov)) + self._left_out()))
