"""Frames of a sensor as its own noise term predicts them, and as a wrong one does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.noise import ToySensor, captured, measure
from tests.validation.judged import failed, named
from udccal.fitting.noise.data import ExposureLevel, NoiseData, SpatialStack
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


def test_another_days_frames_of_a_response_that_is_no_parabola_are_predicted() -> None:
    sensor = ToySensor(bend=0.0, response=lambda x: x * (1 - 0.05 * x**2))
    own = measure(sensor, 1)
    assert own.diagnostic("curvature_growth")
    assert not failed(judge_noise(captured(sensor, 2), own, ValidationLimits()))
    parabola = replace(own, diagnostics=())
    assert "pattern of variances" in failed(judge_noise(captured(sensor, 2), parabola, ValidationLimits()))


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


# Of five by five parts.
WIDE = replace(SENSOR, rows=256, columns=512)
PATTERNS = {"dark level over exposures", "dark level over the sensor", "pattern of variances"}


def added(
    data: NoiseData, of_stack: np.ndarray | float = 0.0, by_exposure: float = 0.0, spread: float = 0.0
) -> NoiseData:
    """Frames with DN more in the dark stack, more by the square of the exposure in dark pairs, noisier in a corner."""
    rng = np.random.default_rng(9)

    def changed(frame: np.ndarray, more: np.ndarray | float) -> np.ndarray:
        return np.clip(np.rint(frame + more), 0, 4095).astype(np.uint16)

    def noisy(frame: np.ndarray) -> np.ndarray:
        noise = np.zeros(frame.shape)
        corner = noise[: frame.shape[0] // 4, : frame.shape[1] // 4]
        corner[:] = spread * rng.standard_normal(corner.shape)
        return changed(frame, noise)

    levels = [
        ExposureLevel(
            one.exposure_s,
            tuple(changed(frame, by_exposure * one.exposure_s**2) for frame in one.dark),
            tuple(noisy(frame) for frame in one.bright),
        )
        for one in data.levels
    ]
    stack = data.stack
    assert stack is not None
    return replace(
        data,
        levels=levels,
        stack=SpatialStack(stack.exposure_s, [changed(frame, of_stack) for frame in stack.dark], stack.bright),
    )


@pytest.mark.parametrize("seed", range(3))
def test_sound_frames_have_no_pattern(result: FitResult[Noise], seed: int) -> None:
    found = judge_noise(captured(WIDE, 40 + seed), result, ValidationLimits())
    assert not failed(found)
    assert {check.name: check.value for check in found.checks if check.name in PATTERNS} == dict.fromkeys(PATTERNS, 0.0)


def test_a_response_that_bends_otherwise_leaves_a_pattern_of_variances(result: FitResult[Noise]) -> None:
    """The gain at all flats together may be right all the same."""
    found = judge_noise(captured(replace(WIDE, bend=0.08), 50), result, ValidationLimits())
    assert "pattern of variances" in failed(found)
    assert not PATTERNS - {"pattern of variances"} & failed(found)


def test_a_noisy_corner_leaves_a_pattern_of_variances(result: FitResult[Noise]) -> None:
    found = judge_noise(added(captured(WIDE, 51), spread=8.0), result, ValidationLimits())
    assert PATTERNS & failed(found) == {"pattern of variances"}


def test_dark_frames_that_bend_over_exposures_fail(result: FitResult[Noise]) -> None:
    found = judge_noise(added(captured(WIDE, 52), by_exposure=40.0), result, ValidationLimits())
    assert PATTERNS & failed(found) == {"dark level over exposures"}


def glow() -> np.ndarray:
    """A corner of 12 DN."""
    light = np.zeros((WIDE.rows, WIDE.columns))
    light[: WIDE.rows // 4, : WIDE.columns // 4] = 12.0
    return light


def band(axis: int) -> np.ndarray:
    """Rows or columns that are brighter on one side, by 6 DN at most."""
    return np.broadcast_to(np.moveaxis(np.linspace(-6.0, 6.0, glow().shape[axis])[:, None], 0, axis), glow().shape)


@pytest.mark.parametrize("light", [glow(), band(0), band(1)], ids=["a corner", "rows", "columns"])
def test_dark_frames_that_glow_fail(result: FitResult[Noise], light: np.ndarray) -> None:
    found = judge_noise(added(captured(WIDE, 53), of_stack=light), result, ValidationLimits())
    assert PATTERNS & failed(found) == {"dark level over the sensor"}
    assert "a pattern of" in named(found, "dark level over the sensor").what


def test_hot_pixels_are_no_pattern_of_stack_frames(result: FitResult[Noise]) -> None:
    hot = np.zeros((WIDE.rows, WIDE.columns))
    hot[5:20:3, 7:90:2] = 500.0
    assert not failed(judge_noise(added(captured(WIDE, 54), of_stack=hot), result, ValidationLimits()))


@pytest.mark.parametrize("changes", [{"levels": (0.3,)}, {"dark_times_s": (0.1,)}, {"dark_times_s": (0.1, 0.2)}])
def test_few_exposures_tell_no_pattern_over_them(
    result: FitResult[Noise], changes: dict[str, tuple[float, ...]]
) -> None:
    found = judge_noise(captured(replace(SENSOR, **changes), 55), result, ValidationLimits())  # type: ignore[arg-type]
    assert {check.value for check in found.checks if check.name in PATTERNS} == {0.0}
