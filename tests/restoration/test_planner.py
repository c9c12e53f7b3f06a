"""Plans of a toy profile: what they compute, what they expect, what they refuse before any work."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from udccal.errors import RestorationError
from udccal.profiles.profile import Profile
from udccal.restoration import planner, runtime
from udccal.restoration.frame_time import FrameSize, PartTimes
from udccal.restoration.plan import PlanOptions
from udccal.restoration.planner import planned
from udccal.restoration.scene_plan import ScenePlan, Wish
from udccal.restoration.stages import chosen_stages
from udccal.result import FitStatus
from udccal.tiers import Tier

EXPOSURE_S = 0.02
TIMES = PartTimes(*(np.array(seconds) for seconds in (1e-8, 4e-8, 1e-7, 5e-8, 1e-6, 2e-8, 1e-8, 3e-7, 1e-7, 1e-2)))


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A computer whose times are known."""
    monkeypatch.setattr(planner, "part_times", lambda *_: TIMES)


@pytest.fixture
def frame(profile: Profile) -> np.ndarray:
    rng, camera = np.random.default_rng(2), profile.rig.camera
    light = np.full((camera.rows, camera.columns), 500.0)
    light[20:40, 30:70] = 4000.0
    return (64 + 0.355 * rng.poisson(light)).astype(np.uint16)


BLACK = np.zeros((24, 32, 3), np.uint8)


def plan_of(
    profile: Profile, frame: np.ndarray, asked: Tier | Wish, forecast: bool = False, shown: np.ndarray | None = BLACK
) -> ScenePlan:
    stages = chosen_stages(profile, frame, EXPOSURE_S, shown)
    return planned(profile, frame, EXPOSURE_S, shown, asked, stages, forecast)


def refuse(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    for name in names:
        monkeypatch.setattr(
            runtime if name == "kernel_grid" else planner, name, lambda *_, name=name: pytest.fail(f"called {name}")
        )


@pytest.mark.parametrize("asked", [Wish(), *Tier])
def test_a_plan_without_a_wish_measures_nothing(
    profile: Profile, frame: np.ndarray, asked: Tier | Wish, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse(monkeypatch, "part_times", "expected_error", "kernel_grid")
    plan = plan_of(profile, frame, asked)
    assert plan.tier is (asked if isinstance(asked, Tier) else Tier.balanced)
    assert plan.tiers == ()


@pytest.mark.usefixtures("quick")
def test_a_budget_alone_needs_no_kernels(profile: Profile, frame: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    refuse(monkeypatch, "expected_error", "kernel_grid")
    assert plan_of(profile, frame, Wish(budget_ms=1e4)).tier is Tier.accurate
    assert plan_of(profile, frame, Wish(budget_ms=5.0)).tier is Tier.balanced
    assert plan_of(profile, frame, Wish(budget_ms=0.1)).tier is Tier.preview
    with pytest.raises(RestorationError, match="the fastest tier, preview, needs"):
        plan_of(profile, frame, Wish(budget_ms=1e-6, min_psnr_dB=20.0))


@pytest.mark.usefixtures("quick")
def test_the_forecast_says_what_each_tier_gives(
    profile: Profile, frame: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = PlanOptions(grid_rows=2, grid_columns=2, tile_rows=96, tile_columns=128)
    monkeypatch.setattr(runtime, "checked_options", lambda given: small)
    plan = plan_of(profile, frame, Tier.preview, forecast=True)
    assert plan.tier is Tier.preview
    preview, fast, balanced, accurate = plan.tiers
    assert preview.frame_ms < fast.frame_ms < balanced.frame_ms < accurate.frame_ms
    assert fast.psnr_dB is not None
    assert balanced.psnr_dB is not None
    assert 25 < fast.psnr_dB < balanced.psnr_dB < 60
    # A twentieth of the light, and the noise of that.
    light = np.random.default_rng(3).poisson((frame - 64.0) / 0.355 / 20)
    darker = plan_of(profile, (64 + 0.355 * light).astype(np.uint16), Tier.preview, forecast=True)
    assert darker.tiers[1].psnr_dB is not None
    assert darker.tiers[1].psnr_dB < fast.psnr_dB - 0.5


@pytest.mark.usefixtures("quick")
def test_without_a_psf_only_times_are_expected(profile: Profile, frame: np.ndarray) -> None:
    sharp = replace(profile, psf=replace(profile.psf, status=FitStatus.ABSENT))
    plan = plan_of(sharp, frame, Wish(), forecast=True)
    assert [each.psnr_dB for each in plan.tiers] == [None] * len(Tier)
    with pytest.raises(RestorationError, match="no PSNR can be told of this profile"):
        plan_of(sharp, frame, Wish(min_psnr_dB=30.0))


@pytest.mark.usefixtures("quick")
def test_no_psnr_is_told_where_a_lit_panels_picture_is_not_known(
    profile: Profile, frame: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse(monkeypatch, "expected_error", "kernel_grid")
    lit = replace(profile, backscatter_mask=profile.backscatter_mask + np.float32(2e4))
    plan = plan_of(lit, frame, Wish(), forecast=True, shown=None)
    assert [each.psnr_dB for each in plan.tiers] == [None] * len(Tier)
    with pytest.raises(RestorationError, match="the panel's picture for a least PSNR, found that it is not known"):
        plan_of(lit, frame, Wish(min_psnr_dB=1.0), shown=None)


def test_a_frame_of_another_camera_is_refused_first(
    profile: Profile, frame: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse(monkeypatch, "part_times", "expected_error", "kernel_grid")
    stages = chosen_stages(profile, frame, EXPOSURE_S, None)
    with pytest.raises(RestorationError, match="96 x 64 samples"):
        planned(profile, frame[:-2], EXPOSURE_S, None, Wish(1e4, 30.0), stages)
    with pytest.raises(RestorationError, match="32 x 24 8-bit RGB"):
        planned(profile, frame, EXPOSURE_S, np.zeros((24, 31, 3), np.uint8), Wish(1e4, 30.0), stages)


@pytest.mark.usefixtures("quick")
@pytest.mark.medium
def test_a_frame_that_clips_is_expected_to_take_longer(profile: Profile, frame: np.ndarray) -> None:
    lamp = frame.copy()
    lamp[25:35, 40:60] = 3969
    dark, lit = (plan_of(profile, each, Tier.fast, forecast=True).tiers for each in (frame, lamp))
    assert lit[0].frame_ms == dark[0].frame_ms
    assert lit[1].frame_ms > 1.5 * dark[1].frame_ms
    assert lit[3].frame_ms - dark[3].frame_ms == pytest.approx(3 * (lit[1].frame_ms - dark[1].frame_ms))


def test_times_grow_with_pixels_and_with_what_is_done() -> None:
    small, large = FrameSize(1000, 600, 500, 1500, 0, 0), FrameSize(4000, 2400, 2000, 6000, 0, 0)
    for tier in Tier:
        assert large.ms(tier, TIMES) == pytest.approx(4 * small.ms(tier, TIMES))
    # Of a frame whose parts take a fifth longer together than alone.
    assert small.ms(Tier.fast, TIMES) == pytest.approx(1.2e3 * (1000e-8 + 500 * 2e-8 + 1500e-7))
    # Each piece that may be a lamp takes two fits, at the tier that tries them.
    with_lamps = FrameSize(1000, 600, 500, 1500, 0, 3)
    assert with_lamps.ms(Tier.accurate, TIMES) - small.ms(Tier.accurate, TIMES) == pytest.approx(1e3 * 2 * 3 * 1e-2)
    assert with_lamps.ms(Tier.balanced, TIMES) == small.ms(Tier.balanced, TIMES)
    sharp = FrameSize(1000, 600, 500, 0, 0, 0)
    assert sharp.ms(Tier.balanced, TIMES) == sharp.ms(Tier.fast, TIMES) < small.ms(Tier.fast, TIMES)
