"""Stages that a scene does without are not called, and nothing is computed for them."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import pytest

from udccal.profiles.profile import Profile
from udccal.restoration import backscatter, runtime
from udccal.restoration.plan import PlanOptions
from udccal.restoration.runtime import Restorer
from udccal.restoration.stages import Stage, StageChoice, chosen_stages, needed_by_any
from udccal.tiers import Tier

EXPOSURE_S: Final = 0.02
OPTIONS: Final = PlanOptions(grid_rows=2, grid_columns=2, tile_rows=96, tile_columns=128)


@pytest.fixture
def wavy(profile: Profile) -> Profile:
    wave = 1 + 0.02 * np.sin(np.arange(profile.rig.camera.rows) / 3)
    wire_map = np.repeat(wave[:, None], profile.rig.camera.columns, 1).astype(np.float32)
    return replace(profile, wire_map=wire_map, backscatter_mask=np.full_like(profile.backscatter_mask, 2e4))


def frame(profile: Profile, light_e: float) -> np.ndarray:
    camera = profile.rig.camera
    return np.full((camera.rows, camera.columns), round(64 + 0.355 * light_e), np.uint16)


def picture(profile: Profile, value: int) -> np.ndarray:
    return np.full((profile.rig.panel.rows, profile.rig.panel.columns, 3), value, np.uint8)


def runs(choices: tuple[StageChoice, ...]) -> set[Stage]:
    return {choice.stage for choice in choices if choice.runs}


def test_a_bright_scene_behind_a_lit_panel_needs_all(wavy: Profile) -> None:
    assert runs(chosen_stages(wavy, frame(wavy, 3000), EXPOSURE_S, picture(wavy, 200))) == set(Stage)
    assert runs(chosen_stages(wavy, frame(wavy, 3000), EXPOSURE_S, None)) == set(Stage)


def test_a_black_panel_has_no_backscatter(wavy: Profile) -> None:
    choices = chosen_stages(wavy, frame(wavy, 3000), EXPOSURE_S, picture(wavy, 0))
    assert runs(choices) == {Stage.wire}
    assert choices[1].why == "the panel is black"
    # 1 of 255 gives so little light that no sample shows it; one pixel that is white does not.
    assert Stage.backscatter not in runs(chosen_stages(wavy, frame(wavy, 3000), EXPOSURE_S, picture(wavy, 1)))
    spot = picture(wavy, 0)
    spot[5, 5] = 255
    assert Stage.backscatter in runs(chosen_stages(wavy, frame(wavy, 3000), EXPOSURE_S, spot))


def test_a_wire_below_the_noise_is_not_divided_by(wavy: Profile) -> None:
    assert Stage.wire not in runs(chosen_stages(wavy, frame(wavy, 20), EXPOSURE_S, None))
    lamp = frame(wavy, 20)
    lamp[16:32, 32:48] = 3000
    assert Stage.wire in runs(chosen_stages(wavy, lamp, EXPOSURE_S, None))


def test_a_wire_that_is_dark_in_a_few_rows_is_needed(wavy: Profile) -> None:
    """Their samples change by more than their noise, though the wire's standard deviation is small."""
    wire_map = np.ones_like(wavy.wire_map)
    wire_map[30] = 1e-4
    dim = replace(wavy, wire_map=wire_map)
    assert np.std(wire_map) * 3 < 0.1 * 5
    assert Stage.wire in runs(chosen_stages(dim, frame(dim, 3), EXPOSURE_S, None))
    assert Stage.wire not in runs(chosen_stages(dim, frame(dim, 0.5), EXPOSURE_S, None))


def test_a_profile_without_a_term_needs_no_stage_of_it(profile: Profile) -> None:
    assert Stage.wire not in runs(chosen_stages(profile, frame(profile, 3000), EXPOSURE_S, None))


def test_several_frames_need_what_one_of_them_needs(wavy: Profile) -> None:
    dark, bright = (chosen_stages(wavy, frame(wavy, light), EXPOSURE_S, picture(wavy, 0)) for light in (20, 3000))
    assert runs(needed_by_any([dark, bright, dark])) == {Stage.wire}
    assert runs(needed_by_any([dark])) == set()


@pytest.mark.parametrize("tier", list(Tier))
def test_a_stage_that_is_left_out_costs_nothing(wavy: Profile, tier: Tier, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither are its tables made, nor is it called."""
    for module, name in (
        (backscatter, "panel_response"),
        (runtime, "mask_mosaic"),
        (runtime, "PanelMask"),
        (runtime, "refuse_excess"),
    ):
        monkeypatch.setattr(module, name, lambda *_, name=name: pytest.fail(f"called {name}"))
    without = Restorer.from_profile(wavy, tier, OPTIONS, without=frozenset(Stage))
    assert without.wire is None
    assert without.mask is None
    assert without.panel is None
    restored = without.restore(frame(wavy, 2000), EXPOSURE_S, picture(wavy, 0)) * EXPOSURE_S
    np.testing.assert_allclose(restored, 2000.0, rtol=0.01)
    with pytest.raises(pytest.fail.Exception, match="called"):
        Restorer.from_profile(wavy, tier, OPTIONS)


def test_what_is_left_out_would_not_be_seen(wavy: Profile) -> None:
    """The difference is far below the noise of a sample, 5 e-."""
    dark, black = frame(wavy, 20), picture(wavy, 0)
    without = frozenset(Stage) - runs(chosen_stages(wavy, dark, EXPOSURE_S, black))
    assert without == set(Stage)
    whole, part = (
        Restorer.from_profile(wavy, Tier.fast, OPTIONS, without=stages) for stages in (frozenset[Stage](), without)
    )
    difference = whole.restore(dark, EXPOSURE_S, black) - part.restore(dark, EXPOSURE_S, black)
    assert np.abs(difference * EXPOSURE_S).max() < 0.7
