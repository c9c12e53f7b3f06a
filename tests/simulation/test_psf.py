from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.simulation.toy import toy_truth
from udccal.errors import UdccalError
from udccal.rig import load_rig
from udccal.simulation.psf import captured_light, kernels, phase_averaged_kernels, spread_at
from udccal.simulation.spectrum import camera_spectrum
from udccal.simulation.truth import RigTruth, draw_truth, pixels_to_directions

MIDDLE = np.array([64.0, 48.0])


@pytest.fixture(scope="module")
def truth() -> RigTruth:
    return toy_truth()


@pytest.fixture(scope="module")
def full_truth() -> RigTruth:
    return draw_truth(load_rig("lg55-aca2040"), seed=2)


def centroid(kernel: np.ndarray) -> np.ndarray:
    rows, columns = kernel.shape[-2:]
    total = kernel.sum(axis=(-2, -1))
    x = (kernel.sum(axis=-2) @ (np.arange(columns) - columns // 2)) / total
    y = (kernel.sum(axis=-1) @ (np.arange(rows) - rows // 2)) / total
    return np.stack([x, y], axis=-1)


def test_each_colour_sums_to_one_and_is_brightest_at_the_source(truth: RigTruth):
    found = kernels(truth, np.array([[64.0, 48.0], [3.5, 90.2]]), 65, 33)
    assert found.shape == (2, 3, 65, 33)
    assert np.allclose(found.sum(axis=(2, 3)), 1.0)
    assert (found >= 0).all()
    assert (found.reshape(6, -1).argmax(axis=1) == 32 * 33 + 16).all()


def test_even_sizes_are_refused(truth: RigTruth):
    with pytest.raises(UdccalError, match="odd kernel"):
        kernels(truth, MIDDLE[None], 64, 33)


def test_every_colour_has_nine_wavelengths_or_more(truth: RigTruth):
    weights = camera_spectrum(truth).weights
    assert ((weights > 0.01 * weights.max(axis=1, keepdims=True)).sum(axis=1) >= 9).all()


def test_light_is_neither_lost_nor_made(full_truth: RigTruth):
    """In the corner of the full sensor pixels are strongly slanted in direction cosines."""
    for position in (np.array([1024.0, 768.0]), np.array([2000.0, 1500.0])):
        light = captured_light(full_truth, position, 129, 129).sum(axis=(1, 2))
        assert (light < 1.0).all()
        assert (light > 0.98).all()


def test_streak_is_vertical_with_orders_at_the_grating_angle(full_truth: RigTruth):
    position = np.array([1024.0, 768.0])
    kernel = kernels(full_truth, position[None], 61, 61)[0]
    up_down, across = kernel[:, :, 28:33].sum(axis=(1, 2)), kernel[:, 28:33].sum(axis=(1, 2))
    assert (up_down > across).all()
    streak = kernel[1, 30:, 28:33].sum(axis=1)
    spectrum = camera_spectrum(full_truth)
    green_nm = float(spectrum.weights[1] @ spectrum.wavelengths_nm)
    cosine = pixels_to_directions(full_truth.optics, position + np.array([[0.0, 0.0], [0.0, 1.0]]))[:, 1]
    order_px = green_nm * 1e-6 / full_truth.panel.pitch_mm / float(cosine[1] - cosine[0])
    assert order_px == pytest.approx(1.5, abs=0.15)
    # The envelope of slits 40 % open vanishes near order 2.5 and rises again to its side lobe near order 3.6.
    zero, lobe = round(order_px / full_truth.panel.row_open), round(3.6 * order_px)
    assert streak[zero - 1 : zero + 2].min() < 0.6 * streak[lobe - 1 : lobe + 2].max()
    assert streak[zero - 1 : zero + 2].max() < 0.1 * streak[0]


def test_dynamic_range_is_a_million_and_more(full_truth: RigTruth):
    kernel = kernels(full_truth, np.array([[1024.0, 768.0]]), 257, 129)[0]
    assert kernel.min() > 0
    assert kernel.max() / kernel.min() > 1e6


def test_streak_bends_low_in_the_field(full_truth: RigTruth):
    """Conical diffraction: orders of one column order lie on a curve where the ray is inclined."""
    bend = []
    for y in (100.0, 1500.0):
        kernel = kernels(full_truth, np.array([[1024.0, y]]), 9, 257)[0, 1]
        ridge = (kernel * (np.arange(9) - 4)[:, None]).sum(axis=0) / kernel.sum(axis=0)
        bend.append(ridge[:20].mean() + ridge[-20:].mean() - 2 * ridge[118:139].mean())
    assert abs(bend[1]) > 3 * abs(bend[0])


def test_source_offset_moves_the_image(truth: RigTruth):
    """A disc of several pixels, so that the pixels resolve it and its centroid is where the source is."""
    grid = centroid(kernels(truth, MIDDLE[None], 65, 33, source_disc_px=6.0)[0])
    moved = centroid(kernels(truth, MIDDLE[None], 65, 33, (0.4, -0.3), source_disc_px=6.0)[0])
    assert np.allclose(moved - grid, [0.4, -0.3], atol=0.03)


def test_whole_pixel_offset_shifts_the_samples(truth: RigTruth):
    shifted = captured_light(truth, MIDDLE, 65, 33, (2.0, 1.0))
    plain = captured_light(truth, MIDDLE + np.array([2.0, 1.0]), 65, 33)
    assert np.abs(shifted[:, 1:, 2:] - plain[:, :-1, :-2]).max() < 1e-3 * plain.max()


@pytest.mark.medium
def test_disc_averages_points_and_keeps_the_light(truth: RigTruth):
    spread = spread_at(truth, MIDDLE, (20.0, 36.0))

    def light(rows: int, columns: int, offset: tuple[float, float], disc_px: float) -> np.ndarray:
        return captured_light(truth, MIDDLE, rows, columns, offset, disc_px, spread=spread)

    point, disc = light(65, 33, (0.3, -0.2), 0.0), light(65, 33, (0.3, -0.2), 1.6)
    assert np.allclose(disc.sum(axis=(1, 2)), point.sum(axis=(1, 2)), rtol=2e-3)
    # Points spread evenly over the disc (Vogel's sunflower spiral).
    index = np.arange(250)
    radius, angle = 0.8 * np.sqrt((index + 0.5) / index.size), index * np.pi * (3 - np.sqrt(5))
    moves = np.stack([0.3 + radius * np.cos(angle), -0.2 + radius * np.sin(angle)], axis=-1)
    brute = np.mean([light(7, 5, (float(x), float(y)), 0.0) for x, y in moves], axis=0)

    def error(kernel: np.ndarray) -> np.ndarray:
        return np.linalg.norm(kernel[:, 29:36, 14:19] - brute, axis=(1, 2)) / np.linalg.norm(brute, axis=(1, 2))

    assert (error(disc) < 0.008).all()
    assert (error(point) > 0.4).all()
    assert (error(light(65, 33, (0.3, -0.2), 1.7)) > 0.01).all()


def test_thicker_structure_changes_the_kernel(truth: RigTruth):
    panel = replace(truth.panel, depth_mm=0.15)
    thick = kernels(replace(truth, panel=panel), MIDDLE[None], 33, 17)
    plain = kernels(truth, MIDDLE[None], 33, 17)
    assert np.linalg.norm(thick - plain) > 0.01 * np.linalg.norm(plain)


def test_phase_averaging_removes_the_ripple_with_position(truth: RigTruth):
    """Along one period of the rows the plain kernel ripples; the average over half periods ripples much less."""
    period_px = truth.panel.pitch_mm / -truth.optics.pupil_mm[2] * truth.optics.fx_px
    positions = MIDDLE + np.array([[0.0, -period_px / 2], [0.0, 0.0], [0.0, period_px / 2]])

    def ripple(of: np.ndarray) -> float:
        return float(np.linalg.norm(of[1] - (of[0] + of[2]) / 2) / np.linalg.norm(of[1]))

    plain = kernels(truth, positions, 33, 17)
    assert 0.002 < ripple(plain) < 0.1
    assert ripple(phase_averaged_kernels(truth, positions, 33, 17)) < 0.5 * ripple(plain)
