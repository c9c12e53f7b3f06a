from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.simulation.toy import toy_truth
from udccal.cameras.protocol import Region
from udccal.simulation.sensor import Sensor, _counted, tukey_lambda_quantiles
from udccal.simulation.truth import RigTruth

WHOLE = Region(0, 0, 128, 96)


def quiet(truth: RigTruth, **changes: float) -> RigTruth:
    """The same rig with the noise sources that a test does not look at switched off."""
    off = {"PRNU1288": 0.0, "DSNU1288_e": 0.0, "sigma_row_DN": 0.0, "dark_current_e_per_s": 0.0, "hot_fraction": 0.0}
    return replace(truth, sensor=replace(truth.sensor, **(off | changes)))


def stack(sensor: Sensor, rate: float, exposure_s: float, frames: int, gain_dB: float = 0.0) -> np.ndarray:
    even = np.full((96, 128), rate)
    return np.stack(
        [sensor.expose(even, exposure_s, WHOLE, np.random.default_rng(i), gain_dB) for i in range(frames)]
    ).astype(float)


def test_photon_transfer_gives_K() -> None:
    truth = quiet(toy_truth())
    sensor = Sensor(truth)
    dark, bright = stack(sensor, 0.0, 1e-3, 40), stack(sensor, 6e6, 1e-3, 40)
    slope = (bright.var(axis=0, ddof=1).mean() - dark.var(axis=0, ddof=1).mean()) / (bright.mean() - dark.mean())
    assert slope == pytest.approx(truth.sensor.K_DN_per_e, rel=0.01)
    assert dark.mean() == pytest.approx(truth.sensor.black_DN, abs=0.05)


def test_dark_noise_is_sigma_d() -> None:
    truth = toy_truth()
    sensor = Sensor(truth)
    dark = stack(sensor, 0.0, 20e-6, 60)
    variance = dark.var(axis=0, ddof=1).mean() / truth.sensor.K_DN_per_e**2
    quantisation = 1 / 12 / truth.sensor.K_DN_per_e**2
    assert np.sqrt(variance - quantisation) == pytest.approx(sensor.sigma_d_e, rel=0.01)


def test_row_noise_is_common_to_a_row() -> None:
    truth = quiet(toy_truth(), sigma_row_DN=2.0)
    rows = stack(Sensor(truth), 0.0, 1e-3, 40).mean(axis=2)
    pixels = truth.sensor.sigma_read_e * truth.sensor.K_DN_per_e / np.sqrt(128)
    assert rows.std() == pytest.approx(np.hypot(2.0, pixels), rel=0.05)


def test_fixed_patterns_have_their_sizes() -> None:
    truth = toy_truth()
    sensor = Sensor(truth)
    assert sensor.response.std() == pytest.approx(truth.sensor.PRNU1288, rel=0.03)
    assert sensor.offset_e.std() == pytest.approx(truth.sensor.DSNU1288_e, rel=0.03)
    hot = Sensor(quiet(truth, hot_fraction=0.01, dark_current_e_per_s=10.0)).dark_current_e_per_s
    assert (hot > 200).mean() == pytest.approx(0.01, abs=0.004)


def test_saturates_at_the_full_well_and_never_beyond_the_converter() -> None:
    truth = quiet(toy_truth())
    sensor = Sensor(truth)
    frame = stack(sensor, 1e9, 1e-3, 4)
    assert frame.mean() == pytest.approx(sensor.saturation_DN, abs=0.5)
    amplified = stack(sensor, 1e9, 1e-3, 1, gain_dB=6.0)
    assert (amplified == 2**truth.sensor.bits - 1).all()


def test_gain_multiplies_the_signal() -> None:
    truth = quiet(toy_truth())
    plain, amplified = (stack(Sensor(truth), 1e6, 1e-3, 10, gain) - truth.sensor.black_DN for gain in (0.0, 6.0206))
    assert amplified.mean() / plain.mean() == pytest.approx(2.0, rel=2e-3)
    assert amplified.std() / plain.std() == pytest.approx(2.0, rel=0.02)


def test_dark_current_grows_with_exposure() -> None:
    truth = quiet(toy_truth(), dark_current_e_per_s=500.0)
    dark = (stack(Sensor(truth), 0.0, 1.0, 4) - truth.sensor.black_DN) / truth.sensor.K_DN_per_e
    assert dark.mean() == pytest.approx(500.0, rel=0.01)


def test_region_takes_its_own_fixed_pattern() -> None:
    truth = toy_truth()
    noiseless = replace(truth, sensor=replace(truth.sensor, sigma_read_e=1e-3, sigma_row_DN=0.0, DSNU1288_e=300.0))
    sensor = Sensor(noiseless)
    region = Region(10, 20, 30, 40)
    part = sensor.expose(np.zeros((40, 30)), 1e-5, region, np.random.default_rng(0))
    expected = sensor.offset_e[20:60, 10:40] * truth.sensor.K_DN_per_e + truth.sensor.black_DN
    inside = expected > 1
    assert np.abs(part[inside] - expected[inside]).max() < 1.0
    elsewhere = sensor.offset_e[:40, :30] * truth.sensor.K_DN_per_e + truth.sensor.black_DN
    assert np.abs(part - elsewhere).max() > 20.0


@pytest.mark.parametrize("mean", [5.0, 49.0, 51.0, 400.0])
def test_counts_have_the_moments_of_photons(mean: float) -> None:
    counts = _counted(np.full((1000, 1000), mean, np.float32), np.random.default_rng(1)).astype(float)
    centred = counts - counts.mean()
    assert counts.mean() == pytest.approx(mean, rel=2e-3)
    assert counts.var() == pytest.approx(mean, rel=6e-3)
    assert (centred**3).mean() == pytest.approx(mean, rel=0.1)
    normal = mean + np.sqrt(mean) * np.random.default_rng(2).standard_normal(1_000_000)
    assert abs(((normal - mean) ** 3).mean() / mean - 1) > 0.5


def test_read_noise_has_its_shape() -> None:
    from scipy.stats import tukeylambda

    values = tukey_lambda_quantiles(0.08, 4.0)
    p = (np.arange(values.size) + 0.5) / values.size
    reference = tukeylambda.ppf(p, 0.08) / tukeylambda.std(0.08) * 4.0
    np.testing.assert_allclose(values, reference, atol=5e-3)
