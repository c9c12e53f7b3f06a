"""Dark places after the panel's light was subtracted with an error."""

from __future__ import annotations

import numpy as np
import pytest

from udccal.restoration.dark_places import plausible

ROWS, COLUMNS = 192, 256


def flat(*light_e: float) -> np.ndarray:
    return np.broadcast_to(np.array(light_e, dtype=np.float32), (ROWS, COLUMNS, 3)).copy()


def smooth_errors(sigma_e: float, seed: int = 4) -> np.ndarray:
    """Errors of three colours that vary over some hundred px."""
    rng, (y, x) = np.random.default_rng(seed), np.mgrid[:ROWS, :COLUMNS] / 100.0
    waves = [np.sin(x * a + y * b + c) for a, b, c in rng.uniform(1.0, 3.0, (3, 3))]
    return (np.sqrt(2) * sigma_e * np.stack(waves, axis=2)).astype(np.float32)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def colour(picture: np.ndarray) -> np.ndarray:
    return picture - picture.mean(axis=2, keepdims=True)


def error_map(sigma_e: float) -> np.ndarray:
    return np.full((ROWS, COLUMNS), sigma_e, np.float32)


@pytest.mark.parametrize("sigma_e", [0.0, 1e-6, 0.3, 300.0])
def test_what_is_far_below_zero_comes_out_as_black(sigma_e: float) -> None:
    found = plausible(flat(-0.5, -2000.0, -4.0), error_map(sigma_e))
    grey = found.mean(axis=2)
    assert np.all(np.isfinite(found))
    assert np.all(grey > -1e-3)
    assert grey.max() < max(sigma_e, 1e-3)


def test_a_picture_far_brighter_than_the_error_is_returned_itself() -> None:
    picture = flat(3000.0, 1000.0, 500.0)
    assert plausible(picture, error_map(10.0)) is picture
    assert plausible(picture, error_map(0.0)) is picture


def test_colours_and_brightness_of_dark_places_come_nearer_the_truth() -> None:
    truth = flat(6.0, 5.0, 4.0)
    found = truth + smooth_errors(20.0)
    better = plausible(found, error_map(20.0))
    assert rms(colour(better - truth)) < 0.3 * rms(colour(found - truth))
    assert rms((better - truth).mean(axis=2)) < rms((found - truth).mean(axis=2))
    assert better.mean(axis=2).min() > -2.0 > -8.0 > found.mean(axis=2).min()


def test_only_the_dark_half_changes_and_detail_stays() -> None:
    rng = np.random.default_rng(5)
    truth = flat(900.0, 800.0, 700.0)
    truth[:, COLUMNS // 2 :] = 5.0
    detail = rng.normal(0.0, 1.0, truth.shape).astype(np.float32)
    change = plausible(truth + smooth_errors(5.0) + detail, error_map(5.0)) - (truth + smooth_errors(5.0) + detail)
    assert np.abs(change[:, : COLUMNS // 2 - 48]).max() < 0.5
    assert rms(change[:, COLUMNS // 2 + 48 :]) > 2.0
    assert np.abs(np.diff(change, axis=0)).max() < 2.0


def test_black_and_odd_sizes_stay_finite() -> None:
    for rows, columns in ((1, 1), (3, 17), (33, 50)):
        for level in (0.0, -1e6, 1e-30):
            picture = np.full((rows, columns, 3), level, np.float32)
            for sigma in (0.0, 1e-3, 1e4):
                assert np.isfinite(plausible(picture, np.full((rows, columns), sigma, np.float32))).all()
