from __future__ import annotations

import numpy as np
import pytest

from udccal.cfa import PATTERNS
from udccal.errors import RestorationError
from udccal.restoration.tiles import layout_for


@pytest.mark.parametrize("name", ["RGGB", "BGGR", "mono"])
@pytest.mark.parametrize(
    ("frame", "size", "rows"),
    [((300, 410), (128, 160), (0, 300)), ((301, 411), (96, 96), (77, 250)), ((40, 30), (128, 128), (-5, 60))],
)
def test_what_is_cut_and_joined_is_the_frame(
    name: str, frame: tuple[int, int], size: tuple[int, int], rows: tuple[int, int]
) -> None:
    cfa = PATTERNS[name]
    layout = layout_for(*frame, (cfa.rows, cfa.columns), size, rows)
    mosaic = np.random.default_rng(0).random(frame, dtype=np.float32)
    joined = layout.join(layout.cut(mosaic[layout.reach])[..., None] * np.array([1, 2, 3], np.float32))
    covered = mosaic[max(rows[0], 0) : rows[1], :, None]
    np.testing.assert_allclose(joined, covered * np.array([1, 2, 3]), atol=2e-6)


def test_tiles_are_no_larger_than_what_they_cover_asks_for() -> None:
    layout = layout_for(1536, 2048, (2, 2), (256, 256), (300, 1240))
    assert (layout.rows, layout.columns, layout.count) == (240, 250, 50)
    small = layout_for(1536, 2048, (2, 2), (256, 256), (0, 200))
    assert small.rows < 256
    assert layout_for(1536, 2048, (2, 2), (241, 241), (0, 300)).columns == 242


def test_tiles_too_small_to_be_blended_are_refused() -> None:
    with pytest.raises(RestorationError, match="at least 96 x 96 px, found 128 x 64"):
        layout_for(300, 300, (2, 2), (64, 128), (0, 300))


def test_every_tile_begins_with_the_same_colour_inside_and_outside_the_frame() -> None:
    cfa = PATTERNS["GRBG"]
    channels = cfa.channel_map(100, 131).astype(np.float32)
    layout = layout_for(100, 131, (2, 2), (96, 96), (0, 100))
    tiles = layout.cut(channels)
    # The last column of an odd frame is half a cell, which a mirrored cell cannot begin with.
    whole = np.array(layout.lefts)[None, :].repeat(len(layout.tops), axis=0).ravel() + layout.columns <= 130
    assert whole.any()
    for tile in tiles[whole]:
        np.testing.assert_array_equal(tile, cfa.channel_map(layout.rows, layout.columns))


def test_tiles_whose_values_differ_are_blended_without_a_step() -> None:
    layout = layout_for(200, 600, (2, 2), (128, 128), (0, 200))
    values = np.arange(layout.count, dtype=np.float32).repeat(layout.rows * layout.columns * 3)
    values = values.reshape(-1, layout.rows, layout.columns, 3)
    joined = layout.join(values)[..., 0]
    steps = np.abs(np.diff(joined[:, layout.lefts[1] :], axis=1))
    assert steps.max() < 0.15


def test_tiles_share_the_kernel_of_their_middle_within_a_fifth_of_the_frame() -> None:
    layout = layout_for(1536, 2048, (2, 2), (128, 128), (300, 1240))
    kernels = len(layout.kernel_px)
    assert layout.kernel.max() == kernels - 1
    assert kernels < layout.count / 9
    for number, place in enumerate(layout.kernel_px):
        mine = layout.centres_px[layout.kernel == number]
        np.testing.assert_allclose(mine.mean(axis=0), place, atol=2e-3)
        assert np.all(np.ptp(mine, axis=0) < 0.2 * np.array([2048, 1536]))
    # So small a frame has a kernel per tile.
    small = layout_for(300, 400, (2, 2), (128, 128), (0, 300))
    np.testing.assert_array_equal(small.kernel, np.arange(small.count))
    np.testing.assert_allclose(small.kernel_px, small.centres_px, atol=2e-3)
