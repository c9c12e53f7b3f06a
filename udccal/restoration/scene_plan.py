"""What is done to the frames of a scene, decided before any work: which stages run, and at which tier.

``PlanOptions`` of ``plan.py`` are another thing: how accurately a tier does its work, whatever the scene.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Final, Literal, final

from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError

from udccal.arguments import check_number
from udccal.errors import RestorationError
from udccal.profiles.profile import Profile
from udccal.restoration.prepared import checksum
from udccal.restoration.stages import Stage, StageChoice
from udccal.tiers import DEFAULT_TIER, Tier

_FORMAT: Final = "udccal-scene-plan"
_MAX_BYTES: Final = 64 * 1024


@final
@dataclass(frozen=True)
class TierForecast:
    """What a tier is expected to give.

    Attributes:
        tier: the tier.
        psnr_dB: PSNR of display-encoded values against a camera without a panel; None where it is not known.
        frame_ms: time from a raw frame to a picture of 8 bits on this computer.
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid", allow_inf_nan=False)

    tier: Tier
    psnr_dB: Annotated[float, Field(ge=-100, le=200)] | None
    frame_ms: Annotated[float, Field(ge=0, le=86400e3)]


@final
@dataclass(frozen=True)
class Wish:
    """What a person asks of a tier; with neither, it is the default one.

    Attributes:
        budget_ms: time that a frame may take.
        min_psnr_dB: PSNR that is enough.

    Raises:
        RestorationError: when one is no number from 0 to a day, or to 200 dB.
    """

    budget_ms: float | None = None
    min_psnr_dB: float | None = None

    def __post_init__(self) -> None:
        if self.budget_ms is not None:
            check_number(
                self.budget_ms, "a budget in ms", (0.0, 86400e3), "Leave it out to allow any time.", RestorationError
            )
        if self.min_psnr_dB is not None:
            check_number(
                self.min_psnr_dB, "a least PSNR in dB", (0.0, 200.0), "Leave it out to accept any.", RestorationError
            )


def _each_stage(choices: tuple[StageChoice, ...]) -> tuple[StageChoice, ...]:
    if sorted(choice.stage for choice in choices) != sorted(Stage):
        raise ValueError(f"each of {', '.join(Stage)} once")
    return choices


def _no_tier_twice(tiers: tuple[TierForecast, ...]) -> tuple[TierForecast, ...]:
    if len({each.tier for each in tiers}) != len(tiers):
        raise ValueError("each tier at most once")
    return tiers


@final
@dataclass(frozen=True)
class ScenePlan:
    """What is done to the frames of a scene. A file of it is this as JSON.

    Attributes:
        format, version: of the file.
        profile_sha256: of the profile that it was made for (``profile_sha256``).
        tier: the tier at which frames are restored.
        stages: stages that the scene needs or does not, each once.
        tiers: what each tier is expected to give, each at most once; empty where nobody asked.
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid", allow_inf_nan=False)

    format: Literal["udccal-scene-plan"]
    version: Annotated[int, Field(ge=1, le=1)]
    profile_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    tier: Tier
    stages: Annotated[tuple[StageChoice, ...], AfterValidator(_each_stage)]
    tiers: Annotated[tuple[TierForecast, ...], AfterValidator(_no_tier_twice)] = ()

    @classmethod
    def of(
        cls, profile: Profile, tier: Tier, stages: tuple[StageChoice, ...], tiers: tuple[TierForecast, ...] = ()
    ) -> ScenePlan:
        """Return the plan of these choices for a profile."""
        return cls(_FORMAT, 1, profile_sha256(profile), tier, stages, tiers)

    @property
    def without(self) -> frozenset[Stage]:
        """Stages that do not run."""
        return frozenset(choice.stage for choice in self.stages if not choice.runs)


def profile_sha256(profile: Profile) -> str:
    """Return a checksum of all that restoration reads of a profile."""
    terms = tuple((result.term, result.status.name) for result in profile.results)
    error = profile.backscatter.diagnostic("held_out_without_noise_of_peak") or 0.0
    return checksum(profile.rig, terms, profile.wire_map, profile.backscatter_mask, error)


def chosen_tier(tiers: tuple[TierForecast, ...], wish: Wish) -> Tier:
    """Return the quickest tier that is good enough within the budget; without a least PSNR, the most accurate one.

    Without a budget either, it is the default tier.

    Args:
        tiers: from quickest to most accurate.
        wish: what is asked.

    Raises:
        RestorationError: when no tier keeps the budget, none that does is good enough, or a least PSNR is asked and no
            PSNR is known.
    """
    if wish == Wish():
        return DEFAULT_TIER
    budget = math.inf if wish.budget_ms is None else wish.budget_ms
    quick = [each for each in tiers if each.frame_ms <= budget]
    if not quick:
        least = min(tiers, key=lambda each: each.frame_ms)
        raise RestorationError(
            f"Expected a budget of at least {least.frame_ms:.3g} ms, which the fastest tier, {least.tier}, needs for a "
            f"frame on this computer, found {budget:g} ms. Give more time."
        )
    if wish.min_psnr_dB is None:
        return quick[-1].tier
    told = {each: each.psnr_dB for each in quick if each.psnr_dB is not None}
    if not told:
        raise RestorationError(
            "Expected a PSNR of each tier for a least PSNR, found that none can be told. Leave the least PSNR out."
        )
    good = [each for each, psnr_dB in told.items() if psnr_dB >= wish.min_psnr_dB]
    if not good:
        best = max(told, key=lambda each: told[each])
        within, more = (" within the budget", ", or give more time") if math.isfinite(budget) else ("", "")
        raise RestorationError(
            f"Expected a PSNR that a tier reaches, found {wish.min_psnr_dB:g} dB: the best{within}, {best.tier}, is "
            f"expected to reach {told[best]:.1f} dB on this frame. Ask for less{more}."
        )
    return good[0].tier


def read_scene_plan(path: Path, profile: Profile) -> ScenePlan:
    """Read a pinned plan.

    Raises:
        RestorationError: when it cannot be read, is no plan, or is one of another profile.
    """
    try:
        with path.open("rb") as stream:
            content = stream.read(_MAX_BYTES + 1)
    except OSError as error:
        raise RestorationError(f"Expected a plan at {path}, found: {error.strerror}. Check the path.") from error
    if len(content) > _MAX_BYTES:
        raise RestorationError(
            f"Expected {path} to hold at most {_MAX_BYTES} bytes, found more. It is not a plan that udccal wrote."
        )
    try:
        plan = TypeAdapter(ScenePlan).validate_json(content, strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the whole"
        raise RestorationError(
            f"Expected {path} to be a plan that `udccal restore --explain` wrote, found a mistake in {place}: "
            f"{first['msg']}. Let udccal write it again."
        ) from error
    if plan.profile_sha256 != profile_sha256(profile):
        raise RestorationError(
            f"Expected a plan of this profile, found that {path} was made for another one. Let udccal write it again "
            "with this profile (--explain)."
        )
    return plan
