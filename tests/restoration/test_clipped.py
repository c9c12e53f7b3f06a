"""A lamp that clips: what is missing of its samples, and the picture beside it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from tests.scenes.grid_blur import blurred
from tests.scenes.toy_restorer import EXPOSURE_S, exposed, made
from udccal.cfa import PATTERNS
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.restoration.clipped import THOROUGH, clipped_tiles, completed
from udccal.restoration.filter_tables import FilterTables, filter_tables
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.mosaic_filter import filtered
from udccal.restoration.tiles import TileLayout, layout_for
from udccal.rig import RigDescription
from udccal.tiers import Tier

CFA, SIZE, RANGE_E, NOISE_E = PATTERNS["RGGB"], 128, 8000.0, 50.0
LAMP = np.s_[62:67, 60:72]


@cache
def prepared() -> tuple[KernelGrid, TileLayout, FilterTables]:
    """A kernel with a core and a tail down the columns."""
    y, x = np.mgrid[-12:13, -3:4]
    kernel = np.exp(-(x**2) / 1.5 - y**2 / 4.0) + 0.05 * np.exp(-(x**2) / 1.5 - np.abs(y) / 5.0)
    grid = KernelGrid(np.zeros(1), np.zeros(1), np.stack([kernel / kernel.sum()] * 3)[None, None].astype(np.float32))
    layout = layout_for(SIZE, SIZE, (2, 2), (256, 256), (0, SIZE))
    return grid, layout, filter_tables(grid, layout, CFA, 1)


def scene(lamp_e: float = 2 * RANGE_E) -> np.ndarray:
    y, x = np.mgrid[:SIZE, :SIZE]
    light = np.stack([1500 + 500 * np.sin(x / 9.0 + y / 7.0)] * 3, axis=-1)
    light[LAMP] = lamp_e
    return light.astype(np.float32)


def mosaic_of(light: np.ndarray) -> np.ndarray:
    planes = np.stack([blurred(prepared()[0], channel, light[..., channel]) for channel in range(3)], axis=-1)
    own = np.take_along_axis(planes, CFA.channel_map(SIZE, SIZE)[..., None], axis=2)[..., 0]
    return (own + np.random.default_rng(3).normal(0, NOISE_E, own.shape)).astype(np.float32)


def solved(whole: np.ndarray, clipped: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The completed mosaic, and the picture without and with it."""
    _, layout, tables = prepared()
    noise = np.full((layout.count, 3), NOISE_E, np.float32)
    tiles, missing = layout.cut(whole), layout.cut(clipped.astype(np.float32)) > 0
    given = noise, tables, layout, CFA
    before, _ = filtered(tiles, *given)
    filled = np.stack(
        [
            completed(tile, own, noise[index], tables.at(index), layout, CFA, THOROUGH)
            for index, (tile, own) in enumerate(zip(tiles, missing, strict=True))
        ]
    )
    np.testing.assert_array_equal(filled[~missing], tiles[~missing])
    after, _ = filtered(filled, *given)
    back = np.empty((SIZE, SIZE), np.float32)
    for tile, (top, left) in zip(filled, ((t, a) for t in layout.tops for a in layout.lefts), strict=True):
        down, across = slice(max(top, 0), top + layout.rows), slice(max(left, 0), left + layout.columns)
        back[down, across] = tile[down.start - top :, across.start - left :][: SIZE - down.start, : SIZE - across.start]
    return back, layout.join(before), layout.join(after)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_missing_samples_come_nearer_their_light_and_so_does_the_picture_beside_the_lamp() -> None:
    light = scene()
    whole = mosaic_of(light)
    clipped = whole >= RANGE_E
    seen = np.minimum(whole, np.float32(RANGE_E))
    filled, before, after = solved(seen, clipped)
    assert np.all(filled >= seen - 1e-2)
    assert rms((filled - whole)[clipped]) < 0.9 * rms((seen - whole)[clipped])
    beside = np.ones((SIZE, SIZE), bool)
    beside[LAMP] = False
    beside[:40] = beside[88:] = False
    assert rms((after - light)[beside]) < 0.85 * rms((before - light)[beside])


def test_what_is_called_clipped_and_is_not_stays_near_its_value() -> None:
    """A mask that is wrong takes the samples' word as the least: the noise of the expectation is all that is added."""
    whole = mosaic_of(scene(1500.0))
    wrong = np.zeros((SIZE, SIZE), bool)
    wrong[50:54, 50:54] = True
    filled, _, _ = solved(whole, wrong)
    assert (filled - whole)[wrong].min() > -1e-2
    assert (filled - whole)[wrong].max() < 6 * NOISE_E


def test_a_tile_without_any_sound_sample_stays_finite_and_no_darker() -> None:
    seen = np.full((SIZE, SIZE), RANGE_E, np.float32)
    filled, _, after = solved(seen, np.ones((SIZE, SIZE), bool))
    np.testing.assert_allclose(filled, RANGE_E, rtol=1e-3)
    assert np.isfinite(after).all()


@pytest.mark.parametrize("unit", [1.0, 1e-20])
@pytest.mark.parametrize("place", [(64, 64), (0, 5), (3, 100)])
def test_a_single_sample_is_solved_at_once(place: tuple[int, int], unit: float) -> None:
    """One step of conjugate gradients ends there; what is left of the slope underflows when it is squared."""
    _, layout, tables = prepared()
    tile = np.float32(unit) * layout.tiles(mosaic_of(scene()))[0]
    clipped = np.zeros(tile.shape, bool)
    clipped[place] = True
    found = completed(tile, clipped, np.full(3, NOISE_E, np.float32), tables.at(0), layout, CFA, THOROUGH)
    assert np.all(np.isfinite(found))
    assert np.all(found >= tile - 1e-3 * np.abs(tile))


def test_only_tiles_with_patches_are_completed() -> None:
    layout = layout_for(512, 512, (2, 2), (128, 128), (0, 512))
    frame = np.zeros((512, 512), bool)
    frame[::128, 64] = True  # hot pixels
    assert len(clipped_tiles(frame, layout)[0]) == 0
    frame[200:204, 300:304] = True
    at, missing = clipped_tiles(frame, layout)
    assert 1 <= len(at) <= 4
    assert all(tile.sum() >= 8 for tile in missing)


@pytest.mark.parametrize(("tier", "part"), [(Tier.fast, 0.985), (Tier.balanced, 0.95)])
def test_a_restorer_completes_what_clips(
    tier: Tier,
    part: float,
    toy_rig: RigDescription,
    toy_noise: Noise,
    toy_geometry: Geometry,
    toy_grid: KernelGrid,
    toy_scene: np.ndarray,
) -> None:
    restorer, lit = made(tier, toy_rig, toy_noise, toy_geometry, toy_grid), toy_scene.copy()
    lit[40:52, 56:72] = 20_000.0
    frame = exposed(restorer, toy_grid, lit)
    light = restorer.scene_light(frame, EXPOSURE_S)
    assert restorer.sharpener is not None
    found = restorer.sharpener.apply(light.signal_e, light.variance_e2, light.clipped)
    ignored = restorer.sharpener.apply(light.signal_e, light.variance_e2, np.zeros_like(light.clipped))
    beside = np.zeros(toy_scene.shape[:2], bool)
    beside[32:60, 48:80] = True
    beside[40:52, 56:72] = False
    own, truth = beside[restorer.sharpener.rows], toy_scene[restorer.sharpener.rows]
    assert rms((found - truth)[own]) < part * rms((ignored - truth)[own])
