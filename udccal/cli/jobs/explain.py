"""What ``restore`` reads before it works, and the plan that it makes of it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

import numpy as np
from jaxtyping import UInt8, UInt16

from udccal.cameras.picture_files.mosaics import read_raw
from udccal.cli.jobs.apart import check_folder_apart
from udccal.cli.jobs.panel_picture import read_panel_picture
from udccal.cli.output import Output, plain
from udccal.compilation import keep_compilations
from udccal.errors import RestorationError
from udccal.io.atomic import write_atomically
from udccal.io.out_folder import check_writable, storing_in
from udccal.io.png import read_png16
from udccal.profiles.profile import Profile
from udccal.profiles.store import load_profile
from udccal.reports.tables import Table
from udccal.restoration.checks import check_frame, check_raw_file
from udccal.restoration.doubts import exposure_doubts
from udccal.restoration.planner import planned
from udccal.restoration.prepared import prepared_folder
from udccal.restoration.scene_plan import ScenePlan, Wish, read_scene_plan
from udccal.restoration.stages import StageChoice, chosen_stages, needed_by_any
from udccal.tiers import Tier

_PLAN_NAME: Final = "plan.json"


@final
@dataclass(frozen=True)
class Frames:
    """What a person gave.

    Attributes:
        images: raw mosaics, PNG or camera raw.
        profile: folder or zip file of the profile, or a rig's name.
        panel_picture: picture that the panel showed, 8-bit RGB PNG; None when it is not known.
        exposure_s: exposure of the images; None to take that of each file.
    """

    images: list[Path]
    profile: Path
    panel_picture: Path | None
    exposure_s: float | None


@final
@dataclass(frozen=True)
class Plans:
    """What a person asked of the plan.

    Attributes:
        asked: the tier, or what is asked of the one that is chosen.
        pinned: file of a plan that is followed instead; None to make one.
    """

    asked: Tier | Wish
    pinned: Path | None


@final
@dataclass(frozen=True)
class Scene:
    """Frames that fit their profile.

    Attributes:
        given: what a person gave.
        profile: the rig as measured.
        shown: what the panel showed; None when not known.
        stages: what one of the frames needs.
    """

    given: Frames
    profile: Profile
    shown: UInt8[np.ndarray, "panel_rows panel_columns 3"] | None
    stages: tuple[StageChoice, ...]

    def frame(self, image: Path) -> tuple[UInt16[np.ndarray, "rows columns"], float]:
        """Return one of the frames, and its exposure in s."""
        return _checked_frame(image, self.given.exposure_s, self.profile)

    def plan(self, plans: Plans, forecast: bool = False) -> ScenePlan:
        """Return the plan for these frames; tiers are judged by the first of them.

        Args:
            plans: what is asked of it.
            forecast: whether it says what each tier is expected to give.

        Raises:
            RestorationError: when no tier does what is asked, or a pinned plan is not one of this profile, or leaves
                out what a frame needs.
        """
        if plans.pinned is not None:
            plan = read_scene_plan(plans.pinned, self.profile)
            for choice in self.stages:
                if choice.runs and choice.stage in plan.without:
                    raise RestorationError(
                        f"Expected a plan with the stage {choice.stage}, which these frames need ({choice.why}), found "
                        f"that {plans.pinned} leaves it out. Let udccal write a plan of these frames (--explain)."
                    )
            return plan
        first = self.given.images[0]
        mosaic, exposure_s = self.frame(first)
        with naming(first):
            return planned(
                self.profile,
                mosaic,
                exposure_s,
                self.shown,
                plans.asked,
                self.stages,
                forecast,
                prepared_folder(),
            )


def explain_plan(output: Output, frames: Frames, plans: Plans, out: Path | None) -> None:
    """Print the plan of some frames, and write it under ``out`` if given; restore nothing.

    Raises:
        UdccalError: as ``restore_files``.
    """
    if out is not None:
        check_folder_apart(out)
        check_writable(out)
    keep_compilations()
    scene = read_scene(output, frames)
    with output.stage("planning"):
        plan = scene.plan(plans, forecast=True)
    output.table(_stage_table(plan))
    output.table(_tier_table(plan))
    if out is not None:
        with storing_in(out):
            out.mkdir(parents=True, exist_ok=True)
            write_atomically(out / _PLAN_NAME, json.dumps(plain(plan), indent=2).encode() + b"\n")
        output.say(f"{out / _PLAN_NAME} pins this plan: give it as --plan.")
    output.result(plan)


def read_scene(output: Output, frames: Frames) -> Scene:
    """Read and check everything that is given, so that a bad file is reported before the long work begins.

    Raises:
        ProfileError: when the profile cannot be read.
        FileFormatError: when an image or the panel's picture cannot be read.
        RestorationError: when an image does not fit the profile's rig, or its exposure is not known.
    """
    profile = load_profile(frames.profile)
    for warning in profile.warnings:
        output.say(warning)
    shown = None if frames.panel_picture is None else read_panel_picture(frames.panel_picture, profile.rig)
    needs = []
    for image in frames.images:
        mosaic, exposure_s = _checked_frame(image, frames.exposure_s, profile)
        for doubt in exposure_doubts(mosaic, exposure_s, profile):
            output.say(f"{image}: {doubt}")
        needs.append(chosen_stages(profile, mosaic, exposure_s, shown))
    return Scene(frames, profile, shown, needed_by_any(needs))


@contextmanager
def naming(image: Path) -> Iterator[None]:
    """Add the image's name to what is wrong with it."""
    try:
        yield
    except RestorationError as error:
        raise RestorationError(f"{image}: {error}") from error


def _stage_table(plan: ScenePlan) -> Table:
    rows = tuple((choice.stage.value, "runs" if choice.runs else "left out", choice.why) for choice in plan.stages)
    return Table("Stages that depend on the scene", ("stage", "", "why"), rows)


def _tier_table(plan: ScenePlan) -> Table:
    rows = tuple(
        (
            each.tier.value,
            "not known" if each.psnr_dB is None else f"{each.psnr_dB:.1f}",
            f"{each.frame_ms:.0f}",
            "chosen" if each.tier is plan.tier else "",
        )
        for each in plan.tiers
    )
    return Table(
        "Tiers, as expected of the first frame", ("tier", "PSNR in dB", "ms a frame", ""), rows, frozenset({1, 2})
    )


def _checked_frame(
    image: Path, given_s: float | None, profile: Profile
) -> tuple[UInt16[np.ndarray, "rows columns"], float]:
    """Return a frame that fits the rig, and its exposure in s: ``given_s``, else the file's own."""
    mosaic, in_file = _read_mosaic(image, profile)
    exposure = in_file if given_s is None else given_s
    if exposure is None:
        raise RestorationError(
            f"Expected the exposure of {image} in the file or from --exposure-s, found neither. Add --exposure-s."
        )
    with naming(image):
        check_frame(mosaic, exposure, profile.rig)
    return mosaic, exposure


def _read_mosaic(image: Path, profile: Profile) -> tuple[UInt16[np.ndarray, "rows columns"], float | None]:
    """Return a mosaic and the exposure in its file, if any; a raw file also says which camera took it."""
    shape = profile.rig.camera.rows, profile.rig.camera.columns
    if image.suffix.lower() == ".png":
        return read_png16(image, shape), None
    raw = read_raw(image, shape)
    with naming(image):
        check_raw_file(raw.cfa, raw.bits, raw.black_DN, profile)
    return raw.data, raw.exposure_s
