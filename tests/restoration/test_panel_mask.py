"""Backscatter of a panel whose picture is not known: its level, before and after a picture is deblurred."""

from __future__ import annotations

import numpy as np
import pytest

from udccal.cfa import cfa_named
from udccal.models.noise import Noise
from udccal.restoration.panel_mask import PanelMask, mask_mosaic

ROWS, COLUMNS = 96, 128
CFA = cfa_named("RGGB")
CHANNELS = CFA.channel_map(ROWS, COLUMNS)


@pytest.fixture
def mask() -> PanelMask:
    y, x = np.mgrid[: ROWS // 2, : COLUMNS // 2]
    cells = 1000.0 * (1 + y[..., None] / ROWS) * np.array([1.0, 2.0, 3.0]) + x[..., None]
    return PanelMask(mask_mosaic(cells.astype(np.float32), CFA, ROWS, COLUMNS), CFA)


def test_each_sample_gets_its_own_colour(mask: PanelMask) -> None:
    np.testing.assert_allclose(mask.white[:2, :2], [[1000, 2000], [2000, 3000]])
    assert mask_mosaic(np.ones((4, 4, 3), np.float32), cfa_named("GBRG"), 9, 9).shape == (9, 9)


def levels_of(mask: PanelMask, mean_e: np.ndarray, exposure_s: float, noise: Noise, noisy: bool = True) -> np.ndarray:
    """What a frame of this light gives, with noise or without."""
    rng = np.random.default_rng(8)
    sigma = np.sqrt(np.maximum(mean_e, 0) + 25.0) if noisy else 0.0
    return mask.levels((mean_e + sigma * rng.standard_normal(mean_e.shape)).astype(np.float32), exposure_s, noise)


@pytest.mark.parametrize(
    "dark", [(slice(32, 64), slice(32, 80)), (slice(40, 48), slice(48, 64))], ids=["wide", "two blocks"]
)
def test_the_level_is_what_dark_places_allow(mask: PanelMask, toy_noise: Noise, dark: tuple[slice, slice]) -> None:
    scene = np.random.default_rng(0).uniform(500, 5000, (ROWS, COLUMNS)).astype(np.float32)
    scene[dark] = 0.0
    levels = np.array([0.3, 0.5, 0.2], np.float32)
    found = levels_of(mask, scene + mask.white * levels[CHANNELS], 1.0, toy_noise)
    # Of two dark blocks, nobody knows how much of its light is noise: 3.5 sigma of it are given to the panel.
    sigma = np.sqrt(1000 * levels + 25) / np.sqrt(16) / 1000
    assert (found - levels < 5.5 * sigma).all()
    assert (found - levels > -2.0 * sigma).all()
    np.testing.assert_allclose(mask.rate(found), mask.white * found[CHANNELS])


def test_a_few_dark_blocks_of_many_give_the_level(toy_noise: Noise) -> None:
    """Of 40 000 blocks eight are dark: a percentile of all of them would not see these."""
    white = np.full((1600, 1600), 1000.0, np.float32)
    scene = np.full(white.shape, 2000.0)
    scene[800:816, 400:432] = 0.0
    frame = scene + 0.3 * white
    found = levels_of(PanelMask(white, CFA), frame, 1.0, toy_noise)
    np.testing.assert_allclose(found, 0.3, rtol=0.2)
    assert np.percentile(frame.reshape(200, 8, 200, 8).mean(axis=(1, 3)), 0.1) > 2 * 0.3 * 1000


def test_noise_makes_no_panel_darker_than_it_is(mask: PanelMask, toy_noise: Noise) -> None:
    """Ten thousand blocks of a panel alone, at little light: the darkest of them are dark by noise."""
    white = np.full((800, 800), 100.0, np.float32)
    found = levels_of(PanelMask(white, CFA), 0.5 * white, 1.0, toy_noise)
    np.testing.assert_allclose(found, 0.5, rtol=0.05)
    # Taken as they are, the darkest blocks are not half as bright.
    frame = 50.0 + np.sqrt(75.0) * np.random.default_rng(8).standard_normal(white.shape)
    assert np.percentile(frame[::2, ::2].reshape(100, 4, 100, 4).mean(axis=(1, 3)), 0.1) < 0.9 * 50.0


def test_a_dark_panel_takes_nothing_and_a_bright_scene_at_most_the_mask(mask: PanelMask, toy_noise: Noise) -> None:
    dark = np.zeros((ROWS, COLUMNS), np.float32)
    assert not levels_of(mask, dark - 30.0, 1.0, toy_noise, noisy=False).any()
    assert (levels_of(mask, dark + 1e6, 1.0, toy_noise) == 1).all()
    assert not levels_of(PanelMask(dark, CFA), dark + 1e3, 1.0, toy_noise).any()


@pytest.mark.parametrize("name", ["mono", "RGGB"])
def test_frames_smaller_than_a_block_have_a_level(name: str, toy_noise: Noise) -> None:
    cfa = cfa_named(name)
    white = np.full((6, 4), 1e8, np.float32)
    found = levels_of(PanelMask(white, cfa), 0.25 * white, 1.0, toy_noise)
    np.testing.assert_allclose(found, [0, 0.25, 0] if name == "mono" else 0.25, rtol=1e-3)


def white_picture(mask: PanelMask) -> np.ndarray:
    """The mask of the fixture in three colours."""
    return (
        np.stack([mask.white[::2, ::2], mask.white[1::2, ::2], mask.white[1::2, 1::2]], axis=-1)
        .repeat(2, 0)
        .repeat(2, 1)
    )


def test_what_was_too_much_is_put_back_once_dark_places_are_deblurred(mask: PanelMask, toy_noise: Noise) -> None:
    """Light that diffraction had spread into a dark place was taken for the panel's."""
    levels, exposure_s, first = np.array([0.3, 0.5, 0.2], np.float32), 2.0, 16
    scene = np.random.default_rng(0).uniform(500, 5000, (ROWS - first, COLUMNS, 3)).astype(np.float32)
    scene[16:48, 32:80] = 0.0
    white = exposure_s * white_picture(mask)[first:]
    too_much = np.array([0.2, 0.0, 0.1], np.float32)
    found = mask.put_back(scene - too_much * white, levels + too_much, first, exposure_s, toy_noise)
    # Of dark blocks, 3.5 sigma of their noise are left to the panel.
    assert (found <= scene + 1.0).all()
    for channel in (0, 2):
        assert (
            scene[..., channel].mean() - found[..., channel].mean()
            < 0.25 * too_much[channel] * white[..., channel].mean()
        )
    # At the place of other rows, the panel would be as bright as there.
    other = mask.put_back(scene - too_much * white, levels + too_much, 0, exposure_s, toy_noise)
    assert not np.allclose(other, found, rtol=1e-3)


def test_a_picture_without_places_darker_than_before_stays_itself(mask: PanelMask, toy_noise: Noise) -> None:
    scene = np.full((ROWS, COLUMNS, 3), 50.0, np.float32)
    assert mask.put_back(scene, np.array([0.3, 0.5, 0.2], np.float32), 0, 1.0, toy_noise) is scene
    nothing = np.zeros(3, np.float32)
    assert mask.put_back(scene - 1e4, nothing, 0, 1.0, toy_noise).min() < -9e3
