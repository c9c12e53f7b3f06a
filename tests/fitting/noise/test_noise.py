"""The noise fit against the simulated sensor of two cameras that share no number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from udccal.cameras.protocol import Region
from udccal.fitting.engine.orders import Quantity
from udccal.fitting.noise import codes, frame_moments
from udccal.fitting.noise.data import Averaged, Codes, NoiseRules
from udccal.fitting.noise.fit import fit_moments, nominal_noise
from udccal.fitting.noise.line_noise import LineNoise
from udccal.fitting.noise.moments import NoiseMoments
from udccal.fitting.noise.patterns import dsnu, prnu
from udccal.models.noise import Noise
from udccal.result import FitResult, FitStatus
from udccal.rig import RigDescription, load_rig
from udccal.simulation.sensor import Sensor
from udccal.simulation.truth import draw_truth

ROWS, COLUMNS = 240, 320
STACK = 12
RULES = NoiseRules()


def reduce_pair(first: Codes, second: Codes, exposure_s: float) -> frame_moments.Moments:
    return frame_moments.reduce_frames([first, second], exposure_s, None, 2, RULES)[1]


def toy(name: str, seed: int) -> tuple[RigDescription, Sensor]:
    rig = load_rig(name)
    rig = rig.model_copy(update={"camera": rig.camera.model_copy(update={"rows": ROWS, "columns": COLUMNS})})
    return rig, Sensor(draw_truth(rig, seed))


def reduced(sensor: Sensor, levels: np.ndarray, seed: int, stack_level: float | None = None) -> NoiseMoments:
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
        flats.append(reduce_pair(pair[0], pair[1], float(t)))
    top = 2**sensor.truth.bits - 1
    for t in (0.0005, 0.002, 0.01, 0.02, 0.25, 1.0):
        pair = [sensor.expose(none, t, region, rng) for _ in range(2)]
        darks.append(codes.dark_pair(pair[0], pair[1], t, 1, top))
        rows.append(reduce_pair(pair[0], pair[1], t))
    middle = 0.02 * float(levels[len(levels) // 2] if stack_level is None else stack_level)
    return NoiseMoments(
        darks=tuple(darks),
        dark_moments=tuple(rows),
        flats=tuple(flats),
        flat_stack=average(sensor, light, middle, region, rng),
        dark_stack=average(sensor, none, middle, region, rng),
        q_DN=1,
        top_DN=float(top),
    )


def average(sensor: Sensor, light: np.ndarray, exposure_s: float, region: Region, rng: np.random.Generator) -> Averaged:
    frames = [sensor.expose(light, exposure_s, region, rng) for _ in range(STACK)]
    return Averaged(exposure_s, np.mean(frames, axis=0).astype(np.float32), STACK)


@pytest.fixture(scope="module", params=["lg55-aca2040", "mk31-imx1600"])
def fitted(request: pytest.FixtureRequest) -> tuple[Sensor, FitResult[Noise]]:
    rig, sensor = toy(request.param, seed=3)
    return sensor, fit_moments(reduced(sensor, np.linspace(0.02, 1.6, 14), 5), nominal_noise(rig))


def test_recovers_what_the_rig_needs(fitted: tuple[Sensor, FitResult[Noise]]) -> None:
    sensor, result = fitted
    truth, term = sensor.truth, result.or_raise().term
    assert term.K_DN_per_e == pytest.approx(truth.K_DN_per_e, rel=0.01)
    assert term.sigma_d_e == pytest.approx(sensor.sigma_d_e, rel=0.03)
    assert pytest.approx(truth.PRNU1288, rel=0.05) == term.PRNU1288
    assert term.saturation_DN == pytest.approx(sensor.saturation_DN, abs=0.5)
    assert term.sigma_row_DN == pytest.approx(truth.sigma_row_DN, rel=0.15)


def test_errors_are_as_large_as_claimed(fitted: tuple[Sensor, FitResult[Noise]]) -> None:
    sensor, result = fitted
    truth = sensor.truth
    expected = {
        "K_DN_per_e": truth.K_DN_per_e,
        "black_DN": truth.black_DN,
        "saturation_DN": sensor.saturation_DN,
        "sigma_d_e": sensor.sigma_d_e,
        "lambda_read": truth.lambda_read,
        "sigma_row_DN": truth.sigma_row_DN,
        "dark_current_e_per_s": truth.dark_current_e_per_s,
        "DSNU1288_e": truth.DSNU1288_e,
        "PRNU1288": truth.PRNU1288,
    }
    z = {name: (result.estimate(name).value - value) / result.estimate(name).sigma for name, value in expected.items()}
    assert max(abs(v) for v in z.values()) < 4.5, z
    assert 0.5 < result.chi2_dof < 2.0


def test_every_term_of_the_sensor_is_found_and_no_other(fitted: tuple[Sensor, FitResult[Noise]]) -> None:
    chosen = {candidate.name for candidate in fitted[1].candidates if candidate.chosen}
    assert {"with row noise", "with dark current", "with DSNU", "with PRNU"} <= chosen
    # The lamp flickers, the sensor is straight.
    assert "response: linear, unsteady light" in chosen


def test_hot_pixels_are_listed(fitted: tuple[Sensor, FitResult[Noise]]) -> None:
    assert any("hot" in outliers.rule for outliers in fitted[1].outliers)


def test_no_light_is_too_dark() -> None:
    rig, sensor = toy("lg55-aca2040", 1)
    result = fit_moments(reduced(sensor, np.full(6, 1e-5), 1), nominal_noise(rig))
    assert result.status is FitStatus.TOO_DARK
    assert result.term.K_DN_per_e == rig.camera.K_DN_per_e.value


def test_clipped_flats_are_saturated() -> None:
    rig, sensor = toy("lg55-aca2040", 1)
    result = fit_moments(reduced(sensor, np.linspace(3.0, 4.0, 6), 1), nominal_noise(rig))
    assert result.status is FitStatus.SATURATED


def test_a_clipped_stack_is_saturated() -> None:
    rig, sensor = toy("lg55-aca2040", 1)
    result = fit_moments(reduced(sensor, np.linspace(0.05, 1.6, 10), 1, stack_level=3.0), nominal_noise(rig))
    assert result.status is FitStatus.SATURATED
    assert "flat stack" in result.notes[0]


def test_two_levels_are_too_few() -> None:
    rig, sensor = toy("lg55-aca2040", 1)
    result = fit_moments(reduced(sensor, np.array([0.2, 0.4]), 1), nominal_noise(rig))
    assert result.status is FitStatus.TOO_FEW_DATA


@pytest.mark.medium
def test_a_lamp_of_changing_pattern_is_a_poor_fit() -> None:
    rig, sensor = toy("lg55-aca2040", 1)
    data = reduced(sensor, np.linspace(0.05, 0.6, 8), 1)
    bent = tuple(replace(flat, variance_DN2=flat.variance_DN2 * (1 + flat.mean_DN / 1000)) for flat in data.flats)
    result = fit_moments(replace(data, flats=bent), nominal_noise(rig))
    assert result.status is FitStatus.POOR_FIT
    assert any("a lamp whose pattern changes" in note for note in result.notes)


def test_pairs_of_one_frame_twice_are_a_poor_fit() -> None:
    rig, sensor = toy("lg55-aca2040", 3)
    data = reduced(sensor, np.linspace(0.05, 0.6, 8), 3)
    light = np.full((ROWS, COLUMNS), sensor.truth.full_well_e / 0.02)
    twice = []
    for t in 0.02 * np.linspace(0.05, 0.6, 8):
        frame = sensor.expose(light, float(t), Region(0, 0, COLUMNS, ROWS), np.random.default_rng(0))
        twice.append(reduce_pair(frame, frame, float(t)))
    result = fit_moments(replace(data, flats=tuple(twice)), nominal_noise(rig))
    assert result.status is FitStatus.POOR_FIT
    assert "copies of each other" in result.notes[0]


@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.5])
def test_rounding_coarser_than_the_noise(fraction: float) -> None:
    rng = np.random.default_rng(7)
    sigma, spread = 0.28, 0.08
    offset = 24 + fraction + spread * rng.standard_normal((400, 400))
    frames = [np.rint(offset + sigma * rng.standard_normal((400, 400))).astype(np.uint16) for _ in range(2)]
    pair = codes.dark_pair(frames[0], frames[1], 0.01)
    fit = codes.fit_dark((pair, replace(pair, exposure_s=0.02)), 0.06, 0.0, RULES)
    assert np.sqrt(fit.values[2]) == pytest.approx(sigma, rel=0.03)
    # What the textbook's white quantisation makes of the same frames is worse than what is asked for.
    naive = 0.5 * np.var(frames[0].astype(float) - frames[1]) - 1 / 12
    if fraction == 0.0:
        assert abs(np.sqrt(max(naive, 0.0)) / sigma - 1) > 0.1


def test_codes_cut_off_at_zero_are_censored() -> None:
    rng = np.random.default_rng(8)
    black, sigma = 0.3, 2.0
    frames = [np.clip(np.rint(black + sigma * rng.standard_normal((300, 400))), 0, None) for _ in range(4)]
    pairs = tuple(
        codes.dark_pair(frames[i].astype(np.uint16), frames[i + 1].astype(np.uint16), 0.01 * (i + 1)) for i in (0, 2)
    )
    assert pairs[0].edges_DN[0] == -np.inf
    fit = codes.fit_dark(pairs, 0.3, 0.0, RULES, normal=True)
    assert fit.values[0] == pytest.approx(black, abs=0.05)
    assert np.sqrt(fit.values[2]) == pytest.approx(sigma, rel=0.02)
    # Moments of the cut-off codes are far away.
    assert frames[0].std() < 0.75 * sigma


def test_a_wide_window_of_codes_is_grouped_and_loses_nothing() -> None:
    rng = np.random.default_rng(9)
    frames = [np.rint(2000 + 200 * rng.standard_normal((200, 300))).astype(np.uint16) for _ in range(2)]
    frames[0][0, 0] = 3  # far below the window
    pair = codes.dark_pair(frames[0], frames[1], 0.01)
    assert pair.counts.shape[0] <= 161
    assert frames[0].size - 100 < pair.counts.sum() < frames[0].size
    assert np.sqrt(codes.start_values((pair,))[2]) == pytest.approx(200, rel=0.02)


def test_hot_pixels_do_not_carry_the_prnu() -> None:
    rng = np.random.default_rng(2)
    signal = 1000 * (1 + 0.005 * rng.standard_normal((200, 300)))
    clean = prnu(signal, 0.0, 0.0, 2, RULES.defect_sigma)
    signal[rng.random(signal.shape) < 1e-3] *= 3
    hot = prnu(signal, 0.0, 0.0, 2, RULES.defect_sigma)
    assert np.sqrt(clean.variance) == pytest.approx(0.005, rel=0.03)
    assert np.sqrt(hot.variance) == pytest.approx(0.005, rel=0.03)
    assert hot.outliers > clean.outliers
    assert hot.places


def test_shading_and_waves_do_not_carry_the_prnu() -> None:
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:240, :320]
    light = (1 - 0.3 * ((x / 320 - 0.5) ** 2 + (y / 240 - 0.5) ** 2)) * (1 + 0.02 * np.cos(2 * np.pi * y / 40))
    signal = 1000 * light * (1 + 0.005 * rng.standard_normal(light.shape))
    found = prnu(signal, 0.0, 0.0, 2, RULES.defect_sigma)
    assert np.sqrt(found.variance) == pytest.approx(0.005, rel=0.02)
    assert np.std(signal) / 1000 > 0.02


def test_counts_hot_pixels_and_converter_steps() -> None:
    rng = np.random.default_rng(2)
    dark = 64 + 0.3 * rng.standard_normal((100, 100))
    dark[3, 4] = dark[50, 60] = 90.0
    none = LineNoise(Quantity(0.0, 0.0, False), 99.0, False)
    assert dsnu(dark, Quantity(0.09, 0.0), none, none, 1, RULES.defect_sigma, 1, False).places == ((3, 4), (50, 60))
    frame = rng.integers(100, 200, (50, 50)).astype(np.uint16)
    counts = np.bincount(frame.ravel())
    assert codes.converter_step(counts) == 1
    assert codes.converter_step(np.bincount(16 * frame.ravel())) == 16
    assert codes.converter_step(counts, 1000) is None


def test_the_posterior_gives_the_sigma_of_any_function_of_the_term(fitted: tuple[Sensor, FitResult[Noise]]) -> None:
    result = fitted[1]
    well = result.sigma_of(lambda noise: np.array((noise.saturation_DN - noise.black_DN) / noise.K_DN_per_e))
    K, sigma = result.estimate("K_DN_per_e"), result.sigma_of(lambda noise: np.array(noise.K_DN_per_e))
    assert sigma == pytest.approx(K.sigma, rel=1e-6)
    level = result.estimate("saturation_DN").value - result.estimate("black_DN").value
    assert well > level * K.sigma / K.value**2 * (1 - 1e-6)


def test_a_flat_that_lies_off_the_curve_is_left_out_of_it() -> None:
    rig, sensor = toy("lg55-aca2040", 4)
    data = reduced(sensor, np.linspace(0.05, 1.6, 10), 4)
    flats = list(data.flats)
    flats[3] = replace(flats[3], variance_DN2=flats[3].variance_DN2 * np.where(np.arange(16) == 5, 1.5, 1.0))
    result = fit_moments(replace(data, flats=tuple(flats)), nominal_noise(rig))
    clean = fit_moments(data, nominal_noise(rig))
    assert any(one.rule.startswith("bins of flats off") and one.count == 1 for one in result.outliers)
    K = clean.estimate("K_DN_per_e")
    assert result.estimate("K_DN_per_e").value == pytest.approx(K.value, abs=0.5 * K.sigma)


@pytest.mark.parametrize(("row_DN", "offsets_DN"), [(0.05, 0.05), (0.4, 0.05), (0.4, 0.3)])
def test_mean_codes_of_rows_scatter_as_row_gain_says(row_DN: float, offsets_DN: float) -> None:
    rng = np.random.default_rng(8)
    level, read_DN, K = 10.3, 0.12, 0.05
    frames = [np.full((4, 4), 10, np.uint16)] * 2
    pair = codes.dark_pair(frames[0], frames[1], 0.01)
    values = np.array([level, 0.0, read_DN**2, offsets_DN**2, codes.NORMAL_SHAPE])
    rows = level + row_DN * rng.standard_normal((4000, 1))
    noise = np.hypot(read_DN, offsets_DN) * rng.standard_normal((4000, 2000))
    scatter = float(np.rint(rows + noise).mean(axis=1).std())
    assert codes.row_gain(pair, values, K, row_DN) * row_DN == pytest.approx(scatter, rel=0.05)
