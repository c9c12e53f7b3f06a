"""Read noise that none of the fitted distributions describes, and frames given in other ways than meant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.scenes.noise import PLAIN, ToySensor, errors_in_sigma, measure
from udccal.errors import FitError
from udccal.fitting.engine.orders import Quantity
from udccal.fitting.noise.dark_noise import unexplained_variance
from udccal.fitting.noise.data import ExposureLevel, NoiseData, NoiseRules
from udccal.fitting.noise.fit import fit_noise
from udccal.fitting.noise.line_noise import LineNoise, column_noise
from udccal.fitting.noise.moments import reduced
from udccal.fitting.noise.patterns import dsnu
from udccal.result import FitResult, FitStatus

SENSOR = ToySensor(rows=192, columns=256, lambda_read=None, row_DN=0.0, bend=0.0, DSNU_e=1.0)
NOISES = {
    "normal": (SENSOR, 4.0),
    "Student t, 4": (replace(SENSOR, other_noise=lambda rng, size: rng.standard_t(4, size) / np.sqrt(2)), 4.0),
    "Student t, 8": (replace(SENSOR, other_noise=lambda rng, size: rng.standard_t(8, size) / np.sqrt(8 / 6)), 4.0),
    "Laplace": (replace(SENSOR, other_noise=lambda rng, size: rng.laplace(size=size) / np.sqrt(2)), 4.0),
    "even": (replace(SENSOR, other_noise=lambda rng, size: rng.uniform(-(3**0.5), 3**0.5, size)), 4.0),
    "telegraph": (replace(SENSOR, telegraph=0.05), 4.0 * (1 + 0.05 * 8) ** 0.5),
}


def estimate(result: FitResult, name: str) -> tuple[float, float]:
    return next((one.value, one.sigma) for one in result.estimates if one.name == name)


@pytest.mark.parametrize("name", NOISES)
def test_any_read_noise_has_its_variance_within_sigma_or_a_note(name: str) -> None:
    sensor, truth = NOISES[name]
    for seed in range(2):
        result = measure(sensor, seed)
        assert result.status is FitStatus.CONVERGED
        value, sigma = estimate(result, "sigma_d_e")
        # The fraction of telegraph pixels is itself drawn.
        drawn = truth * 0.5 * 8 * (0.05 * 0.95 / (192 * 256)) ** 0.5 / 1.4 if name == "telegraph" else 0.0
        assert abs(value - truth) < 4.5 * np.hypot(sigma, drawn)
        assert sigma < 0.012 * truth
        dsnu, dsnu_sigma = estimate(result, "DSNU1288_e")
        assert abs(dsnu - sensor.DSNU_e) < 4.5 * dsnu_sigma + 0.02
        assert abs(estimate(result, "K_DN_per_e")[0] / 0.36 - 1) < 0.01
        noted = any("tails" in note for note in result.notes)
        assert noted == (name in ("Student t, 4", "telegraph")) or name in ("Student t, 8", "Laplace", "even")


def test_what_is_not_white_in_flats_is_told() -> None:
    base = replace(SENSOR, PRNU=0.0)
    columns = np.random.default_rng(8).standard_normal(256)
    blotches = cv2.GaussianBlur(np.random.default_rng(9).standard_normal((192, 256)), (0, 0), 3.0)
    for unevenness in (np.tile(columns / columns.std(), (192, 1)), blotches / blotches.std()):
        sensor = replace(base, pattern=0.006 * unevenness)
        result = measure(sensor, 0)
        (note,) = [one for one in result.notes if "white" in one]
        assert float(note.split("vary by ")[1].split(" %")[0]) == pytest.approx(0.6, abs=0.03)
        assert estimate(result, "PRNU1288")[0] < 0.001
    assert not [one for one in measure(SENSOR, 0).notes if "white" in one]


def pair(rng: np.random.Generator, electrons: float, kind: str = "<u2") -> tuple[np.ndarray, np.ndarray]:
    counts = rng.poisson(electrons, (2, 96, 128))
    first, second = np.rint(64 + 0.36 * (counts + 4 * rng.standard_normal(counts.shape))).astype(kind)
    return first, second


def levels(exposures_s: np.ndarray, kind: str = "<u2", seed: int = 0) -> list[ExposureLevel]:
    rng = np.random.default_rng(seed)
    return [ExposureLevel(float(t), pair(rng, 0.0, kind), pair(rng, 1e5 * t, kind)) for t in exposures_s]


def test_bytes_may_lie_either_way_round() -> None:
    times = np.linspace(0.005, 0.05, 6)
    results = [fit_noise(NoiseData(levels(times, kind), top_code=4095)) for kind in ("<u2", ">u2")]
    assert estimate(results[0], "K_DN_per_e") == estimate(results[1], "K_DN_per_e")


def test_dark_and_bright_frames_exchanged_are_named() -> None:
    swapped = [ExposureLevel(one.exposure_s, one.bright, one.dark) for one in levels(np.linspace(0.005, 0.05, 6))]
    with pytest.raises(FitError, match="exchanged"):
        fit_noise(NoiseData(swapped))


@pytest.mark.parametrize("times_s", [(0.005, 0.05), (0.05, 0.5), (0.005, 0.5)])
def test_exchanged_frames_of_any_times_are_named(times_s: tuple[float, float]) -> None:
    """Bright frames of these times as dark ones, beside dark ones of 5 to 50 ms as bright ones."""
    rng, dark_s = np.random.default_rng(1), np.linspace(0.005, 0.05, 6)
    swapped = [ExposureLevel(float(t), bright=pair(rng, 300 * t)) for t in dark_s]
    swapped += [ExposureLevel(float(t), dark=pair(rng, 300 * t + 1e4 * t)) for t in np.linspace(*times_s, 6)]
    with pytest.raises(FitError, match="exchanged"):
        fit_noise(NoiseData(swapped))


def test_long_darks_may_be_brighter_than_dim_flats() -> None:
    """300 e- of dark current in the longest dark, beside at most 60 e- of light in the flats."""
    sensor = replace(
        PLAIN, rows=64, columns=64, full_well_e=20_000.0, dark_e_per_s=300.0, flux_e_per_s=20_000.0,
        levels=tuple(3e-3 * np.linspace(0.05, 1, 7)), stack_level=1.5e-3, stack_frames=4,
    )  # fmt: skip
    result = measure(sensor, 0)
    assert result.status is FitStatus.CONVERGED
    assert np.abs(errors_in_sigma(result, sensor)).max() < 5.5


def test_a_pair_given_twice_is_refused() -> None:
    once = levels(np.linspace(0.005, 0.05, 6))
    with pytest.raises(FitError, match="same frames"):
        fit_noise(NoiseData([*once, once[2]]))


def test_one_exposure_time_does_not_tell_dark_current_from_black() -> None:
    for exposure_s in (0.0, 0.02):
        rng = np.random.default_rng(3)
        same = [ExposureLevel(exposure_s, pair(rng, 0.0), pair(rng, e)) for e in (500, 1000, 2000, 4000, 8000)]
        result = fit_noise(NoiseData(same, top_code=4095))
        assert any("dark current" in note for note in result.notes)
        for name, truth in (("K_DN_per_e", 0.36), ("sigma_d_e", 4.0), ("black_DN", 64.0)):
            value, sigma = estimate(result, name)
            assert abs(value - truth) < 4.5 * sigma
            assert sigma < 0.02 * truth


def test_variance_leaves_out_hits_of_radiation() -> None:
    data = levels(np.linspace(0.005, 0.05, 6))
    clean = reduced(NoiseData(data, top_code=4095), NoiseRules())
    for level in data:
        level.dark[0][7, 9] = 4000
    hit = reduced(NoiseData(data, top_code=4095), NoiseRules())
    assert clean is not None
    assert hit is not None
    columns = column_noise(clean)
    few, many = (unexplained_variance(hit, np.zeros(6), most, columns) for most in (1e-3, 1e-5))
    assert few.value == pytest.approx(unexplained_variance(clean, np.zeros(6), 1e-3, columns).value, rel=1e-3)
    assert many.value > 2 * few.value


def test_coarse_codes_state_sigmas_that_hold_for_other_noise_than_the_models() -> None:
    coarse = replace(SENSOR, K_DN_per_e=0.0202, bits=8, full_well_e=12_000.0, read_e=9.9, telegraph=0.03)
    result = measure(coarse, 0)
    value, sigma = estimate(result, "sigma_d_e")
    assert abs(value - 9.9 * (1 + 0.03 * 8) ** 0.5) < 4.5 * sigma
    assert any("of the model's kind" in note for note in result.notes)


def test_jumping_pixels_below_a_code_are_in_the_sigma_of_dark_noise() -> None:
    # A few pixels that jump by five sigma: their tails are not of the model's kind, and rounding hides most of them.
    def jumping(rng: np.random.Generator, size: tuple[int, ...]) -> np.ndarray:
        restless = np.arange(np.prod(size)).reshape(size) % 28 == 0
        return rng.standard_normal(size) + 5 * restless * rng.choice([-1, 0, 1], size, p=[1 / 9, 7 / 9, 1 / 9])

    coarse = replace(SENSOR, K_DN_per_e=0.0563, bits=10, full_well_e=18_000.0, read_e=7.46, black_DN=19.58, DSNU_e=2.1)
    value, sigma = estimate(measure(replace(coarse, other_noise=jumping), 0), "sigma_d_e")
    truth = 7.46 * (1 + 25 * 2 / 9 / 28) ** 0.5
    assert abs(value - truth) < 2.5 * sigma
    # A rig of this kind was 4 % off. A sigma of the excess over the model's noise alone would be 1 %.
    assert 0.013 * truth < sigma < 0.05 * truth


def test_dark_current_bends_as_light_does() -> None:
    bent = replace(SENSOR, bend=0.12, dark_e_per_s=600.0, full_well_e=3000.0, K_DN_per_e=1.2, flux_e_per_s=15_000.0)
    result = measure(bent, 0)
    for name, truth in (("black_DN", 64.0), ("dark_current_e_per_s", 600.0)):
        value, sigma = estimate(result, name)
        assert abs(value - truth) < 4.5 * sigma


def student(freedom: float) -> Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]:
    return lambda rng, size: rng.standard_t(freedom, size) / np.sqrt(freedom / (freedom - 2))


@pytest.mark.parametrize(
    ("freedom", "K", "read_e", "bits", "black_DN"),
    [(3.7, 0.45, 1.5, 10, 30.0), (3.0, 4.2, 2.3, 16, 1000.0), (3.0, 4.2, 2.3, 16, 64.0)],
)
def test_read_noise_whose_tails_hold_much_of_its_variance_is_within_sigma(
    freedom: float, K: float, read_e: float, bits: int, black_DN: float
) -> None:
    """Tails look like hits, are missing by chance more often than not, and code 0 may cut them off."""
    well = 0.8 * (2**bits - black_DN) / K
    heavy = replace(
        SENSOR, K_DN_per_e=K, read_e=read_e, bits=bits, black_DN=black_DN, full_well_e=well, dark_e_per_s=0.0
    )
    for seed in range(3):
        value, sigma = estimate(measure(replace(heavy, other_noise=student(freedom)), seed), "sigma_d_e")
        assert abs(value - read_e) < 4.5 * sigma
        assert sigma < 0.3 * read_e


def test_offsets_of_pixels_are_not_lost_among_noise_with_tails() -> None:
    """Pixels that jump are noisy in the average of a few frames: left out as defects, they take no noise with them."""
    rng, rows = np.random.default_rng(4), LineNoise(Quantity(0.0, 0.0, False), 299.0, False)
    noise = np.where(rng.random((300, 300)) < 0.08, 3.0, 1.0)
    dark = 64.0 + 0.3 * rng.standard_normal(noise.shape) + noise * rng.standard_normal(noise.shape)
    temporal = Quantity(float(np.mean(noise**2)), 1e-6)
    for tails in (True, False):
        found = dsnu(dark, temporal, rows, rows, 1, NoiseRules().defect_sigma, 1, tails)
        assert found.sigma < 0.09
        assert (abs(found.variance - 0.09) < 2.5 * found.sigma) is tails
