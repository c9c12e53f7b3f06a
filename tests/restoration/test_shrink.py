from __future__ import annotations

import numpy as np
import pytest

from udccal.cfa import PATTERNS
from udccal.restoration.filter_tables import FilterTables, filter_tables
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.mosaic_filter import filtered
from udccal.restoration.scene_prior import STRENGTHS
from udccal.restoration.shrink import BandNoise, measured_noise, shrunk, split
from udccal.restoration.tiles import TileLayout, layout_for

CFA = PATTERNS["RGGB"]


@pytest.fixture(scope="module")
def layout() -> TileLayout:
    return layout_for(160, 224, (2, 2), (128, 128), (0, 160))


@pytest.fixture(scope="module")
def tables(layout: TileLayout, toy_grid: KernelGrid) -> FilterTables:
    return filter_tables(toy_grid, layout, CFA, 1)


@pytest.fixture(scope="module")
def noise(layout: TileLayout, tables: FilterTables) -> BandNoise:
    return measured_noise(tables, layout, CFA, 1)


def restored(
    mosaic: np.ndarray, strength: float, layout: TileLayout, tables: FilterTables, noise: BandNoise, sigma_e: float
) -> tuple[np.ndarray, np.ndarray]:
    """A mosaic after the filter, and after its noise is taken out."""
    strengths = np.full(layout.count, strength, np.float32)
    sigma = np.full((layout.count, 3), sigma_e, np.float32)
    pictures, _ = filtered(layout.cut(mosaic), sigma, tables, layout, CFA, strengths)
    joined = layout.join(pictures)
    variance = np.full(mosaic.shape, sigma_e**2, np.float32)
    return joined, shrunk(joined, sigma, variance, noise.of_tiles(strengths), layout, 1)


def test_the_bands_sum_to_the_plane() -> None:
    plane = np.random.default_rng(0).random((37, 51), dtype=np.float32)
    bands, smooth = split(plane)
    np.testing.assert_allclose(sum(bands) + smooth, plane, atol=1e-6)


def test_noise_at_some_strengths_is_that_at_all(layout: TileLayout, tables: FilterTables, noise: BandNoise) -> None:
    some = measured_noise(tables, layout, CFA, 1, STRENGTHS[[3, 14]])
    np.testing.assert_array_equal(some.variance[:, [3, 14]], noise.variance[:, [3, 14]])
    assert some.variance[:, 4].max() == 0.0 < noise.variance[:, 4].min()


def test_noise_alone_is_taken_out(layout: TileLayout, tables: FilterTables, noise: BandNoise) -> None:
    mosaic = np.random.default_rng(1).normal(500, 20, (160, 224)).astype(np.float32)
    before, after = restored(mosaic, 256.0, layout, tables, noise, 20.0)
    inner = slice(24, -24)
    assert after[inner, inner].std() < 0.35 * before[inner, inner].std()
    assert abs(after[inner, inner].mean() - 500) < 2


def test_noise_that_is_stated_too_small_stays(layout: TileLayout, tables: FilterTables, noise: BandNoise) -> None:
    mosaic = np.random.default_rng(1).normal(500, 20, (160, 224)).astype(np.float32)
    before, after = restored(mosaic, 256.0, layout, tables, noise, 5.0)
    assert after[24:-24, 24:-24].std() > 0.8 * before[24:-24, 24:-24].std()


def test_detail_above_the_noise_stays(layout: TileLayout, tables: FilterTables, noise: BandNoise) -> None:
    y, x = np.mgrid[:160, :224].astype(np.float32)
    mosaic = 2000 + 500 * np.sign(np.sin(x / 9)) * np.sign(np.sin(y / 11)).astype(np.float32)
    before, after = restored(mosaic, 256.0, layout, tables, noise, 5.0)
    assert (after - before)[24:-24, 24:-24].std() < 0.02 * 500


def test_strengths_of_tiles_have_their_own_noise(noise: BandNoise, layout: TileLayout) -> None:
    chosen = np.resize(STRENGTHS[[2, 20]], layout.count)
    finest = noise.of_tiles(chosen)[:, 0, 0, 0]
    assert finest[1] > 10 * finest[0]
