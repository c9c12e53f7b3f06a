"""The noise fit against the simulated sensor of two cameras that share no number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from udccal.cameras.protocol import Region
from udccal.fitting import nonuniformity, photon_transfer, read_noise
from udccal.fitting.noise import NoiseData, converter_step, fit_noise_data, nominal_noise
from udccal.fitting.result import FitResult, FitStatus
from udccal.models.noise import Noise
from udccal.rig import RigDescription, load_rig
from udccal.simulation.sensor import Sensor
from udccal.simulation.truth import draw_truth

ROWS, COLUMNS = 240, 320
STACK = 12


def toy(name: str, seed: int) -> tuple[RigDescription, Sensor]:
    rig = load_rig(name)
    rig = rig.model_copy(update={"camera": rig.camera.model_copy(update={"rows": ROWS, "columns": COLUMNS})})
    return rig, Sensor(draw_truth(rig, seed))


def reduced(sensor: Sensor, levels: np.ndarray, seed: int) -> NoiseData:
    """Frames as the noise procedure takes them; ``levels`` are fractions of the full well."""
    rng = np.random.default_rng(seed)
    region = Region(0, 0, COLUMNS, ROWS)
    y, x = np.mgrid[:ROWS, :COLUMNS]
    # Shaded, modulated by rows, and of four colours, as a flat seen through the panel is.
    light = (1 - 0.3 * ((x / COLUMNS - 0.5) ** 2 + (y / ROWS - 0.5) ** 2)) * (1 + 0.02 * np.cos(2 * np.pi * y / 40))
    light = light * np.tile([[0.6, 1.0], [1.0, 0.7]], (ROWS // 2, COLUMNS // 2)) * sensor.truth.full_well_e / 0.02
    none = np.zeros((ROWS, COLUMNS))
    flats, darks, rows = [], [], []
    for t in 0.02 * levels:
        # The lamp flickers by half a per cent.
        pair = [sensor.expose(light * (1 + 0.005 * rng.standard_normal()), t, region, rng) for _ in range(2)]
        flats.append(photon_transfer.bin_pair(pair[0], pair[1], float(t)))
    for t in (0.0005, 0.002, 0.01, 0.02, 0.25, 1.0):
        pair = [sensor.expose(none, t, region, rng) for _ in range(2)]
        darks.append(read_noise.dark_pair(pair[0], pair[1], t))
        rows.append(nonuniformity.row_moments(pair[0], pair[1]))
    middle = 0.02 * float(levels[len(levels) // 2])
    return NoiseData(
        darks=tuple(darks),
        rows=tuple(rows),
        flats=tuple(flats),
        flat_stack=np.mean([sensor.expose(light, middle, region, rng) for _ in range(STACK)], axis=0),
        dark_stack=np.mean([sensor.expose(none, middle, region, rng) for _ in range(STACK)], axis=0),
        flat_frames=STACK,
        dark_frames=STACK,
        q_DN=1,
    )


@pytest.fixture(scope="module", params=["lg55-aca2040", "mk31-imx1600"])
def fitted(request: pytest.FixtureRequest) -> tuple[Sensor, FitResult[Noise]]:
    rig, sensor = toy(request.param, seed=3)
    return sensor, fit_noise_data(reduced(sensor, np.linspace(0.02, 1.6, 14), 5), nominal_noise(rig))


def test_recovers_what_the_rig_needs(fitted: tuple[Sensor, FitResult[Noise]]) -> None:
    sensor, result = fitted
    truth, term = sensor.truth, result.or_raise("noise").term
    assert term.K_DN_per_e == pytest.approx(truth.K_DN_per_e, rel=0.01)
    assert term.sigma_d_e == pytest.approx(sensor.sigma_d_e, rel=0.03)
    assert pytest.approx(truth.PRNU1288, rel=0.05) == term.PRNU1288
    assert term.saturation_DN == pytest.approx(sensor.saturation_DN, abs=1.5)
    assert term.sigma_row_DN == pytest.approx(truth.sigma_row_DN, rel=0.15)


def test_errors_are_as_large_as_claimed(fitted: tuple[Sensor, FitResult[Noise]]) -> None:
    sensor, result = fitted
    truth = sensor.truth
    expected = {
        "K_DN_per_e": truth.K_DN_per_e,
        "black_DN": truth.black_DN,
        "sigma_d_e": sensor.sigma_d_e,
        "lambda_read": truth.lambda_read,
        "dark_current_e_per_s": truth.dark_current_e_per_s,
        "DSNU1288_e": truth.DSNU1288_e,
        "PRNU1288": truth.PRNU1288,
    }
    z = {name: (result.estimate(name).value - value) / result.estimate(name).sigma for name, value in expected.items()}
    assert max(abs(v) for v in z.values()) < 4.5, z
    assert 0.5 < result.chi2_dof < 2.0


def test_no_light_is_too_dark() -> None:
    rig, sensor = toy("lg55-aca2040", 1)
    result = fit_noise_data(reduced(sensor, np.full(6, 1e-5), 1), nominal_noise(rig))
    assert result.status is FitStatus.TOO_DARK
    assert result.term.K_DN_per_e == rig.camera.K_DN_per_e.value


def test_clipped_flats_are_saturated() -> None:
    rig, sensor = toy("lg55-aca2040", 1)
    result = fit_noise_data(reduced(sensor, np.linspace(3.0, 4.0, 6), 1), nominal_noise(rig))
    assert result.status is FitStatus.SATURATED


def test_two_levels_are_too_few() -> None:
    rig, sensor = toy("lg55-aca2040", 1)
    result = fit_noise_data(reduced(sensor, np.array([0.2, 0.4]), 1), nominal_noise(rig))
    assert result.status is FitStatus.TOO_FEW_DATA


def test_a_lamp_of_changing_pattern_is_a_poor_fit() -> None:
    rig, sensor = toy("lg55-aca2040", 1)
    data = reduced(sensor, np.linspace(0.05, 0.6, 8), 1)
    bent = tuple(replace(flat, variance_DN2=flat.variance_DN2 * (1 + flat.mean_DN / 1000)) for flat in data.flats)
    assert fit_noise_data(replace(data, flats=bent), nominal_noise(rig)).status is FitStatus.POOR_FIT


def test_pairs_of_one_frame_twice_are_a_poor_fit() -> None:
    rig, sensor = toy("lg55-aca2040", 3)
    data = reduced(sensor, np.linspace(0.05, 0.6, 8), 3)
    light = np.full((ROWS, COLUMNS), sensor.truth.full_well_e / 0.02)
    twice = []
    for t in 0.02 * np.linspace(0.05, 0.6, 8):
        frame = sensor.expose(light, float(t), Region(0, 0, COLUMNS, ROWS), np.random.default_rng(0))
        twice.append(photon_transfer.bin_pair(frame, frame, float(t)))
    result = fit_noise_data(replace(data, flats=tuple(twice)), nominal_noise(rig))
    assert result.status is FitStatus.POOR_FIT
    assert "copies of each other" in result.notes[0]


@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.5])
def test_rounding_coarser_than_the_noise(fraction: float) -> None:
    rng = np.random.default_rng(7)
    sigma, spread = 0.28, 0.08
    offset = 24 + fraction + spread * rng.standard_normal((400, 400))
    frames = [np.rint(offset + sigma * rng.standard_normal((400, 400))).astype(np.uint16) for _ in range(2)]
    pair = read_noise.dark_pair(frames[0], frames[1], 0.01)
    fit = read_noise.fit_dark(
        (pair, read_noise.DarkPair(0.02, pair.edges_DN, pair.counts, 0, 400)), read_noise.Surroundings(0.06, 0.0)
    )
    assert fit.values[2] == pytest.approx(sigma, rel=0.03)
    # What the textbook's white quantisation makes of the same frames is worse than what is asked for.
    naive = 0.5 * np.var(frames[0].astype(float) - frames[1]) - 1 / 12
    if fraction == 0.0:
        assert abs(np.sqrt(max(naive, 0.0)) / sigma - 1) > 0.1


def test_hot_pixels_do_not_carry_the_prnu() -> None:
    rng = np.random.default_rng(2)
    signal = 1000 * (1 + 0.005 * rng.standard_normal((200, 300)))
    clean = nonuniformity.prnu(signal, np.zeros_like(signal))
    signal[rng.random(signal.shape) < 1e-3] *= 3
    hot = nonuniformity.prnu(signal, np.zeros_like(signal))
    assert clean.value == pytest.approx(0.005, rel=0.03)
    assert hot.value == pytest.approx(0.005, rel=0.03)
    assert hot.outliers > clean.outliers


def test_counts_hot_pixels_and_converter_steps() -> None:
    rng = np.random.default_rng(2)
    dark = 64 + 0.3 * rng.standard_normal((100, 100))
    dark[3, 4] = dark[50, 60] = 90.0
    assert nonuniformity.count_hot(dark) == 2
    frame = rng.integers(100, 200, (50, 50)).astype(np.uint16)
    assert converter_step(frame) == 1
    assert converter_step(frame * np.uint16(16)) == 16
