from __future__ import annotations

import numpy as np
import pytest

from udccal.cfa import channel_map, offset_pattern, site_map


def test_maps_follow_the_top_left_cell() -> None:
    np.testing.assert_array_equal(channel_map("GBRG", 3, 5), [[1, 2, 1, 2, 1], [0, 1, 0, 1, 0], [1, 2, 1, 2, 1]])
    np.testing.assert_array_equal(site_map(3, 3), [[0, 1, 0], [2, 3, 2], [0, 1, 0]])


@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_offset_pattern_is_the_pattern_of_the_cropped_mosaic(cfa: str) -> None:
    whole = channel_map(cfa, 6, 6)
    for y in range(3):
        for x in range(3):
            np.testing.assert_array_equal(channel_map(offset_pattern(cfa, x, y), 3, 3), whole[y : y + 3, x : x + 3])


@pytest.mark.parametrize("bad", ["RGG", "RGBX", ""])
def test_other_words_are_refused(bad: str) -> None:
    with pytest.raises(ValueError, match="four letters"):
        channel_map(bad, 2, 2)
