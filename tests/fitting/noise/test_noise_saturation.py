"""Where codes end: the saturation that is stated, and its error, for wells and colours that fill alike or do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.noise import PLAIN, capture, measure, truth
from udccal.fitting.noise.data import NoiseData
from udccal.fitting.noise.fit import fit_noise


@pytest.mark.parametrize("read_e", [0.3, 1.2])
def test_rounding_is_in_the_sigma_of_a_saturation_between_codes(read_e: float) -> None:
    sensor = replace(PLAIN, read_e=read_e, row_DN=0.0, DSNU_e=0.0, full_well_e=10_001.25)
    found, true = measure(sensor, 3).estimate("saturation_DN"), truth(sensor)["saturation_DN"]
    assert abs(found.value - true) < 3 * found.sigma
    assert found.sigma < 0.35


def test_rounding_of_noise_with_tails_is_in_the_sigma_of_a_saturation_between_codes() -> None:
    def laplace(rng: np.random.Generator, size: tuple[int, ...]) -> np.ndarray:
        return rng.laplace(size=size) / np.sqrt(2)

    off = []
    for well in (16_653.2, 16_654.4, 16_655.4):
        sensor = replace(PLAIN, K_DN_per_e=0.2294, full_well_e=well, read_e=2.6, row_DN=0.0, DSNU_e=0.0, PRNU=0.013)
        sensor = replace(sensor, other_noise=laplace, flux_e_per_s=5 * well)
        found, true = measure(sensor, 3).estimate("saturation_DN"), truth(sensor)["saturation_DN"]
        off.append(abs(found.value - true) / found.sigma)
        assert found.sigma < 0.3
    assert max(off) < 3


def test_a_bend_that_unsteady_light_hides_is_in_the_sigma_of_the_gain() -> None:
    # The lamp hides the bend from the response; the variances alone do not show it clearly, and K takes its part.
    sensor = replace(PLAIN, rows=144, columns=192, K_DN_per_e=2.8, full_well_e=3800.0, bits=14, bend=-0.008)
    sensor = replace(
        sensor, black_DN=122.0, row_DN=0.0, DSNU_e=0.0, dark_e_per_s=0.0, flux_e_per_s=19_000.0, flicker=0.011
    )
    results = [measure(sensor, seed) for seed in range(3)]
    gains = [result.estimate("K_DN_per_e") for result in results]
    assert any("nonlinearity" not in [one.name for one in result.estimates] for result in results)
    assert max(abs(K.value - 2.8) / K.sigma for K in gains) < 4


def test_a_full_well_just_below_the_last_code_is_in_the_sigma_of_saturation() -> None:
    # Nearly all full pixels are rounded to the last code.
    sensor = replace(PLAIN, bits=8, K_DN_per_e=0.017, black_DN=5.0, full_well_e=249.95 / 0.017, read_e=11.0)
    sensor = replace(sensor, row_DN=0.0, DSNU_e=0.0, flux_e_per_s=5 * 249.95 / 0.017)
    found = measure(sensor, 2).estimate("saturation_DN")
    assert found.value == 255
    assert 0.05 / 3 < found.sigma < 0.1
    beyond = measure(replace(sensor, full_well_e=2e4, read_e=60.0), 2).estimate("saturation_DN")
    assert (beyond.value, beyond.sigma) == (255, 0)


@pytest.mark.parametrize("brightest", [0.5, 0.7])
def test_codes_that_end_in_one_colour_only_are_the_saturation(brightest: float) -> None:
    # Red and blue get half of green's light: less than half of the frame's samples have the converter's last code.
    colours = np.tile([[-0.5, 0.0], [0.0, -0.4]], (48, 64))
    sensor = replace(PLAIN, bits=10, K_DN_per_e=0.1, full_well_e=20_000.0, read_e=15.0, DSNU_e=5.0, pattern=colours)
    sensor = replace(sensor, flux_e_per_s=1e5, levels=(*np.linspace(0.04, 0.4, 9).tolist(), brightest), stack_level=0.2)
    levels, stack = capture(sensor, 1)
    saturation = fit_noise(NoiseData(levels, stack, bayer=True, top_code=1023)).estimate("saturation_DN")
    assert abs(saturation.value - 1023) <= saturation.sigma
    assert saturation.sigma < 0.35


@pytest.mark.parametrize("brightest", [1.15, 0.95])
def test_flats_that_clip_in_their_middle_alone_show_saturation(brightest: float) -> None:
    """No bin is full. Just below saturation, nothing piles up, and the converter's end is the only bound."""
    y, x = np.mgrid[-1:1:96j, -1:1:128j]
    sensor = replace(PLAIN, pattern=-0.4 * (x**2 + y**2), levels=(*PLAIN.levels[:-1], brightest))
    levels, stack = capture(sensor, 3)
    result = fit_noise(NoiseData(levels, stack, top_code=4095))
    found, true = result.estimate("saturation_DN"), truth(sensor)["saturation_DN"]
    seen = brightest > 1
    assert any("No flat reached saturation" in note for note in result.notes) != seen
    assert abs(found.value - true) < 3 * found.sigma
    assert (found.sigma < 0.5) == seen


@pytest.mark.parametrize("top_code", [4095, None])
def test_a_largest_code_that_nobody_gave_is_told_as_a_guess(top_code: int | None) -> None:
    levels, stack = capture(replace(PLAIN, levels=PLAIN.levels[:-1]), 3)
    notes = fit_noise(NoiseData(levels, stack, top_code=top_code)).notes
    assert any("4095 DN, is taken for it" in note for note in notes)
    assert any("top_code was not given" in note for note in notes) == (top_code is None)
