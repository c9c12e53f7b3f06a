"""Frames that contradict the others are named in a sentence, and good ones that look like them are fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.noise import PLAIN, capture, captured, measure
from udccal.fitting.noise.data import Averaged, ExposureLevel, NoiseData, SpatialStack
from udccal.fitting.noise.fit import fit_noise
from udccal.models.noise import Noise
from udccal.result import FitResult, FitStatus


def with_level(index: int, **frames: object) -> FitResult[Noise]:
    """The fit where one level has other ``frames``."""
    levels, stack = capture(PLAIN, 3)
    levels[index] = replace(levels[index], **frames)  # type: ignore[arg-type]
    return fit_noise(NoiseData(levels, stack, top_code=4095))


def exposure(index: int) -> str:
    return f"{PLAIN.exposure_s(PLAIN.levels[index]):.4g} s"


@pytest.mark.parametrize("index", [0, 3, 8])
@pytest.mark.parametrize("exchanged", [True, False])
def test_a_dark_pair_that_is_lit_is_named(index: int, exchanged: bool) -> None:
    """It ended in a ZeroDivisionError."""
    level = capture(PLAIN, 3)[0][index]
    # A pair of other frames of the same light: the same ones would count twice.
    lit = capture(PLAIN, 4)[0][index].bright
    result = with_level(index, dark=lit, bright=level.dark if exchanged else level.bright)
    assert result.status is FitStatus.POOR_FIT
    assert f"or leave the dark ones of {exposure(index)} out" in result.notes[0]


def test_the_longest_dark_pair_that_is_lit_is_named() -> None:
    levels, _ = capture(PLAIN, 3)
    levels[8:] = [replace(levels[8], dark=capture(PLAIN, 4)[0][8].bright)]
    result = fit_noise(NoiseData(levels, top_code=4095))
    assert result.status is FitStatus.POOR_FIT
    assert f"or leave the dark ones of {exposure(8)} out" in result.notes[0]


@pytest.mark.parametrize("kind", ["dark", "bright"])
@pytest.mark.parametrize("rows", [slice(0, 2), slice(40, 96)])
def test_a_torn_frame_is_named(kind: str, rows: slice) -> None:
    """Half of a dark frame that was the one before left sigma_d 91 sigma off, in silence."""
    first, second = (frame.copy() for frame in getattr(capture(PLAIN, 3)[0][4], kind))
    second[rows] = first[rows]
    result = with_level(4, **{kind: (first, second)})
    assert result.status is FitStatus.POOR_FIT
    assert f"found {rows.stop - rows.start} of 96 rows of one frame in the other: they are torn" in result.notes[0]


def averaged(claimed: int, frames: int = 8) -> FitResult[Noise]:
    """The fit with averages of ``frames`` frames that are said to be of ``claimed``."""
    levels, stack = capture(replace(PLAIN, DSNU_e=0.0, PRNU=0.0, stack_frames=frames), 3)
    means = [
        np.mean(np.array(each), axis=0, dtype=np.float64).astype(np.float32) for each in (stack.dark, stack.bright)
    ]
    dark, bright = (Averaged(stack.exposure_s, mean, claimed) for mean in means)
    return fit_noise(NoiseData(levels, SpatialStack(stack.exposure_s, dark, bright), top_code=4095))


@pytest.mark.parametrize("claimed", [1, 3])
def test_an_average_of_more_frames_than_it_says_is_named(claimed: int) -> None:
    result = averaged(claimed)
    assert result.status is FitStatus.POOR_FIT
    assert f"as those of {claimed} frames do" in result.notes[0]


def test_an_average_of_a_sensor_without_patterns_is_fitted() -> None:
    assert averaged(8).ok


@pytest.mark.parametrize("value", [0, 64, 4095])
def test_rows_of_one_code_and_noise_below_a_code_are_not_torn(value: int) -> None:
    levels, stack = capture(replace(PLAIN, read_e=0.3, row_DN=0.0, K_DN_per_e=0.3), 3)
    dark = tuple(frame.copy() for frame in levels[4].dark)
    for frame in dark:
        frame[10] = value
    levels[4] = replace(levels[4], dark=dark)
    assert not any("torn" in note for note in fit_noise(NoiseData(levels, stack, top_code=4095)).notes)


@pytest.mark.parametrize("offset_DN", [-6, 6])
def test_black_that_drifts_by_a_few_codes_is_fitted(offset_DN: int) -> None:
    dark = capture(PLAIN, 3)[0][3].dark
    result = with_level(3, dark=tuple((frame.astype(int) + offset_DN).astype(np.uint16) for frame in dark))
    assert result.status is FitStatus.CONVERGED
    assert abs(result.estimate("K_DN_per_e").value - 0.36) < 4.5 * result.estimate("K_DN_per_e").sigma


def test_dark_current_that_fills_pixels_is_fitted() -> None:
    times = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
    result = measure(replace(PLAIN, dark_e_per_s=9_000.0, dark_times_s=times, bits=14, K_DN_per_e=1.0), 3)
    assert not any("in proportion to exposure" in note for note in result.notes)
    assert result.ok


@pytest.mark.parametrize("index", [0, 5])
@pytest.mark.parametrize("others", [0, 1])
def test_a_dark_pair_that_is_stuck_at_a_code_is_named(index: int, others: int) -> None:
    """It ended in a LinAlgError; with one sample of another code, DSNU was 0 and nothing was said."""
    first = np.full((PLAIN.rows, PLAIN.columns), 66, np.uint16)
    second = first.copy()
    second[0, 0] += others
    result = with_level(index, dark=(first, second))
    assert result.status is FitStatus.POOR_FIT
    assert f"dark frames of {exposure(index)}" in result.notes[0]
    assert "stuck" in result.notes[0]


def test_noise_far_below_a_code_is_fitted_though_dark_current_has_more() -> None:
    """Dark frames of 10 ms then have one code, and those of 1 s have a noise of two."""
    data = captured(replace(PLAIN, read_e=0.2, row_DN=0.0, DSNU_e=0.0), 3)
    shortest = next(of for of in data.levels if len(of.dark))
    steady = ExposureLevel(1e-4, tuple(np.full_like(frame, 64) for frame in shortest.dark))
    result = fit_noise(replace(data, levels=[steady, *data.levels]))
    assert result.ok


@pytest.mark.parametrize("strength", [0.0, 0.2])
def test_a_gain_that_differs_over_the_sensor_is_named(strength: float) -> None:
    """A camera that corrects its lens's shading multiplies codes, and their noise, by more towards the corners."""
    sensor = replace(PLAIN, rows=256, columns=320)
    v, u = np.mgrid[-1:1:256j, -1:1:320j]
    gain = 1 + strength * (u**2 + v**2)

    def corrected(frames: tuple[np.ndarray, ...] | list[np.ndarray]) -> tuple[np.ndarray, ...]:
        black = sensor.black_DN
        return tuple(np.clip(np.rint(black + gain * (one - black)), 0, 4095).astype(np.uint16) for one in frames)

    data = captured(sensor, 2)
    levels = [replace(one, bright=corrected(one.bright), dark=corrected(one.dark)) for one in data.levels]
    stack = replace(data.stack, bright=corrected(data.stack.bright), dark=corrected(data.stack.dark))
    result = fit_noise(replace(data, levels=levels, stack=stack))
    told = [note for note in result.notes if "from place to place on the sensor" in note]
    assert len(told) == (strength > 0)
    for note in told:
        assert float(note.split("K differs by ")[1].split(" %")[0]) == pytest.approx(
            100 * gain.std() / gain.mean(), rel=0.25
        )
