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
from udccal.numerics import in_float64
from udccal.profiles.profile import Profile
from udccal.restoration.backscatter import PanelLight, refuse_excess
from udccal.restoration.panel_mask import PanelMask, mask_mosaic

ROWS, COLUMNS = 96, 128
CFA = cfa_named("RGGB")


@pytest.fixture
def mask() -> PanelMask:
    y, x = np.mgrid[: ROWS // 2, : COLUMNS // 2]
    cells = 1000.0 * (1 + y[..., None] / ROWS) * np.array([1.0, 2.0, 3.0]) + x[..., None]
    return PanelMask(mask_mosaic(cells.astype(np.float32), CFA, ROWS, COLUMNS), CFA)


@pytest.fixture(scope="module")
def lit(profile: Profile) -> Backscatter:
    """A panel before the whole camera, whose footprints are some pixels wide."""
    term, pitch_mm = profile.backscatter.term, profile.rig.panel.pitch_mm.value
    before_panel = replace(term.geometry, pupil_mm=np.array([16 * pitch_mm, 12 * pitch_mm, -14.0]))
    return replace(term, geometry=before_panel)


@pytest.mark.medium
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
