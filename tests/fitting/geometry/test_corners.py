from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import convolve1d

from tests.fitting.geometry.boards import SIZE, SPEC, draw, pose, true_corners
from udccal.arrangements import BoardSpec
from udccal.board.charuco import board_points_mm, charuco_board
from udccal.errors import FitError
from udccal.fitting.geometry.corners import BoardCorners, detect_corners, luminance
from udccal.fitting.geometry.data import flat_field

GAINS = np.array([[0.6, 1.0], [1.0, 0.7]])


@pytest.fixture(scope="module")
def view() -> tuple[np.ndarray, np.ndarray]:
    matrix, translation = pose((0.2, -0.25, 0.1), (5.0, -3.0, 330.0))
    return draw(matrix, translation), true_corners(matrix, translation)


def mosaic(picture: np.ndarray, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    gains = np.tile(GAINS, (SIZE[1] // 2, SIZE[0] // 2))
    return 3000 * picture * gains + noise * np.random.default_rng(seed).normal(size=picture.shape)


def grey_of(samples: np.ndarray) -> np.ndarray:
    return luminance(samples, np.ones_like(samples))[0]


def detected(samples: np.ndarray, noise: float = 1.0, spec: BoardSpec = SPEC) -> BoardCorners:
    return detect_corners(samples, np.full(samples.shape, noise**2), spec)


def streaked(picture: np.ndarray) -> np.ndarray:
    """A core and side orders up and down, as slits give."""
    kernel = np.zeros(31)
    kernel[15], kernel[[5, 10, 20, 25]] = 0.7, [0.05, 0.1, 0.1, 0.05]
    return convolve1d(picture, kernel, axis=0, mode="nearest")


def test_a_moved_picture_moves_the_luminance_by_as_much() -> None:
    """Also by an odd number of pixels, which exchanges the sites of the pattern."""
    y, x = np.mgrid[0:40, 0:40]
    for shift in (0, 1):
        blob = np.exp(-((x - 20 - shift) ** 2 + (y - 17) ** 2) / 18.0)
        grey = grey_of(1000 * blob * np.tile(GAINS, (20, 20)))
        assert (grey * x).sum() / grey.sum() == pytest.approx(20 + shift, abs=0.02)
        assert (grey * y).sum() / grey.sum() == pytest.approx(17, abs=0.02)


def test_an_even_picture_has_no_pattern_left() -> None:
    grey = grey_of(np.tile(GAINS, (20, 20)))
    assert np.ptp(grey) < 1e-12


def test_corners_are_found_where_they_are(view: tuple[np.ndarray, np.ndarray]) -> None:
    picture, truth = view
    found = detected(mosaic(picture, noise=12.0), 12.0)
    assert len(found.ids) >= 20
    error = found.xy - truth[found.ids]
    assert np.abs(error.mean(axis=0)).max() < 0.01
    assert np.sqrt((error**2).mean()) < 0.03
    assert found.sigma.max() < 0.3


@pytest.mark.medium
def test_corners_scatter_by_noise_as_they_say(view: tuple[np.ndarray, np.ndarray]) -> None:
    """Thirty pictures of the same board: 1 within the error of so many."""
    runs = [detected(mosaic(view[0], 40.0, seed), 40.0) for seed in range(30)]
    common = sorted(set.intersection(*(set(run.ids.tolist()) for run in runs)))
    assert len(common) >= 20
    picks = [np.searchsorted(run.ids, common) for run in runs]
    xy = np.array([run.xy[pick] for run, pick in zip(runs, picks, strict=True)])
    sigma = np.array([run.sigma[pick] for run, pick in zip(runs, picks, strict=True)])
    z2 = xy.var(axis=0, ddof=1).mean(axis=1) / (sigma**2).mean(axis=0)
    assert z2.mean() == pytest.approx(1.0, abs=0.12)
    assert sigma.mean() < 0.1


def test_a_flat_field_takes_out_what_pulls_corners(view: tuple[np.ndarray, np.ndarray]) -> None:
    """Rows that modulate by 5 % in the picture and in the flat alike; without the flat, corners are off by more."""
    picture, truth = view
    wire = 1 + 0.05 * np.sin(2 * np.pi * np.arange(SIZE[1]) / 17)[:, None] * np.ones(SIZE[0])
    seen = mosaic(picture * wire)
    response, _ = flat_field(mosaic(wire), np.ones_like(seen), np.ones(seen.shape, dtype=bool))
    error = {}
    for name, light in (("raw", seen), ("even", seen / response)):
        found = detected(light)
        error[name] = np.sqrt(((found.xy - truth[found.ids]) ** 2).mean())
    assert error["even"] < 0.7 * error["raw"]


def test_samples_that_saw_no_flat_are_left_as_they_are() -> None:
    light, told = np.full((8, 8), 100.0), np.ones((8, 8), dtype=bool)
    light[2, 2], told[4, 5] = 1.0, False
    response, relative = flat_field(light, np.ones((8, 8)), told)
    assert response[2, 2] == 1.0
    assert relative[4, 5] == 0.0
    assert np.isfinite(response).all()
    np.testing.assert_allclose(response[1::2], 1.0)


def test_streaks_along_the_rows_normal_do_not_move_corners(view: tuple[np.ndarray, np.ndarray]) -> None:
    picture, truth = view
    found = detected(mosaic(streaked(picture), noise=12.0), 12.0)
    assert len(found.ids) >= 15
    error = found.xy - truth[found.ids]
    assert np.abs(np.median(error, axis=0)).max() < 0.03
    assert np.sqrt((error**2).mean()) < 0.12


def test_a_picture_shifted_by_half_a_pixel_does_not_pass(view: tuple[np.ndarray, np.ndarray]) -> None:
    picture, truth = view
    half = (picture + np.roll(picture, 1, axis=1)) / 2
    found = detected(mosaic(half))
    assert (found.xy - truth[found.ids]).mean(axis=0)[0] == pytest.approx(0.5, abs=0.02)


def test_no_board_gives_no_corners() -> None:
    noise = np.random.default_rng(0).uniform(0, 100, SIZE[::-1])
    found = detected(noise)
    assert len(found.ids) == 0
    assert found.xy.shape == (0, 2)
    assert len(detected(np.zeros(SIZE[::-1])).ids) == 0


def test_another_dictionary_is_not_this_board(view: tuple[np.ndarray, np.ndarray]) -> None:
    other = BoardSpec(SPEC.columns, SPEC.rows, SPEC.square_mm, SPEC.marker_mm, "DICT_4X4_50")
    assert len(detected(mosaic(view[0]), spec=other).ids) == 0


def test_an_unknown_dictionary_is_refused() -> None:
    with pytest.raises(FitError, match="dictionary"):
        charuco_board(BoardSpec(7, 5, 40.0, 30.0, "imread"))


def test_corner_numbers_run_along_rows() -> None:
    points = board_points_mm(SPEC)
    np.testing.assert_allclose(points[0], [40.0, 40.0, 0.0])
    np.testing.assert_allclose(points[1], [80.0, 40.0, 0.0])
    assert len(points) == (SPEC.columns - 1) * (SPEC.rows - 1)
