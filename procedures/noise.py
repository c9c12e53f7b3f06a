"""Noise: pairs of dark frames and flats over exposures, and one stack of each for the fixed pattern (EMVA 1288)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, final

import numpy as np

from procedures.base import Procedure
from procedures.checks import is_dark, is_even, sees_anything
from procedures.plans import Exposure, Fixed, Metered, Plan, Singles, Stack, TimesThatOf
from procedures.step import Step, whole_sensor
from udccal.arrangements import Dark, FlatLight
from udccal.rig import RigDescription
from udccal.sessions.schema import TermName

_STACK = "noise/flat_stack"
_LEVEL = 0.5  # level of the stack, of saturation
_TOP = 2.3  # times the stack's exposure: beyond saturation, so that the fit can find it
_BOTTOM = 0.02
_LONG_DARKS_S = (0.25, 1.0, 4.0)

_FLAT = "Put the white LED panel close in front of the display so that it fills the view. Keep our display off."
_DARK = "Cap the lens, switch the display off, and keep all light out."


@final
class NoiseProcedure(Procedure):
    """Two single frames at each of ``captures.noise_levels`` exposures, lit and dark, and stacks at half saturation."""

    term: ClassVar[TermName] = "noise"

    def steps(self, rig: RigDescription) -> Iterator[Step]:
        """Yield flats, then dark frames at the same exposures and at long ones for the dark current."""
        stack = Stack(rig.captures.noise_stack)
        factors = np.linspace(_BOTTOM, _TOP, rig.captures.noise_levels)
        yield _lit(rig, _STACK, Metered(_LEVEL), stack)
        for index, factor in enumerate(factors):
            yield _lit(rig, f"noise/flat_{index}", TimesThatOf(_STACK, float(factor)), Singles(2))
        yield _dark(rig, "noise/dark_stack", TimesThatOf(_STACK), stack)
        for index, factor in enumerate(factors):
            yield _dark(rig, f"noise/dark_{index}", TimesThatOf(_STACK, float(factor)), Singles(2))
        for index, seconds in enumerate(_LONG_DARKS_S, start=len(factors)):
            yield _dark(rig, f"noise/dark_{index}", Fixed(seconds), Singles(2))


def _lit(rig: RigDescription, step_id: str, exposure: Exposure, plan: Plan) -> Step:
    check = is_even if isinstance(exposure, Metered) else sees_anything  # the long ones clip on purpose
    return Step(
        step_id,
        "noise",
        FlatLight(),
        _FLAT,
        check,
        whole_sensor(rig),
        exposure,
        plan,
        title="Even light for the noise",
        why="How the noise grows with the light gives the camera's gain, and from where on it clips.",
    )


def _dark(rig: RigDescription, step_id: str, exposure: Exposure, plan: Plan) -> Step:
    return Step(
        step_id,
        "noise",
        Dark(),
        _DARK,
        is_dark,
        whole_sensor(rig),
        exposure,
        plan,
        title="Darkness for the noise",
        why="Dark frames give the black level, the read noise and the dark current.",
    )
