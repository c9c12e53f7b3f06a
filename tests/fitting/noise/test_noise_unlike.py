"""Frames that contradict the others are named in a sentence, and good ones that look like them are fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.noise import PLAIN, capture, captured, measure
from udccal.fitting.noise.data import ExposureLevel, NoiseData
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
