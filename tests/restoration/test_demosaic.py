from __future__ import annotations

import numpy as np
import pytest

from udccal.cfa import cfa_named
from udccal.restoration.demosaic import demosaic


@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_slanted_planes_are_exact_for_every_pattern(cfa: str) -> None:
    y, x = np.mgrid[:20, :24].astype(np.float32)
    picture = np.stack([10 + 2 * x - y, -5 + 2 * x - y, 30 + 2 * x - y], axis=-1)
    mosaic = np.take_along_axis(picture, cfa_named(cfa).channel_map(20, 24)[..., None], 2)[..., 0]
    np.testing.assert_allclose(demosaic(mosaic, cfa)[4:-4, 4:-4], picture[4:-4, 4:-4], atol=1e-4)


def test_negative_values_stay() -> None:
    assert demosaic(np.full((8, 8), -3.0, np.float32), "RGGB").max() == pytest.approx(-3.0)


def test_a_wrong_pattern_shows() -> None:
    picture = np.broadcast_to(np.array([1.0, 2.0, 4.0], np.float32), (12, 12, 3))
    mosaic = np.take_along_axis(picture, cfa_named("RGGB").channel_map(12, 12)[..., None], 2)[..., 0]
    np.testing.assert_allclose(demosaic(mosaic, "RGGB"), picture, atol=1e-5)
    assert np.abs(demosaic(mosaic, "GRBG") - picture).max() > 1.0
