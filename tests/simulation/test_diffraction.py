from __future__ import annotations

import numpy as np
import pytest
from scipy.special import j1

from tests.simulation.toy import toy_truth
from udccal.simulation.diffraction import PowerSpectrum, power_spectrum
from udccal.simulation.footprint import open_fraction
from udccal.simulation.panel import column_open_interval, pupil_footprint, row_open_interval
from udccal.simulation.truth import RigTruth, pixels_to_directions

LIMIT = (60.0, 120.0)


def direction_of(truth: RigTruth) -> np.ndarray:
    return pixels_to_directions(truth.optics, np.array([300.0, 400.0]))


def density(power: PowerSpectrum) -> np.ndarray:
    return np.diff(np.diff(power.cumulative, axis=0), axis=1) / (power.step_x * power.step_y)


def frequencies(power: PowerSpectrum) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = (n - 1 for n in power.cumulative.shape)
    middle_x, middle_y = np.arange(columns) + 0.5 - power.zero_x, np.arange(rows) + 0.5 - power.zero_y
    return middle_x * power.step_x, middle_y * power.step_y


def order_sum(truth: RigTruth, direction: np.ndarray, nu: np.ndarray) -> np.ndarray:
    """Power at frequencies ``nu`` (n, 2), as the square of a sum of Airy amplitudes, one for each diffraction order."""
    centre, shape = pupil_footprint(truth, direction)
    slopes, pitch = direction[:2] / direction[2], truth.panel.pitch_mm
    amplitude = np.zeros(len(nu), complex)
    orders = np.arange(-120, 121)
    factors = []
    for start, width in (column_open_interval(truth, slopes[:1]), row_open_interval(truth, slopes[1:])):
        factors.append(width * np.sinc(orders * width) * np.exp(-2j * np.pi * orders * (start + width / 2)))
    for m, weight in zip(orders, factors[0], strict=True):
        kx, ky = np.meshgrid(nu[:, 0] - m / pitch, orders / pitch, indexing="ij")
        ky = nu[:, 1:] - ky
        radius = np.hypot(shape[0, 0] * kx + shape[1, 0] * ky, shape[0, 1] * kx + shape[1, 1] * ky) + 1e-12
        airy = np.abs(np.linalg.det(shape)) * j1(2 * np.pi * radius) / radius
        amplitude += weight * (airy * np.exp(-2j * np.pi * (kx * centre[0] + ky * centre[1])) @ factors[1])
    return np.abs(amplitude) ** 2


def test_power_equals_the_sum_over_diffraction_orders():
    truth = toy_truth()
    direction = direction_of(truth)
    power = power_spectrum(truth, direction, LIMIT)
    nu_x, nu_y = frequencies(power)
    rng = np.random.default_rng(1)
    order = 1 / truth.panel.pitch_mm
    orders = np.stack([rng.integers(-2, 3, 25), rng.integers(0, 40, 25)], axis=-1)
    near_orders = orders * order + rng.normal(0, 0.1, (25, 2))
    column = np.abs(nu_x - near_orders[:, :1]).argmin(axis=1)
    row = np.abs(nu_y - np.abs(near_orders[:, 1:])).argmin(axis=1)
    expected = order_sum(truth, direction, np.stack([nu_x[column], nu_y[row]], axis=-1)) / power.open_area_mm2
    found = density(power)[row, column]
    assert np.abs(found - expected).max() < 1e-3 * expected.max()
    strong = expected > 1e-4 * power.open_area_mm2
    assert np.abs(found / expected - 1)[strong].max() < 0.05


def test_total_power_is_the_open_area():
    truth = toy_truth()
    direction = direction_of(truth)
    power = power_spectrum(truth, direction, (150.0, 300.0))
    both_halves = 2 * power.cumulative[-1, -1] - 2 * power.cumulative[4, -1] - np.diff(power.cumulative[4:6, -1])[0]
    assert both_halves == pytest.approx(1.0, abs=0.01)
    _, shape = pupil_footprint(truth, direction)
    area = np.pi * np.abs(np.linalg.det(shape))
    # The wire map's beam is a little narrower at the panel, so that the two fractions agree to their ripple only.
    assert power.open_area_mm2 / area == pytest.approx(float(open_fraction(truth, direction[None])[0]), rel=0.03)
    centred = power_spectrum(truth, direction, (150.0, 300.0), ((0.0, 0.0), (0.5, 0.5)))
    fraction = (truth.panel.row_open - 0.03) * (truth.panel.column_open - 0.03)
    assert centred.open_area_mm2 / area == pytest.approx(fraction, rel=0.08)


def test_moving_the_mask_by_a_period_changes_nothing_and_by_half_does():
    truth = toy_truth()
    direction = direction_of(truth)
    shifts = ((0.0, 0.0), (1.0, 1.0), (0.5, 0.5))
    plain, moved, half = (density(power_spectrum(truth, direction, LIMIT, (shift,))) for shift in shifts)
    assert np.abs(moved - plain).max() < 1e-5 * plain.max()
    assert np.abs(half - plain).max() > 1e-3 * plain.max()
