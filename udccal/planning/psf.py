"""Prediction for the psf: the normal equations of the diffraction fit, for LEDs as they are expected to be seen.

A few places stand for all; each shot's own unknowns (place, light per colour, background) are estimated along. A sample
has what its bracket tells of its rate, and PRNU. The fit looks at no more positions and shifts than its effort says, so
that more of them bring nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, final

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from udccal.arrangements import Led
from udccal.calibration import FitEffort
from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.psf.blocks import Block, Local
from udccal.fitting.psf.descent import Prior, without_locals
from udccal.fitting.psf.normal import Evaluator, Normal, normal_equations
from udccal.fitting.psf.start import start_model, start_prior, wire_shows
from udccal.numerics import in_float64
from udccal.planning.design import DESIGN_VARIABLES
from udccal.planning.forecast import Floor
from udccal.planning.led_shots import ExpectedShots, expected_shots, sample_information
from udccal.planning.state import RigState, built_wire
from udccal.planning.steps import PlannedStep, planned_steps
from udccal.rig import Captures

_FEWEST_POSITIONS: Final = 3
# Every so many positions one is held out of the fit while orders are compared.
_HELD_OUT_EVERY: Final = 4
# Steps of one term are alike but for their place: a design of so few shows how each is exposed.
_SAMPLE: Final = {"psf_columns": 1, "psf_rows": 1, "psf_shifts": 1}
_EXPOSURES: Final = next(one for one in DESIGN_VARIABLES["psf"] if one.name == "psf_exposures")


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
        self._shots: ExpectedShots = expected_shots(state, prior, wire_shows(wire))
        effort = FitEffort().psf
        self._most = _Effort(effort.positions, effort.shifts)
        self._known: dict[tuple[float, ...], Float[np.ndarray, "p p"]] = {}
        # All brackets that a plan may ask for: their slopes are the same, and what takes long.
        captures = state.rig.captures
        steps = [self._step(_EXPOSURES.set(captures, n)) for n in range(_EXPOSURES.least, _EXPOSURES.most + 1)]
        self._by_sample = self._look_at(steps)

    def sigma(self, captures: Captures) -> float:
        """Root mean square over colours and field; see ``prediction.Predictor``."""
        shots = self._shots_used(captures)
        return self._kernel_sigma(self._information(captures), shots) if shots else float("inf")

    def used(self, captures: Captures) -> float:
        """Of all positions and shifts, a part; see ``prediction.Predictor``."""
        shots = self._shots_used(captures)
        if not shots:
            return 1.0
        every = captures.psf_columns * captures.psf_rows * captures.psf_shifts
        one = self._information(captures)
        by_all, by_part = (self._of_noise(one, count) for count in (every, shots))
        return by_all / by_part

    def floor(self) -> Floor:
        """All that the fit looks at, endlessly bright."""
        most = self._state.rig.captures.model_copy(update={"psf_exposures": _EXPOSURES.most})
        shots = self._most.positions * self._most.shifts
        if self._state.unexplained.psf_kernel**2 > self._of_noise(self._information(most), shots):
            why = "That much of the kernel the fit of the present profile could not describe; no capture changes it."
        else:
            why = (
                f"The fit of diffraction looks at {self._most.positions} positions and {self._most.shifts} shifts of "
                "each, and pixels differ in their response (PRNU): a larger effort (FitEffort's psf) would lower it."
            )
        return Floor(self._kernel_sigma(self._information(most), shots), why)

    def _shots_used(self, captures: Captures) -> int:
        """Pictures that the fit of diffraction looks at; 0 where there are too few positions."""
        positions = captures.psf_columns * captures.psf_rows
        held_out = len(range(1, positions, _HELD_OUT_EVERY))
        used = min(positions - held_out, self._most.positions) * min(captures.psf_shifts, self._most.shifts)
        return used if positions >= _FEWEST_POSITIONS else 0

    def _information(self, captures: Captures) -> Float[np.ndarray, "p p"]:
        """Of one shot on the numbers of diffraction, mean over the places that stand for all."""
        step = self._step(captures)
        if step.exposures_s not in self._known:
            self._look_at([step])
        return self._known[step.exposures_s]

    def _step(self, captures: Captures) -> PlannedStep:
        few = self._state.with_captures(captures.model_copy(update=_SAMPLE))
        return next(step for step in planned_steps("psf", few) if isinstance(step.arrangement, Led))

    @in_float64
    def _look_at(self, steps: Sequence[PlannedStep]) -> Float[np.ndarray, "p p"]:
        """Learn what shots of these steps tell.

        Returns:
            What takes a covariance to the squared relative L2 error of the kernel, mean over places and colours.
        """
        of_kernel, told = np.zeros_like(self._precision), np.zeros((len(steps), *self._precision.shape))
        count, field = 0, self._shots.in_field
        for number, (block, local, overlaps) in enumerate(self._shots.parts()):
            known = np.asarray(block.known) > 0
            light = [sample_information(self._state, np.asarray(block.rate), step) * known for step in steps]
            # At weights that make every colour's kernel count 1, the slopes of light are those of the kernel.
            weights = np.stack([self._shots.relative_weight(block), *light])
            normal = _at_weights(self._shots.evaluator, self._shots.theta, block, local, overlaps, weights)
            if number < field:
                of_kernel += np.asarray(normal.gg[0]) / len(local.flux)
            else:
                told += [without_locals(_one(normal, k))[0] for k in range(1, len(weights))]
                count += len(local.flux)
        self._known |= {step.exposures_s: one / count for step, one in zip(steps, told, strict=True)}
        return of_kernel / field

    def _kernel_sigma(self, one: Float[np.ndarray, "p p"], shots: int) -> float:
        return 100.0 * float(np.sqrt(self._of_noise(one, shots) + self._state.unexplained.psf_kernel**2))

    def _of_noise(self, one: Float[np.ndarray, "p p"], shots: int) -> float:
        """Squared relative L2 error of the kernel by noise."""
        return float(np.sum(self._by_sample * scaled_inverse(self._precision + shots * one)))


@eqx.filter_jit
def _at_weights(
    evaluator: Evaluator,
    theta: Float[Array, " p"],
    block: Block,
    local: Local,
    overlaps: Array,
    weights: Float[Array, "designs shots n"],
) -> Normal:
    """The normal equations of one block at several weights of its samples; slopes are found once."""

    def one(weight: Float[Array, "shots n"]) -> Normal:
        return normal_equations(evaluator, theta, replace(block, weight=weight), local, overlaps)

    made: Callable[[Array], Normal] = jax.vmap(one)
    return made(weights)


def _one(normals: Normal, index: int) -> Normal:
    taken: Normal = jax.tree.map(lambda part: np.asarray(part)[index], normals)
    return taken
