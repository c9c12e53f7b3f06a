"""Frames of a sensor as its own noise term predicts them, and as a wrong one does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.noise import ToySensor, captured, measure
from tests.validation.judged import failed, named
from udccal.fitting.noise.data import NoiseData
from udccal.models.noise import Noise
from udccal.result import FitResult
from udccal.validation.limits import ValidationLimits
from udccal.validation.noise import judge_noise

SENSOR = ToySensor(rows=192, columns=256, row_DN=0.2)


@pytest.fixture(scope="module")
def result() -> FitResult[Noise]:
    return measure(SENSOR, 1)


@pytest.fixture(scope="module")
def later() -> NoiseData:
    return captured(SENSOR, 2)


def test_another_days_frames_are_predicted(result: FitResult[Noise], later: NoiseData) -> None:
    found = judge_noise(later, result, ValidationLimits())
    assert not failed(found)
    assert 0.8 < (named(found, "chi-squared").value or 0.0) < 1.2
    assert found.z_map is not None
    assert 0.8 < float(np.nanstd(found.z_map.z)) < 1.2


@pytest.mark.parametrize(
    ("changes", "check"),
    [
        ({"K_DN_per_e": 1.02}, "gain"),
        ({"black_DN": 1.02}, "black level"),
        ({"dark_current_e_per_s": 1.3}, "dark current"),
        ({"sigma_d_e": 3.0}, "chi-squared"),
    ],
)
def test_a_wrong_number_fails_its_check(
    result: FitResult[Noise], later: NoiseData, changes: dict[str, float], check: str
) -> None:
    wrong = replace(result.term, **{name: getattr(result.term, name) * part for name, part in changes.items()})
    assert check in failed(judge_noise(later, replace(result, term=wrong), ValidationLimits()))


def test_frames_of_another_gain_fail(result: FitResult[Noise]) -> None:
    other = captured(replace(SENSOR, K_DN_per_e=1.02 * SENSOR.K_DN_per_e), 3)
    assert "gain" in failed(judge_noise(other, result, ValidationLimits()))


def test_flats_that_are_all_clipped_cannot_be_judged(result: FitResult[Noise]) -> None:
    found = judge_noise(captured(replace(SENSOR, levels=(1.6, 2.0)), 4), result, ValidationLimits())
    assert failed(found) == {"captures"}


@pytest.mark.parametrize("seed", range(4))
def test_a_gain_of_few_samples_is_judged_by_its_error(seed: int) -> None:
    small = replace(SENSOR, rows=48, columns=64)
    result = measure(small, 10 + seed)
    found = named(judge_noise(captured(small, 20 + seed), result, ValidationLimits()), "gain")
    assert found.ok, found
    assert 1.5 < (found.limit or 0.0) < 10.0
    other = captured(replace(small, K_DN_per_e=1.15 * small.K_DN_per_e), 30 + seed)
    assert "gain" in failed(judge_noise(other, result, ValidationLimits()))
