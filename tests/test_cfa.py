from __future__ import annotations

import numpy as np
import pytest

from udccal.cfa import BLUE, GREEN, PATTERNS, RED, Cfa, cfa_named

# What a sensor of another pattern costs: its entry.
QUAD = Cfa("quad", ("RRGG", "RRGG", "GGBB", "GGBB"), "")


def test_maps_follow_the_top_left_cell() -> None:
    cfa = cfa_named("GBRG")
    np.testing.assert_array_equal(cfa.channel_map(3, 5), [[1, 2, 1, 2, 1], [0, 1, 0, 1, 0], [1, 2, 1, 2, 1]])
    np.testing.assert_array_equal(cfa.site_map(3, 3), [[0, 1, 0], [2, 3, 2], [0, 1, 0]])


@pytest.mark.parametrize("cfa", [*PATTERNS.values(), QUAD], ids=lambda cfa: cfa.name)
def test_sites_take_every_sample_once_and_agree_with_the_maps(cfa: Cfa) -> None:
    rows, columns = 9, 11
    channels, numbers = np.full((rows, columns), -1), np.full((rows, columns), -1)
    for number, site in enumerate(cfa.sites):
        assert np.all(channels[site.samples] == -1)
        channels[site.samples], numbers[site.samples] = site.channel, number
        assert (numbers[site.row, site.column], cfa.channels[site.row, site.column]) == (number, site.channel)
    np.testing.assert_array_equal(channels, cfa.channel_map(rows, columns))
    np.testing.assert_array_equal(numbers, cfa.site_map(rows, columns))


@pytest.mark.parametrize("cfa", [cfa_named("BGGR"), QUAD], ids=lambda cfa: cfa.name)
def test_cell_means_are_of_each_colours_own_samples(cfa: Cfa) -> None:
    mosaic = np.array([10.0, 20.0, 40.0])[cfa.channel_map(2 * cfa.rows + 1, 3 * cfa.columns)]
    means = cfa.cell_means(mosaic)
    assert means.shape == (2, 3, 3)
    np.testing.assert_array_equal(means[0, 0], [10.0, 20.0, 40.0])
    mosaic[0, 0] += cfa.channels.size * 100.0
    own = np.sum(cfa.channels == cfa.channels[0, 0])
    assert cfa.cell_means(mosaic)[0, 0, cfa.channels[0, 0]] - means[0, 0, cfa.channels[0, 0]] == pytest.approx(
        cfa.channels.size * 100.0 / own
    )


def test_a_sensor_without_colours_is_grey() -> None:
    cfa = cfa_named("mono")
    assert len(cfa.sites) == 1
    np.testing.assert_array_equal(
        cfa.cell_means(np.arange(6.0).reshape(2, 3))[..., [RED, BLUE]].T, [[[0, 3], [1, 4], [2, 5]]] * 2
    )
    assert np.all(cfa.channel_map(3, 3) == GREEN)


@pytest.mark.parametrize("bad", ["RGG", "RGBX", "", "RGBG" * 100])
def test_other_words_are_refused(bad: str) -> None:
    with pytest.raises(ValueError, match=r"one of the CFA patterns mono, RGGB, .*, found"):
        cfa_named(bad)


def test_a_sensor_without_colours_has_one_channel() -> None:
    assert PATTERNS["GBRG"].colours == (0, 1, 2)
    assert PATTERNS["mono"].colours == (1,)
