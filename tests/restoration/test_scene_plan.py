"""Which tier is chosen, and which files are plans."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from udccal.cli.output import plain
from udccal.errors import RestorationError
from udccal.profiles.profile import Profile
from udccal.restoration.scene_plan import ScenePlan, TierForecast, Wish, chosen_tier, read_scene_plan
from udccal.restoration.stages import Stage, StageChoice
from udccal.result import Diagnostic, FitStatus
from udccal.tiers import Tier

TIERS = (
    TierForecast(Tier.preview, 24.0, 10.0),
    TierForecast(Tier.fast, 33.0, 200.0),
    TierForecast(Tier.balanced, 35.0, 300.0),
    TierForecast(Tier.accurate, 36.0, 2000.0),
)


@pytest.mark.parametrize(
    ("wish", "tier"),
    [
        (Wish(), Tier.balanced),
        (Wish(budget_ms=300.0), Tier.balanced),
        (Wish(budget_ms=3000.0), Tier.accurate),
        (Wish(min_psnr_dB=35.5), Tier.accurate),
        (Wish(budget_ms=299.0), Tier.fast),
        (Wish(budget_ms=10.0), Tier.preview),
        (Wish(min_psnr_dB=20.0), Tier.preview),
        (Wish(min_psnr_dB=34.0), Tier.balanced),
        (Wish(budget_ms=250.0, min_psnr_dB=30.0), Tier.fast),
    ],
)
def test_a_tier_is_quick_enough_then_good_enough(wish: Wish, tier: Tier) -> None:
    assert chosen_tier(TIERS, wish) is tier


@pytest.mark.parametrize(
    ("wish", "message"),
    [
        (Wish(budget_ms=9.0), "at least 10 ms, which the fastest tier, preview, needs .* found 9 ms"),
        (
            Wish(min_psnr_dB=36.1),
            "found 36.1 dB: the best, accurate, is expected to reach 36.0 dB .* Ask for less.$",
        ),
        (Wish(budget_ms=250.0, min_psnr_dB=34.0), "the best within the budget, fast, is expected to reach 33.0 dB"),
    ],
)
def test_what_no_tier_does_is_refused(wish: Wish, message: str) -> None:
    with pytest.raises(RestorationError, match=message):
        chosen_tier(TIERS, wish)


def test_a_least_psnr_is_refused_where_none_is_known() -> None:
    with pytest.raises(RestorationError, match="found that none can be told"):
        chosen_tier(tuple(replace(each, psnr_dB=None) for each in TIERS), Wish(min_psnr_dB=1.0))


@pytest.fixture
def plan(profile: Profile) -> ScenePlan:
    stages = (StageChoice(Stage.wire, True, "why not"), StageChoice(Stage.backscatter, False, "the panel is black"))
    return ScenePlan.of(profile, Tier.fast, stages, TIERS)


def written(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def test_a_plan_is_read_as_it_was_written(plan: ScenePlan, profile: Profile, tmp_path: Path) -> None:
    found = read_scene_plan(written(tmp_path / "plan.json", plain(plan)), profile)
    assert found == plan
    assert found.without == {Stage.backscatter}


DAMAGES: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "another word": (lambda found: found | {"more": 1}, "mistake in more"),
    "a word less": (lambda found: {key: value for key, value in found.items() if key != "tier"}, "mistake in tier"),
    "another tier": (lambda found: found | {"tier": "perfect"}, "mistake in tier"),
    "a newer version": (lambda found: found | {"version": 2}, "mistake in version"),
    "a text for a truth": (lambda found: found | {"stages": [found["stages"][0] | {"runs": "yes"}]}, "stages.0.runs"),
    "another stage": (lambda found: found | {"stages": [found["stages"][0] | {"stage": "psf"}]}, "stages.0.stage"),
    "too many stages": (lambda found: found | {"stages": found["stages"] * 9}, "mistake in stages"),
    "a stage twice": (lambda found: found | {"stages": found["stages"] + found["stages"][:1]}, "in stages: .* once"),
    "a stage less": (lambda found: found | {"stages": found["stages"][1:]}, "in stages: .* wire, backscatter once"),
    "a tier twice": (lambda found: found | {"tiers": found["tiers"] + found["tiers"][:1]}, "each tier at most once"),
    "a truth for a version": (lambda found: found | {"version": True}, "mistake in version"),
    "a PSNR of nothing": (lambda found: found | {"tiers": [found["tiers"][0] | {"psnr_dB": -1e9}]}, "psnr_dB"),
    "a time below zero": (lambda found: found | {"tiers": [found["tiers"][0] | {"frame_ms": -1.0}]}, "frame_ms"),
    "no object": (lambda found: [found], "the whole"),
    "too large": (lambda found: found | {"more": "x" * 70_000}, "at most 65536 bytes"),
    "another profile": (lambda found: found | {"profile_sha256": "0" * 64}, "made for another one"),
}


@pytest.mark.parametrize(("damage", "message"), DAMAGES.values(), ids=DAMAGES)
def test_what_is_no_plan_of_this_profile_is_refused(
    plan: ScenePlan, profile: Profile, tmp_path: Path, damage: Callable[[dict[str, Any]], object], message: str
) -> None:
    path = written(tmp_path / "plan.json", damage(plain(plan)))
    with pytest.raises(RestorationError, match=message):
        read_scene_plan(path, profile)


def test_a_file_that_is_not_there_is_named(profile: Profile, tmp_path: Path) -> None:
    with pytest.raises(RestorationError, match=r"Expected a plan at .*absent\.json, found: No such file"):
        read_scene_plan(tmp_path / "absent.json", profile)


OTHERS: dict[str, Callable[[Profile], Profile]] = {
    "wire": lambda one: replace(one, wire_map=one.wire_map * np.float32(1.001)),
    "mask": lambda one: replace(one, backscatter_mask=one.backscatter_mask + np.float32(1.0)),
    "psf that is left out": lambda one: replace(one, psf=replace(one.psf, status=FitStatus.ABSENT)),
    "error of the mask": lambda one: replace(
        one,
        backscatter=replace(one.backscatter, diagnostics=(Diagnostic("held_out_without_noise_of_peak", 0.01, "1"),)),
    ),
}


@pytest.mark.parametrize("changed", OTHERS.values(), ids=OTHERS)
def test_a_profile_with_another_part_is_another_profile(
    plan: ScenePlan, profile: Profile, tmp_path: Path, changed: Callable[[Profile], Profile]
) -> None:
    path = written(tmp_path / "plan.json", plain(plan))
    with pytest.raises(RestorationError, match="made for another one"):
        read_scene_plan(path, changed(profile))
