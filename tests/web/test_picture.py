"""A raw frame as a picture: colours, size, zebra, histogram."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.web.capture import frame
from udccal.cameras.protocol import Frame, Region, Settings
from udccal.cfa import BLUE, GREEN, PATTERNS, RED, cfa_named
from udccal.rig import load_rig
from udccal.web.picture import BINS, MOST_PX, Sampling, half_size, make_picture

SAMPLING = Sampling(cfa_named("RGGB"), 64.0, 3900.0)


def frame_of(data: np.ndarray) -> Frame:
    settings = Settings(0.01, 0.0, Region(0, 0, data.shape[1], data.shape[0]))
    return Frame(data.astype(np.uint16), settings, 0.0, 0, True)


def shown(data: np.ndarray) -> np.ndarray:
    """The decoded picture, red first."""
    jpeg = np.frombuffer(make_picture(frame_of(data), SAMPLING).jpeg, np.uint8)
    return cv2.cvtColor(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB).astype(float)


def is_zebra(picture: np.ndarray) -> np.ndarray:
    return picture[..., 0] > 2.0 * picture[..., 1:].max(axis=-1) + 20.0


@pytest.mark.parametrize("name", PATTERNS)
def test_every_pattern_gives_its_colours(name: str) -> None:
    cfa = cfa_named(name)
    levels = np.array([1000, 2000, 3000], dtype=np.uint16)
    half = half_size(levels[cfa.channel_map(12, 16)], cfa)
    assert half.shape == (12 // cfa.rows, 16 // cfa.columns, 3)
    expected = [2000, 2000, 2000] if name == "mono" else levels[[BLUE, GREEN, RED]].tolist()
    assert np.all(half == expected)


@pytest.mark.parametrize("size", [(1536, 2048), (4096, 3000), (2, 2), (48, 144), (769, 1023), (3000, 4001)])
def test_a_picture_is_no_larger_than_its_half_and_than_the_most(size: tuple[int, int]) -> None:
    rows, columns = shown(np.full(size, 900)).shape[:2]
    half = size[0] // 2, size[1] // 2
    assert max(rows, columns) == min(max(half), MOST_PX)
    assert rows / columns == pytest.approx(half[0] / half[1], rel=0.01)


@pytest.mark.parametrize("size", [(768, 1024), (1536, 2048), (4096, 4096)])
def test_a_lone_clipped_sample_shows_and_a_bright_one_does_not(size: tuple[int, int]) -> None:
    data = np.full(size, 300)
    data[size[0] // 3, size[1] // 5] = 3899
    assert not is_zebra(shown(data)).any()
    data[size[0] // 3, size[1] // 5] = 3900
    down, across = np.nonzero(is_zebra(shown(data)))
    picture = shown(data).shape
    assert np.mean(down) / picture[0] == pytest.approx(1 / 3, abs=0.01)
    assert np.mean(across) / picture[1] == pytest.approx(1 / 5, abs=0.01)


def test_light_is_shown_between_black_and_clipped() -> None:
    levels = [0, 64, 200, 1000, 3000, 3899]
    pictures = [shown(np.full((64, 64), level)).mean() for level in levels]
    assert pictures[0] == pictures[1] == 0.0
    assert np.all(np.diff(pictures[1:]) > 5.0)
    assert pictures[-1] == pytest.approx(255.0, abs=2.0)


def test_the_histogram_counts_every_pixel_and_clipping_is_a_share_of_the_samples() -> None:
    data = np.full((64, 64), 64)
    data[:16] = 4000
    picture = make_picture(frame_of(data), SAMPLING)
    assert picture.histogram.shape == (3, BINS)
    assert picture.histogram[:, 0].tolist() == [24 * 32] * 3
    assert picture.histogram[:, -1].tolist() == [8 * 32] * 3
    assert picture.clipped == 0.25


def test_a_rig_clips_where_the_checks_of_frames_say_so() -> None:
    sampling = Sampling.of(load_rig("lg55-aca2040"))
    # 12 bits hold 4095; a full well of 10400 e- at 0.335 DN/e- above a black of 56 DN is less.
    assert (sampling.cfa.name, sampling.black_DN) == ("RGGB", 64.0)
    assert sampling.clipped_DN == pytest.approx(56.0 + 0.335 * 10400.0)


def test_a_frame_of_a_part_of_the_sensor_is_shown() -> None:
    assert make_picture(frame(144, 48, spot=(70.0, 20.0)), SAMPLING).clipped > 0.0
