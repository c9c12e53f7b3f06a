"""Sensors outside the model: what a fit says of them holds, or a note names what is wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.scenes.noise import PLAIN, captured, errors_in_sigma, measure
from udccal.fitting.noise.data import ExposureLevel, NoiseData, SpatialStack
from udccal.fitting.noise.fit import fit_noise
from udccal.models.noise import Noise
from udccal.result import FitResult, FitStatus

SENSOR = replace(PLAIN, rows=144, columns=192, row_DN=0.0)
SHAPE = (SENSOR.rows, SENSOR.columns)


def changed(data: NoiseData, change: Callable[[np.ndarray, int], np.ndarray]) -> NoiseData:
    """Every frame replaced by a function of its codes and its number."""
    number = iter(range(10_000))

    def new(frames: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
        return tuple(change(frame.astype(int), next(number)).astype(np.uint16) for frame in frames)

    levels = [ExposureLevel(of.exposure_s, new(of.dark), new(of.bright)) for of in data.levels]
    assert data.stack is not None
    stack = SpatialStack(data.stack.exposure_s, new(tuple(data.stack.dark)), new(tuple(data.stack.bright)))
    return NoiseData(levels, stack, top_code=data.top_code)


def z(result: FitResult[Noise], name: str, truth: float) -> float:
    one = result.estimate(name)
    return (one.value - truth) / one.sigma


def noted(result: FitResult[Noise], words: str) -> bool:
    return any(words in note for note in result.notes)


@pytest.mark.parametrize("shape", [2.0, 0.5])
def test_dark_current_that_differs_from_pixel_to_pixel_is_its_mean(shape: float) -> None:
    """Long exposures scatter more than short ones. That was taken for codes cut off: 17 sigma off, and DSNU 100."""
    uneven = np.random.default_rng(4).gamma(shape, 1 / shape, SHAPE)
    result = measure(replace(SENSOR, dark_pattern=uneven / uneven.mean()), 3)
    assert result.status is FitStatus.CONVERGED
    assert noted(result, "one tail")
    assert not noted(result, "cut-off")
    for name, truth in (("K_DN_per_e", 0.36), ("black_DN", 64.0), ("dark_current_e_per_s", 40.0), ("sigma_d_e", 4.0)):
        assert abs(z(result, name, truth)) < 4.5, name


def test_hot_pixels_are_told_and_have_no_part_in_the_read_noise() -> None:
    hot = np.where(np.random.default_rng(5).random(SHAPE) < 0.01, 50.0, 1.0)
    result = measure(replace(SENSOR, dark_pattern=hot), 3)
    assert noted(result, "far from the others (hot or dead pixels)")
    for name, truth in (("black_DN", 64.0), ("dark_current_e_per_s", 40.0), ("sigma_d_e", 4.0)):
        assert abs(z(result, name, truth)) < 4.5, name
    # With codes as coarse as twice the read noise, flats alone show the hot pixels' offsets.
    coarse = measure(replace(SENSOR, dark_pattern=hot, K_DN_per_e=0.1, read_e=1.5), 3)
    assert noted(coarse, "hot pixels, which rounding hides")


@pytest.mark.parametrize("where", [np.s_[[10, 70]], np.s_[:, [10, 70]]])
@pytest.mark.parametrize("offset_DN", [-4095, 300])
def test_dead_lines_and_fixed_offsets_have_no_part_in_the_read_noise(where: slice, offset_DN: int) -> None:
    """They were taken for light: sigma_d was 12 sigma too large beside dead rows, 39 too small beside bright ones."""

    def broken(codes: np.ndarray, _: int) -> np.ndarray:
        codes[where] = np.clip(codes[where] + offset_DN, 0, 4095)
        return codes

    result = fit_noise(changed(captured(SENSOR, 3), broken))
    assert noted(result, "far from the others (hot or dead pixels)")
    for name, truth in (("K_DN_per_e", 0.36), ("black_DN", 64.0), ("dark_current_e_per_s", 40.0), ("sigma_d_e", 4.0)):
        assert abs(z(result, name, truth)) < 4.5, name


@pytest.mark.parametrize("order", [(5, 4, 3, 2, 1, 0), (0, 1, 5, 3, 4, 2)])
def test_dark_frames_with_the_exposure_times_of_others_are_refused(order: tuple[int, ...]) -> None:
    """The fit took their shot noise for tails of the read noise, and sigma_d was 8 sigma too large."""
    data = captured(SENSOR, 3)
    darks, flats = ([of for of in data.levels if len(getattr(of, name))] for name in ("dark", "bright"))
    mixed = [replace(of, exposure_s=darks[other].exposure_s) for of, other in zip(darks, order, strict=True)]
    result = fit_noise(replace(data, levels=[*flats, *mixed]))
    assert result.status is FitStatus.POOR_FIT
    assert noted(result, "does not rise with exposure")


def test_dark_current_that_grows_while_a_sensor_warms_is_no_wrong_exposure_time() -> None:
    data = captured(SENSOR, 3)
    warm = captured(replace(SENSOR, dark_e_per_s=1.2 * SENSOR.dark_e_per_s), 3)
    last = [n for n, of in enumerate(data.levels) if len(of.dark)][-1]
    levels = [*data.levels[:last], warm.levels[last], *data.levels[last + 1 :]]
    assert fit_noise(replace(data, levels=levels)).status is FitStatus.CONVERGED


def test_pixels_one_code_off_in_some_frames_are_not_hot() -> None:
    """Of noise of 0.2 code, most pixels have one code in all frames: 10 % of the others were listed as hot."""
    quiet = replace(SENSOR, bits=8, K_DN_per_e=0.02, black_DN=8.0, read_e=10.0, DSNU_e=0.0, dark_e_per_s=0.0)
    alone = measure(quiet, 3)
    assert not noted(alone, "hot pixels")
    assert not any("(hot)" in one.rule for one in alone.outliers)
    hot = np.random.default_rng(5).random(SHAPE) < 0.002

    def heated(codes: np.ndarray, _: int) -> np.ndarray:
        return np.minimum(codes + 5 * hot, 255)

    listed = next(one for one in fit_noise(changed(captured(quiet, 3), heated)).outliers if "(hot)" in one.rule)
    assert listed.count == int(hot.sum())


def _filtered(kernel: np.ndarray) -> Callable[[np.ndarray, int], np.ndarray]:
    return lambda codes, _: np.rint(cv2.filter2D(codes.astype(np.float64), -1, kernel))


def test_noise_that_neighbours_share_is_told() -> None:
    """K was 36 sigma too small where 1 % of a pixel goes to each neighbour, a ninth where frames are smoothed."""
    coupled = np.array([[0, 0.01, 0], [0.01, 0.96, 0.01], [0, 0.01, 0]])
    for kernel in (coupled, np.full((3, 3), 1 / 9)):
        result = fit_noise(changed(captured(SENSOR, 3), _filtered(kernel)))
        assert result.status is FitStatus.POOR_FIT
        assert noted(result, "Neighbouring pixels share their noise")
        assert result.estimate("K_DN_per_e").value < 0.34


def test_light_that_differs_between_frames_is_no_noise_of_neighbours() -> None:
    """A panel's pattern times a flicker is in the frames' difference, and so is noise of columns."""
    down, across = np.mgrid[: SHAPE[0], : SHAPE[1]]
    panel = 0.1 * np.sin(2 * np.pi * down / 9.3) + 0.1 * np.sin(across / 2.1) - 0.15 * (across / 96 - 1) ** 2
    rng = np.random.default_rng(7)

    def lifted(codes: np.ndarray, _: int) -> np.ndarray:
        return np.maximum(codes + np.rint(3 * rng.standard_normal(SHAPE[1])).astype(int), 0)

    data = changed(captured(replace(SENSOR, pattern=panel, flicker=0.05), 3), lifted)
    assert not noted(fit_noise(data), "Neighbouring pixels")


def test_a_mosaic_that_is_given_as_monochrome_is_told() -> None:
    """PRNU was 14 to 19 sigma off."""
    colours = np.tile([[-0.5, 0.0], [0.0, -0.65]], (72, 96))
    mosaic = captured(replace(SENSOR, pattern=colours), 3)
    assert noted(fit_noise(mosaic), "Give bayer=True")
    assert not noted(fit_noise(replace(mosaic, bayer=True)), "bayer")
    two_gains = np.where(np.arange(SHAPE[0]) % 2, 0.0, 0.03)[:, None] * np.ones(SHAPE)
    uneven = replace(SENSOR, PRNU=0.05, pattern=two_gains, levels=(0.002, 0.004, 0.006, 0.01), stack_level=0.003)
    assert not noted(measure(uneven, 3), "bayer")


def test_a_glow_in_one_corner_is_part_of_the_dark_current() -> None:
    down, across = np.mgrid[: SHAPE[0], : SHAPE[1]]
    glow = 1 + 50 * np.exp(-(down**2 + across**2) / 30**2)
    result = measure(replace(SENSOR, dark_pattern=glow), 3)
    assert noted(result, "one tail")
    assert abs(z(result, "dark_current_e_per_s", 40 * float(glow.mean()))) < 4.5
    assert abs(z(result, "black_DN", 64.0)) < 4.5


def test_black_is_the_mean_of_skewed_read_noise() -> None:
    """A symmetric distribution has its middle elsewhere: 25 sigma off."""
    sensor = replace(SENSOR, other_noise=lambda rng, size: rng.exponential(size=size) - 1)
    result = measure(sensor, 3)
    assert noted(result, "one tail")
    assert abs(z(result, "black_DN", 64.0)) < 4.5
    assert not noted(measure(SENSOR, 3), "one tail")


def test_a_black_level_that_moves_is_told_and_in_the_sigmas() -> None:
    """Dark current was 54 sigma off where black falls with the exposure, and black 64 where it jumps."""
    jumps = 0.8 * np.random.default_rng(6).standard_normal(100)
    sensor = replace(SENSOR, K_DN_per_e=1.5, bits=14)
    result = fit_noise(changed(captured(sensor, 3), lambda codes, k: codes + int(np.rint(2 * jumps[k]))))
    assert noted(result, "from exposure to exposure")
    for name, truth in (("dark_current_e_per_s", 40.0), ("black_DN", 64.0), ("saturation_DN", 15064.0)):
        assert abs(z(result, name, truth)) < 4.5, name
    assert not noted(measure(sensor, 3), "from exposure to exposure")


def test_dark_current_that_grows_while_exposures_do_is_told() -> None:
    """It was called a tail of the read noise, and dark current was 9 sigma above that of the first frames."""
    times, rng = tuple(np.linspace(0.1, 1.0, 10).tolist()), np.random.default_rng(9)
    sensor = replace(SENSOR, K_DN_per_e=1.0, bits=14, dark_times_s=times)
    first = 2 * len(sensor.levels)

    def warmer(codes: np.ndarray, k: int) -> np.ndarray:
        seconds = times[(k - first) // 2] if first <= k < first + 2 * len(times) else 0.1
        return codes + rng.poisson(40.0 * seconds * 0.04 * max(k - first, 0), SHAPE)

    data = captured(sensor, 3)
    result = fit_noise(changed(data, warmer))
    assert noted(result, "dark current or black drifted")
    assert not noted(result, "one tail")
    assert abs(z(result, "dark_current_e_per_s", 40.0)) < 4.5
    assert not noted(fit_noise(data), "drifted")


@pytest.mark.parametrize("change", [lambda codes, _: codes | 4, lambda codes, _: codes + (codes % 8 == 3)])
def test_codes_that_never_occur_are_told(change: Callable[[np.ndarray, int], np.ndarray]) -> None:
    assert noted(fit_noise(changed(captured(SENSOR, 3), change)), "never occur")
    assert not noted(measure(SENSOR, 3), "never occur")


@pytest.mark.parametrize("seed", [0, 2])
def test_bands_of_rows_count_as_few_rows(seed: int) -> None:
    """All rows counted, though two numbers describe a band: DSNU was up to 31 sigma off, of 32 frames."""
    rng = np.random.default_rng(seed)

    def banded(codes: np.ndarray, _: int) -> np.ndarray:
        rows = 1.5 * np.sin(2 * np.pi * (np.arange(SHAPE[0]) / 48 + rng.random()))
        return np.rint(codes + rows[:, None] + rng.random(SHAPE) - 0.5).astype(int)

    sensor = replace(SENSOR, K_DN_per_e=1.0, bits=14, DSNU_e=1.0)
    result = fit_noise(changed(captured(sensor, seed), banded))
    assert noted(result, "in bands")
    # Dithered codes have the variance of rounding once more.
    true = {"DSNU1288_e": 1.0, "sigma_row_DN": 1.5 / 2**0.5, "sigma_d_e": (16 + 1.125 + 1 / 12) ** 0.5}
    for name, truth in true.items():
        assert abs(z(result, name, truth)) < 3.0, name


@pytest.mark.parametrize("seed", [0, 2])
def test_noise_that_columns_share_is_told_and_its_draws_are_in_the_sigmas(seed: int) -> None:
    """Pixels counted, and not columns: the sigmas of sigma_d and DSNU were half of what they are."""
    rng = np.random.default_rng(seed)

    def striped(codes: np.ndarray, _: int) -> np.ndarray:
        return np.rint(codes + 2 * rng.standard_normal(SHAPE[1]) + rng.random(SHAPE) - 0.5).astype(int)

    sensor = replace(SENSOR, K_DN_per_e=1.0, bits=14, DSNU_e=1.0)
    data = captured(sensor, seed)
    result = fit_noise(changed(data, striped))
    assert noted(result, "Columns share noise of")
    true = {"DSNU1288_e": 1.0, "K_DN_per_e": 1.0, "sigma_d_e": (16 + 4 + 1 / 12) ** 0.5}
    for name, truth in true.items():
        assert abs(z(result, name, truth)) < 3.0, name
    assert not noted(fit_noise(data), "share noise")


@pytest.mark.parametrize("bent_DN", [0, 100])
def test_noise_in_proportion_to_the_signal_of_a_pixel_is_told(bent_DN: int) -> None:
    """It was no part of the curve. Where chi-squared of all bins did not see it, K was up to 21 sigma too large."""
    rng = np.random.default_rng(8)

    def noisy(codes: np.ndarray, _: int) -> np.ndarray:
        light = (codes - 64) * (1 + 0.003 * rng.standard_normal(SHAPE))
        return np.rint(64 + light - bent_DN * (light / 3600) ** 2).astype(int)

    result = fit_noise(changed(captured(SENSOR, 3), noisy))
    assert noted(result, "% of their signal beside shot noise")
    assert noted(result, "bends") == (bent_DN > 0)
    assert result.diagnostic("gain_noise") == pytest.approx(0.003, rel=0.2)
    for name, truth in (("K_DN_per_e", 0.36), ("sigma_d_e", 4.0)):
        assert abs(z(result, name, truth)) < 4.5, name
    assert not noted(measure(SENSOR, 3), "beside shot noise")


@pytest.mark.parametrize(
    ("seed", "knee", "width", "told"),
    [
        (0, 0.6, 0.4, "Flats above 70 % of saturation do not follow the curve"),
        (1, 0.6, 0.4, "Flats above 70 % of saturation do not follow the curve"),
        (1, 0.62, 0.5, "All variances of flat 6"),
    ],
)
def test_a_response_that_saturates_softly_is_told_where_it_begins_to(
    seed: int, knee: float, width: float, told: str
) -> None:
    """The bright flats were outliers, and K was up to 7 sigma too small by the next ones."""

    def soft(codes: np.ndarray, _: int) -> np.ndarray:
        part = (codes - 64) / 3600
        bent = np.where(part < knee, part, knee + width * np.tanh((part - knee) / width))
        return np.rint(64 + 3600 * bent).astype(int)

    sensor = replace(SENSOR, levels=(0.05, 0.15, 0.25, 0.35, 0.45, 0.6, 0.75, 1.4), stack_level=0.63, stack_frames=24)
    data = captured(sensor, seed)
    result = fit_noise(changed(data, soft))
    # Flat 6, of three quarters of the well, is the only one that bends.
    assert noted(result, told)
    for name, truth in (("K_DN_per_e", 0.36), ("sigma_d_e", 4.0)):
        assert abs(z(result, name, truth)) < 3.0, name
    assert not noted(fit_noise(data), "do not follow")
    assert not noted(fit_noise(data), "All variances")


def test_a_step_that_grows_with_the_signal_is_told() -> None:
    """That of one bright frame was taken for all: the fit was refused, with advice on exposure times."""
    result = fit_noise(changed(captured(SENSOR, 3), lambda codes, _: np.where(codes > 1000, codes // 2 * 2, codes)))
    assert result.status is FitStatus.CONVERGED
    assert noted(result, "Codes are 1 DN apart, but 2 DN in frames of")
    for name, truth in (("K_DN_per_e", 0.36), ("black_DN", 64.0), ("q_DN", 1.0), ("sigma_d_e", 4.0)):
        assert abs(result.estimate(name).value - truth) <= 4.5 * result.estimate(name).sigma, name
    assert not noted(fit_noise(changed(captured(SENSOR, 3), lambda codes, _: codes // 2 * 2)), "DN apart")


def test_saturation_is_that_of_full_pixels() -> None:
    """Of a flat that a lens shades by 30 % the corners are not full, and 0.06 DN were 10 sigma."""
    down, across = np.mgrid[: SHAPE[0], : SHAPE[1]]
    shaded = -0.15 * ((down / 72 - 1) ** 2 + (across / 96 - 1) ** 2)
    assert abs(z(measure(replace(SENSOR, pattern=shaded), 3), "saturation_DN", 3664.0)) < 4.5
    alive = np.indices(SHAPE).sum(axis=0) % 97 > 0
    dead = fit_noise(changed(captured(SENSOR, 3), lambda codes, _: codes * alive))
    assert abs(z(dead, "saturation_DN", 3664.0)) < 4.5
    assert measure(SENSOR, 3).estimate("saturation_DN").sigma < 0.01


def test_a_response_that_bends_otherwise_has_its_gain_within_sigma() -> None:
    """It bends with the third power: the quadratic that is fitted was 8 sigma off at small signals."""
    sensor = replace(SENSOR, K_DN_per_e=1.5, bits=14)

    def bent(codes: np.ndarray, _: int) -> np.ndarray:
        part = (codes - 64) / 15_000
        return np.rint(codes - 1500 * part**3).astype(int)

    result = fit_noise(changed(captured(sensor, 3), bent))
    assert result.status is FitStatus.CONVERGED
    assert abs(z(result, "K_DN_per_e", 1.5)) < 4.5
    assert abs(z(result, "sigma_d_e", 4.0)) < 4.5
    assert max(abs(errors_in_sigma(measure(sensor, 3), sensor))) < 4.5
