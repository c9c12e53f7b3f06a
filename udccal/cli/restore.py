"""``udccal restore``: restores raw frames to clean pictures."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

from udccal.cli.options import FoundProfile, OutFolder, PanelPicturePath
from udccal.tiers import Tier


class PictureFormat(enum.StrEnum):
    """How restored pictures are written: display-encoded 8-bit PNG, or linear OpenEXR in e-/s."""

    png = "png"
    exr = "exr"


def restore(
    context: typer.Context,
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="Raw mosaics: 16-bit PNG, or DNG.")],
    profile: FoundProfile,
    out: OutFolder,
    panel_picture: PanelPicturePath = None,
    exposure_s: Annotated[
        float | None, typer.Option("--exposure-s", min=1e-7, help="Exposure of the frames, if not in the file.")
    ] = None,
    tier: Annotated[
        Tier,
        typer.Option(
            "--tier",
            help="preview: no deblurring. fast: one linear filter per tile. balanced: takes out noise as well.",
        ),
    ] = Tier.balanced,
    picture_format: Annotated[
        PictureFormat, typer.Option("--format", help="png: display-encoded, for viewing. exr: linear light in e-/s.")
    ] = PictureFormat.png,
) -> None:
    """Restore raw frames with a rig's profile."""
    from udccal.cli.jobs.restore import restore_files

    restore_files(context.obj, images, profile, out, panel_picture, exposure_s, picture_format.value, tier)
