"""Restores raw files one at a time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt16

from udccal.cameras.picture_files.mosaics import read_raw
from udccal.cli.jobs.panel_picture import read_panel_picture
from udccal.cli.output import Output
from udccal.compilation import keep_compilations
from udccal.errors import RestorationError
from udccal.io.limits import Shape
from udccal.io.out_folder import check_writable, storing_in
from udccal.io.png import read_png16
from udccal.profiles.store import load_profile
from udccal.restoration.prepared import prepared_folder
from udccal.restoration.runtime import Restorer, check_frame
from udccal.restoration.sinks import write_picture
from udccal.restoration.tone import Tone, display_exposure
from udccal.rig import RigDescription
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
    pictures: tuple[RestoredFile, ...]


def restore_files(
    output: Output,
    images: list[Path],
    profile_path: Path,
    out: Path,
    panel_picture: Path | None,
    exposure_s: float | None,
    picture_format: Literal["png", "exr"],
    tier: Tier,
) -> None:
    """Restore every image with a profile and write it under ``out``, one by one.

    Args:
        output: shows stages and results.
        images: raw mosaics, PNG or camera raw.
        profile_path: folder or zip file of the profile, or a rig's name.
        out: folder of the restored pictures.
        panel_picture: picture that the panel showed, 8-bit RGB PNG; None when it is not known.
        exposure_s: exposure of the images; None to take that of each file.
        picture_format: ``png``, display-encoded, or ``exr``, linear light in e-/s.
        tier: how much is done to each frame.

    Raises:
        ProfileError: when the profile cannot be read.
        FileFormatError: when an image or the panel's picture cannot be read.
        RestorationError: when an image does not fit the profile's rig, or its exposure is not known.
        UdccalError: when ``out`` cannot be written to; this is found before any work.
    """
    check_writable(out)
    keep_compilations()
    profile = load_profile(profile_path)
    for warning in profile.warnings:
        output.say(warning)
    shown = None if panel_picture is None else read_panel_picture(panel_picture, profile.rig)
    targets = _targets(images, out, picture_format)
    for image in images:  # so that a bad file is reported before the long work begins
        _checked_frame(image, exposure_s, profile.rig)
    restored: list[RestoredFile] = []
    with output.stage("restoring") as stage:
        restorer = Restorer.from_profile(profile, tier, keep=prepared_folder())
        for index, (image, target) in enumerate(zip(images, targets, strict=True)):
            stage.update(index, len(images), f"restoring {image.name}")
            mosaic, exposure = _checked_frame(image, exposure_s, profile.rig)
            with _naming(image):
                picture = restorer.restore(mosaic, exposure, shown)
            with storing_in(out):
                out.mkdir(parents=True, exist_ok=True)
                write_picture(target, picture, Tone(display_exposure(picture)))
            restored.append(RestoredFile(image, target, exposure))
    for item in restored:
        output.say(f"{item.source} -> {item.picture}")
    output.result(RestoreSummary(profile_path, tuple(restored)))


def _targets(images: list[Path], out: Path, picture_format: str) -> list[Path]:
    """Return one file per image; refuse to let one overwrite another, or its own source."""
    targets = [out / f"{image.stem}.{picture_format}" for image in images]
    for index, (image, target) in enumerate(zip(images, targets, strict=True)):
        if target in targets[:index] or target.resolve() == image.resolve() or target.is_dir():
            raise RestorationError(
                f"Expected names that differ in {out}, found that {target.name} for {image} is taken. "
                "Rename the image, or choose another folder."
            )
    return targets


def _checked_frame(
    image: Path, given_s: float | None, rig: RigDescription
) -> tuple[UInt16[np.ndarray, "rows columns"], float]:
    """Return a frame that fits the rig, and its exposure in s: ``given_s``, else the file's own."""
    mosaic, in_file = _read_mosaic(image, (rig.camera.rows, rig.camera.columns))
    exposure = in_file if given_s is None else given_s
    if exposure is None:
        raise RestorationError(
            f"Expected the exposure of {image} in the file or from --exposure-s, found neither. Add --exposure-s."
        )
    with _naming(image):
        check_frame(mosaic, exposure, rig)
    return mosaic, exposure


@contextmanager
def _naming(image: Path) -> Iterator[None]:
    """Add the image's name to what is wrong with it."""
    try:
        yield
    except RestorationError as error:
        raise RestorationError(f"{image}: {error}") from error


def _read_mosaic(image: Path, shape: Shape) -> tuple[UInt16[np.ndarray, "rows columns"], float | None]:
    """Return a mosaic and the exposure in its file, if any."""
    if image.suffix.lower() == ".png":
        return read_png16(image, shape), None
    raw = read_raw(image, shape)
    return raw.data, raw.exposure_s
