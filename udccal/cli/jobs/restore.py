"""Restores raw files one at a time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from udccal.cli.jobs.apart import check_folder_apart
from udccal.cli.jobs.explain import Frames, Plans, naming, read_scene
from udccal.cli.output import Output
from udccal.compilation import keep_compilations
from udccal.errors import RestorationError
from udccal.io.exr import check_path
from udccal.io.out_folder import check_writable, storing_in
from udccal.restoration.prepared import prepared_folder
from udccal.restoration.runtime import Restorer
from udccal.restoration.sinks import write_picture
from udccal.restoration.tone import Tone, display_exposure
from udccal.tiers import Tier


@dataclass(frozen=True)
class RestoredFile:
    """One restored frame."""

    source: Path
    picture: Path
    exposure_s: float


@dataclass(frozen=True)
class RestoreSummary:
    """Result of ``restore``."""

    profile: Path
    tier: Tier
    pictures: tuple[RestoredFile, ...]


def restore_files(
    output: Output, frames: Frames, plans: Plans, out: Path, picture_format: Literal["png", "exr"]
) -> None:
    """Restore every image with a profile and write it under ``out``, one by one.

    Args:
        output: shows stages and results.
        frames: what is restored, and with which profile.
        plans: what is asked of the plan.
        out: folder of the restored pictures.
        picture_format: ``png``, display-encoded, or ``exr``, linear light in e-/s.

    Raises:
        ProfileError: when the profile cannot be read, or ``out`` is in a profile.
        SessionError: when ``out`` is in a session.
        FileFormatError: when an image or the panel's picture cannot be read, or an EXR file's path is not UTF-8.
        RestorationError: when an image or a plan does not fit the profile, an exposure is not known, or no tier does
            what is asked.
        UdccalError: when ``out`` cannot be written to; this is found before any work.
    """
    check_folder_apart(out)
    check_writable(out)
    keep_compilations()
    targets = _targets(frames, out, picture_format)
    if picture_format == "exr":
        for target in targets:
            check_path(target)
    scene = read_scene(output, frames)
    plan = scene.plan(plans)
    restored: list[RestoredFile] = []
    with output.stage("restoring") as stage:
        restorer = Restorer.from_profile(scene.profile, plan.tier, keep=prepared_folder(), without=plan.without)
        for index, (image, target) in enumerate(zip(frames.images, targets, strict=True)):
            stage.update(index, len(targets), f"restoring {image.name}")
            mosaic, exposure = scene.frame(image)
            with naming(image), _telling_of(restored):
                picture = restorer.restore(mosaic, exposure, scene.shown)
            with storing_in(out):
                out.mkdir(parents=True, exist_ok=True)
                clips = restorer.clipping_light(exposure)
                write_picture(target, picture, Tone(display_exposure(picture, clips=clips)))
            restored.append(RestoredFile(image, target, exposure))
    for item in restored:
        output.say(f"{item.source} -> {item.picture}")
    output.result(RestoreSummary(frames.profile, plan.tier, tuple(restored)))


@contextmanager
def _telling_of(restored: list[RestoredFile]) -> Iterator[None]:
    """Add what was written before to what is wrong with a frame."""
    try:
        yield
    except RestorationError as error:
        written = f" Written before: {', '.join(str(file.picture) for file in restored)}." if restored else ""
        raise RestorationError(f"{error}{written}") from error


def _targets(frames: Frames, out: Path, picture_format: str) -> list[Path]:
    """Return one file per image; refuse to let one overwrite another, or a picture that was given."""
    targets = [out / f"{image.stem}.{picture_format}" for image in frames.images]
    given = {each.resolve() for each in (*frames.images, frames.panel_picture) if each is not None}
    for index, (image, target) in enumerate(zip(frames.images, targets, strict=True)):
        if target in targets[:index] or target.resolve() in given or target.is_dir():
            raise RestorationError(
                f"Expected names that differ in {out}, found that {target.name} for {image} is taken. "
                "Rename the image, or choose another folder."
            )
    return targets
