from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from udccal.cfa import PATTERNS
from udccal.models.noise import Noise
from udccal.restoration.defects import without_defects
from udccal.restoration.linear import to_electrons

EXPOSURE_S = 0.01


def in_DN(signal_e: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(64 + 0.355 * signal_e), 0, 3969).astype(np.uint16)


def test_hot_and_dead_samples_are_replaced(toy_noise: Noise) -> None:
    frame = in_DN(np.random.default_rng(0).normal(500.0, 22.0, (64, 64)))
    broken = frame.copy()
    broken[20, 21], broken[41, 40], broken[0, 0], broken[63, 62] = 1900, 0, 1900, 0
    mended = without_defects(broken, toy_noise, EXPOSURE_S, "RGGB")
    for place in ((20, 21), (41, 40), (0, 0), (63, 62)):
        assert abs(int(mended[place]) - int(frame[place])) < 30
    assert (mended == broken).mean() > 0.999


def test_a_frame_without_defects_is_not_copied(toy_noise: Noise) -> None:
    frame = in_DN(np.random.default_rng(0).normal(500.0, 22.0, (64, 64)))
    assert without_defects(frame, toy_noise, EXPOSURE_S, "RGGB") is frame


def test_a_star_behind_the_panel_is_no_defect(toy_noise: Noise) -> None:
    """Every second sample down the middle of a panel's psf: a star one pixel wide, seen by one colour of the CFA."""
    frame = np.full((64, 64), 10.0, np.float32)
    frame[28:37, 30] += 10000 * np.array([0.02, 0.02, 0.1, 0.1, 0.38, 0.1, 0.1, 0.02, 0.02], np.float32)
    np.testing.assert_array_equal(without_defects(in_DN(frame), toy_noise, EXPOSURE_S, "RGGB"), in_DN(frame))


@pytest.mark.parametrize("name", ["RGGB", "mono"])
@pytest.mark.parametrize("sigma_d_e", [0.0, 0.7, 5.0, 40.0])
def test_eight_bits_overlook_no_defect(name: str, sigma_d_e: float, toy_noise: Noise) -> None:
    """The rule, sample by sample, on frames with samples that lie on either side of it."""
    rng, cfa, noise = np.random.default_rng(3), PATTERNS[name], replace(toy_noise, sigma_d_e=sigma_d_e)
    light = np.exp(cv2.GaussianBlur(rng.normal(4, 30, (90, 113)), (0, 0), 8)) * 30 - 60
    frame = in_DN(rng.normal(light, np.sqrt(np.maximum(light, 0) + sigma_d_e**2)))
    odd = rng.random(frame.shape) < 0.02
    far = in_DN(light + rng.normal(0, 30, frame.shape) * np.sqrt(np.maximum(light, 0) + 25))
    frame[odd] = far[odd]
    expected = frame.copy()
    for site in cfa.sites:
        plane = frame[site.samples]
        wide = np.pad(plane, 1, mode="reflect")
        stack = np.stack([wide[j : j + len(plane), i : i + plane.shape[1]] for j in range(3) for i in range(3)])
        electrons = to_electrons(stack.reshape(9, -1), noise, EXPOSURE_S).reshape(stack.shape)
        around, own = np.delete(electrons, 4, axis=0), electrons[4]
        high, low = around.max(axis=0), around.min(axis=0)
        allowed = np.maximum(8 * np.sqrt(np.maximum(high, 0) + sigma_d_e**2), 5 * (high - low))
        wrong = (own > high + allowed) | (own < low - allowed)
        expected[site.samples] = np.where(wrong, np.median(stack, axis=0), plane)
    assert 5 < np.count_nonzero(expected != frame) < 0.05 * frame.size
    for workers in (1, 2, 5):
        np.testing.assert_array_equal(without_defects(frame, noise, EXPOSURE_S, name, workers), expected)
