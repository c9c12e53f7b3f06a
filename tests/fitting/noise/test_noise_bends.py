"""Responses that are no parabola: K is right, and the notes say that the term's parabola is not the whole bend."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.noise import PLAIN, ToySensor, measure, truth
from udccal.models.noise import Noise
from udccal.result import FitResult

MANY = (*np.linspace(0.03, 0.95, 20).tolist(), 1.4)
BENDS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "cube": lambda x: x * (1 - 0.05 * x**2),
    "a steeper cube": lambda x: x * (1 + 0.03 * x**2),
    "arctangent": lambda x: np.arctan(0.5 * x) / 0.5,
    "tanh": lambda x: np.tanh(0.4 * x) / 0.4,
    "exponential": lambda x: (1 - np.exp(-0.3 * x)) / 0.3,
}


def z_of_gain(result: FitResult[Noise], sensor: ToySensor) -> float:
    found = result.estimate("K_DN_per_e")
    return (found.value - truth(sensor)["K_DN_per_e"]) / found.sigma


@pytest.mark.parametrize("kind", BENDS)
@pytest.mark.parametrize("levels", [ToySensor.levels, MANY], ids=["10 levels", "21 levels"])
def test_a_response_that_is_no_parabola_leaves_the_gain_right(kind: str, levels: tuple[float, ...]) -> None:
    bend = BENDS[kind]
    sensor = replace(PLAIN, response=bend, levels=levels)
    result = measure(sensor, len(levels))
    assert result.ok, result.notes
    assert abs(z_of_gain(result, sensor)) < 3.5
    assert any("no parabola" in note for note in result.notes)
    missing, at_full = result.estimate("nonlinearity"), 1 - float(bend(np.array(1.0)))
    assert abs(missing.value - at_full) < 0.03 * abs(at_full) + 4 * missing.sigma


def test_a_bend_of_another_kind_says_that_the_gain_may_be_off() -> None:
    sensor = replace(PLAIN, response=lambda x: x * (1 - 0.05 * x**3), levels=MANY)
    result = measure(sensor, 3)
    assert abs(z_of_gain(result, sensor)) < 3.5
    assert any("K is off" in note for note in result.notes)


def test_a_parabola_needs_no_cubic_and_unsteady_light_is_no_bend() -> None:
    for sensor in (replace(PLAIN, bend=0.04), replace(PLAIN, flicker=0.004)):
        notes = measure(sensor, 5).notes
        assert not any("parabola" in note for note in notes)
