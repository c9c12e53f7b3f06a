from __future__ import annotations

import inspect
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from udccal.cfa import cfa_named
from udccal.errors import RestorationError
from udccal.models.backscatter import Backscatter, backscatter_rate
from udccal.models.noise import Noise
from udccal.numerics import in_float64
from udccal.profiles.profile import Profile
from udccal.restoration.backscatter import PanelLight, PanelMask, mask_mosaic, refuse_excess

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


@pytest.fixture(scope="module")
def lit(profile: Profile) -> Backscatter:
    """A panel before the whole camera, whose footprints are some pixels wide."""
    term, pitch_mm = profile.backscatter.term, profile.rig.panel.pitch_mm.value
    before_panel = replace(term.geometry, pupil_mm=np.array([16 * pitch_mm, 12 * pitch_mm, -14.0]))
    return replace(term, geometry=before_panel)


def test_sums_over_pixels_are_the_term(profile: Profile, lit: Backscatter) -> None:
    rig = profile.rig
    picture = np.random.default_rng(5).integers(0, 256, (rig.panel.rows, rig.panel.columns, 3)).astype(np.uint8)
    expected = np.asarray(in_float64(backscatter_rate)(lit, picture))
    assert expected.max() > 100
    found = PanelLight.of(lit, rig).rate(picture)
    np.testing.assert_allclose(found, expected, atol=1e-4 * expected.max())
    # A wrong picture is told from the right one.
    assert np.abs(PanelLight.of(lit, rig).rate(picture[::-1].copy()) - expected).max() > 0.05 * expected.max()


def test_threads_with_pictures_of_their_own_may_share_it(profile: Profile, lit: Backscatter) -> None:
    panel, size = PanelLight.of(lit, profile.rig), (profile.rig.panel.rows, profile.rig.panel.columns, 3)
    pictures = [np.full(size, value, np.uint8) for value in (1, 200)]
    expected = [panel.rate(picture).copy() for picture in pictures]
    rate = inspect.unwrap(PanelLight.rate)  # quicker without the tests' own check of types

    def wrong(turn: int) -> bool:
        return not np.array_equal(rate(panel, pictures[turn % 2]), expected[turn % 2])

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            assert sum(pool.map(wrong, range(8000))) == 0
    finally:
        sys.setswitchinterval(interval)


def test_only_the_pixels_that_are_seen_count(profile: Profile, lit: Backscatter) -> None:
    rig = profile.rig
    panel = PanelLight.of(lit, rig)
    picture = np.full((rig.panel.rows, rig.panel.columns, 3), 90, np.uint8)
    seen = panel.sums.seen(picture)
    assert 0 < seen[..., 0].size < 0.5 * picture[..., 0].size
    first = panel.rate(picture)
    other = np.full_like(picture, 250)
    panel.sums.seen(other)[:] = seen
    assert panel.rate(other) is first
    panel.sums.seen(other)[-1, -1] = 250
    assert panel.rate(other) is not first


def test_any_pattern_has_the_light_of_its_colours(profile: Profile, lit: Backscatter) -> None:
    rig = profile.rig
    picture = np.random.default_rng(6).integers(0, 256, (rig.panel.rows, rig.panel.columns, 3)).astype(np.uint8)
    bayer = PanelLight.of(lit, rig)
    expected = {site.channel: bayer.rate(picture)[site.samples] for site in bayer.cfa.sites}
    for name in ("BGGR", "GRBG"):
        other = replace(bayer, cfa=cfa_named(name))
        found = other.rate(picture)
        for site in other.cfa.sites:
            # Samples of one colour are a pixel apart in two patterns; the light changes little there.
            np.testing.assert_allclose(found[site.samples], expected[site.channel], atol=0.1 * expected[1].max())


def test_a_frame_is_no_darker_than_the_panels_light(mask: PanelMask) -> None:
    none, frame = np.zeros(mask.white.shape, bool), 0.02 * mask.white
    refuse_excess(frame, frame, none)  # a dark room
    refuse_excess(-frame, 0 * frame, none)  # a black panel, and noise
    refuse_excess(frame, 1.1 * frame, none)  # a panel that has aged
    refuse_excess(0 * frame, frame, ~none)  # clipped samples say nothing
    with pytest.raises(RestorationError, match=r"8 ms are 0\.008"):
        refuse_excess(frame, 1000 * frame, none)


def test_a_panel_that_stands_still_is_summed_once(profile: Profile, lit: Backscatter) -> None:
    rig = profile.rig
    panel = PanelLight.of(lit, rig)
    picture = np.full((rig.panel.rows, rig.panel.columns, 3), 200, np.uint8)
    first = panel.rate(picture)
    assert panel.rate(picture.copy()) is first
    picture[:] = 100  # the same array, with another picture in it
    assert not np.array_equal(panel.rate(picture), first)
    np.testing.assert_array_equal(panel.rate(picture), PanelLight.of(lit, rig).rate(picture))
