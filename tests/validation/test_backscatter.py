"""The panel's light as its own term predicts it, and as a wrong one does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.profiles.conftest import fitted
from tests.scenes.backscatter import World, panel_pictures, shots_of, small_rig, world
from tests.validation.judged import failed, named
from udccal.fitting.backscatter.data import BackscatterData
from udccal.result import Diagnostic
from udccal.validation.backscatter import judge_backscatter
from udccal.validation.limits import ValidationLimits

pytestmark = pytest.mark.medium


@pytest.fixture(scope="module")
def true() -> World:
    return world(np.random.default_rng(2), small_rig())


@pytest.fixture(scope="module")
def data(true: World) -> BackscatterData:
    return shots_of(true, np.random.default_rng(3), panel_pictures(true.rig, 0, 3))


def test_the_same_panels_light_is_predicted(true: World, data: BackscatterData) -> None:
    found = judge_backscatter(data, fitted("backscatter", true.term), ValidationLimits())
    assert not failed(found)
    assert (named(found, "chi-squared").value or 9.0) < 1.3


def test_a_panel_at_90_percent_fails(true: World, data: BackscatterData) -> None:
    brighter = replace(true.term, mask=np.asarray(true.term.mask) / 0.9)
    found = judge_backscatter(data, fitted("backscatter", brighter), ValidationLimits())
    assert "panel's brightness" in failed(found)
    assert named(found, "pattern over the sensor").value == 0.0
    assert named(found, "panel's brightness").value == pytest.approx(10.0, abs=0.5)


def test_white_that_the_panel_dims_is_predicted_by_a_profile_that_knows(true: World) -> None:
    dimmed = shots_of(true, np.random.default_rng(3), panel_pictures(true.rig, 0, 3), brightness=0.7)
    unaware = fitted("backscatter", true.term)
    aware = replace(unaware, diagnostics=(*unaware.diagnostics, Diagnostic("brightness_of_white", 0.7, "1")))
    assert failed(judge_backscatter(dimmed, unaware, ValidationLimits()))
    assert not failed(judge_backscatter(dimmed, aware, ValidationLimits()))


def test_a_camera_elsewhere_on_the_panel_fails(true: World, data: BackscatterData) -> None:
    moved = replace(true.term, emitters_px=np.asarray(true.term.emitters_px) + np.array([3.0, 0.0]))
    found = judge_backscatter(data, fitted("backscatter", moved), ValidationLimits())
    assert {"panel's light, RMS, of its peak", "pattern over the sensor", "chi-squared"} <= failed(found)


@pytest.mark.parametrize("seed", range(4, 8))
def test_the_same_light_in_other_noise_has_no_pattern(true: World, seed: int) -> None:
    again = shots_of(true, np.random.default_rng(seed), panel_pictures(true.rig, seed, 3))
    found = judge_backscatter(again, fitted("backscatter", true.term), ValidationLimits())
    assert not failed(found)
    assert named(found, "pattern over the sensor").value == 0.0


def test_another_shading_leaves_a_pattern(true: World, data: BackscatterData) -> None:
    mask = np.asarray(true.term.mask)
    shaded = replace(true.term, mask=mask * (1 + 0.03 * np.linspace(-1, 1, mask.shape[2])))
    found = judge_backscatter(data, fitted("backscatter", shaded), ValidationLimits())
    assert {"pattern over the sensor"} <= failed(found) <= {"pattern over the sensor", "chi-squared"}


def test_a_session_without_white_cannot_be_judged(true: World, data: BackscatterData) -> None:
    none = replace(data, shots=data.shots.part(slice(0, 0)), shown=data.shown[:0], names=())
    assert failed(judge_backscatter(none, fitted("backscatter", true.term), ValidationLimits())) == {"captures"}


def test_pictures_that_are_all_clipped_cannot_be_judged(true: World, data: BackscatterData) -> None:
    clipped = replace(data, shots=replace(data.shots, clipped=np.ones_like(data.shots.clipped)))
    found = judge_backscatter(clipped, fitted("backscatter", true.term), ValidationLimits())
    assert failed(found) == {"captures"}
    assert "clipped" in found.checks[0].what
