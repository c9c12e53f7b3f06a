"""Pinned plans of a scene."""

from __future__ import annotations

import functools
from pathlib import Path

from pydantic import TypeAdapter

from tests.fuzz.profile_targets import _profile
from tests.fuzz.target import Target, of_file
from udccal.profiles.profile import Profile
from udccal.restoration.scene_plan import ScenePlan, StageChoice, TierForecast, read_scene_plan
from udccal.restoration.stages import Stage
from udccal.tiers import Tier


@functools.cache
def _made() -> Profile:
    return _profile()


def _plan() -> bytes:
    choices = tuple(StageChoice(stage, True, "needed") for stage in Stage)
    tiers = tuple(TierForecast(tier, 30.0, 2.5) for tier in Tier)
    return TypeAdapter(ScenePlan).dump_json(ScenePlan.of(_made(), Tier.balanced, choices, tiers))


def _read(path: Path) -> None:
    assert read_scene_plan(path, _made()).tier in Tier


PLAN_TARGETS = (Target("plan", of_file("plan.json", _read), lambda: (_plan(),), 4096),)
