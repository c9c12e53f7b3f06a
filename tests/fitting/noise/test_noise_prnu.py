"""PRNU of flats through a panel: waves with harmonics, deep ones, shading; and the spectrum's part without light."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from jaxtyping import Float

from udccal.fitting.noise.patterns import prnu, white_coefficients

ROWS, COLUMNS = 512, 768
PRNU, SHOT = 0.006, 3e-5


def panel_light(depth: float, second: float, third: float) -> Float[np.ndarray, "rows columns"]:
    """Shading times rows of a panel: slanted, bent, of slowly varying pitch and depth, with two harmonics."""
    y, x = np.mgrid[:ROWS, :COLUMNS].astype(float)
    v, u = y / ROWS - 0.5, x / ROWS - 0.75
    phase = 2 * np.pi / 50 * (y * (1 + 0.08 * v) + 0.03 * x + 20 * u * u + 5 * u * v)
    varies = 1 + 0.3 * u + 0.2 * v
    wave = depth * varies * np.cos(phase) + second * varies**2 * np.cos(2 * phase + 1) + third * np.cos(3 * phase + 2)
    return (1 - 0.4 * (u * u + v * v) - 0.1 * u) * (1 + wave)


def z_score(light: Float[np.ndarray, "rows columns"], seed: int) -> float:
    rng = np.random.default_rng(seed)
    response = 1 + PRNU * rng.standard_normal(light.shape)
    signal = 1000 * light
    noisy = signal * response + np.sqrt(SHOT * 1000 * signal) * rng.standard_normal(light.shape)
    found = prnu(noisy, 0.0, SHOT * 1000, 2, 6.0)
    return (found.variance - PRNU**2) / found.sigma


@pytest.mark.parametrize(
    ("depth", "second", "third"),
    [(0.0, 0.0, 0.0), (0.03, 1e-3, 1e-4), (0.03, 3e-3, 1e-3), (0.1, 1e-3, 1e-3), (0.3, 1e-2, 1e-3), (0.6, 0.05, 0.01)],
)
def test_waves_and_their_harmonics_move_prnu_by_less_than_its_error(depth: float, second: float, third: float) -> None:
    light = panel_light(depth, second, third)
    z = np.array([z_score(light, seed) for seed in range(6)])
    assert abs(z.mean()) < 4 / np.sqrt(len(z))
    assert np.sqrt(np.mean(z**2)) < 2.0


def test_light_of_a_wide_band_below_the_floor_is_seen() -> None:
    rng = np.random.default_rng(1)
    power = rng.standard_normal((256, 384)) ** 2
    # 25 % above the floor: no single block of 16 x 16 tells this from chance.
    power[32:96, 16:144] *= 1.25
    white = white_coefficients([power.astype(np.float32)], (1, 1))
    assert white[32:96, 16:144].mean() < 0.05
    assert 0.3 < white.mean() < 0.8


def test_white_noise_is_used_all_but_the_first_lines() -> None:
    kept = []
    for seed in range(20):
        power = np.random.default_rng(seed).standard_normal((256, 384)) ** 2
        white = white_coefficients([power.astype(np.float32)], (2, 3))
        assert not white[0].any()
        assert not white[:, 0].any()
        assert not white[:2, :3].any()
        kept.append(white.mean())
    assert np.median(kept) > 0.99


def test_a_spectrum_full_of_light_leaves_what_was_not_seen() -> None:
    power = np.random.default_rng(2).standard_normal((256, 384)) ** 2
    power[-32:-16, -32:-16] *= 30.0
    white = white_coefficients([power.astype(np.float32)], (1, 1))
    assert not white[-32:-16, -32:-16].any()
    assert white.mean() > 0.9


def test_a_picture_too_small_for_blocks_still_has_a_floor() -> None:
    power = np.ones((6, 7), np.float32)
    assert white_coefficients([power], (1, 1)).sum() == 5 * 6


def test_defects_are_named_amid_deep_waves_and_the_crests_are_none() -> None:
    rng = np.random.default_rng(4)
    light = panel_light(0.3, 0.01, 0.001)
    signal = 1000 * light * (1 + PRNU * rng.standard_normal(light.shape))
    clean = prnu(signal, 0.0, 0.0, 2, 6.0)
    assert clean.outliers < 20
    rows, columns = rng.integers(10, ROWS - 10, 30), rng.integers(10, COLUMNS - 10, 30)
    signal[rows, columns] *= 2
    hot = prnu(signal, 0.0, 0.0, 2, 6.0)
    assert hot.outliers >= clean.outliers + 25
    assert hot.variance == pytest.approx(clean.variance, abs=2 * clean.sigma)


def test_a_picture_without_light_has_no_prnu_and_no_nan() -> None:
    found = prnu(np.zeros((64, 96)), 1.0, 0.3, 2, 6.0)
    assert np.isfinite([found.variance, found.sigma]).all()
    assert found.outliers == 64 * 96


def test_blobs_too_weak_to_be_seen_are_in_the_sigma() -> None:
    """Whether a response is white cannot be told below some size: the sigma then holds what may be there."""
    rng = np.random.default_rng(5)
    shape, off = (144, 192), []
    for part in (0.0, 0.1, 0.15, 0.2, 0.25, 0.3):
        blobs = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), 1.0)
        response = 1 + PRNU * (rng.standard_normal(shape) + part * blobs / blobs.std())
        found = prnu(1000 * response, 0.0, 0.0, 1, 6.0)
        off.append(0.0 if found.structure2 else abs(found.variance - np.var(response)) / found.sigma)
    assert max(off) < 4.5
