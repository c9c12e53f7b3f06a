from __future__ import annotations

import numpy as np
import pytest

from udccal.cfa import cfa_named
from udccal.errors import RestorationError
from udccal.restoration.backscatter import estimated_rate, mask_mosaic, refuse_excess

ROWS, COLUMNS = 96, 128
CHANNELS = cfa_named("RGGB").channel_map(ROWS, COLUMNS)


@pytest.fixture
def mask() -> np.ndarray:
    y, x = np.mgrid[: ROWS // 2, : COLUMNS // 2]
    cells = 1000.0 * (1 + y[..., None] / ROWS) * np.array([1.0, 2.0, 3.0]) + x[..., None]
    return mask_mosaic(cells.astype(np.float32), "RGGB", ROWS, COLUMNS)


def test_each_sample_gets_its_own_colour(mask: np.ndarray) -> None:
    np.testing.assert_allclose(mask[:2, :2], [[1000, 2000], [2000, 3000]])
    assert mask_mosaic(np.ones((4, 4, 3), np.float32), "GBRG", 9, 9).shape == (9, 9)


def test_the_level_is_what_dark_places_allow(mask: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    scene = rng.uniform(500, 5000, mask.shape).astype(np.float32)
    scene[32:64, 32:80] = 0.0
    levels = np.array([0.3, 0.5, 0.2], np.float32)[CHANNELS]
    found = estimated_rate(scene + mask * levels, mask, "RGGB")
    np.testing.assert_allclose(found, mask * levels, rtol=0.05)


def test_a_dark_panel_takes_nothing_and_a_bright_scene_at_most_the_mask(mask: np.ndarray) -> None:
    dark = np.zeros(mask.shape, np.float32)
    assert not estimated_rate(dark - 3.0, mask, "RGGB").any()
    assert (estimated_rate(dark + 1e6, mask, "RGGB") <= mask).all()
    assert not estimated_rate(dark + 1e3, dark, "RGGB").any()


def test_a_frame_is_no_darker_than_the_panels_light(mask: np.ndarray) -> None:
    none, frame = np.zeros(mask.shape, bool), 0.02 * mask
    refuse_excess(frame, frame, none)  # a dark room
    refuse_excess(-frame, 0 * frame, none)  # a black panel, and noise
    refuse_excess(frame, 1.1 * frame, none)  # a panel that has aged
    refuse_excess(0 * frame, frame, ~none)  # clipped samples say nothing
    with pytest.raises(RestorationError, match=r"8 ms are 0\.008"):
        refuse_excess(frame, 1000 * frame, none)
