"""``udccal restore``: restores raw frames to clean pictures."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

from udccal.cli.options import FoundProfile, PanelPicturePath
from udccal.tiers import Tier


class PictureFormat(enum.StrEnum):
    """How restored pictures are written: display-encoded 8-bit PNG, or linear OpenEXR in e-/s."""

    png = "png"
    exr = "exr"


class TierChoice(enum.StrEnum):
    """A tier, or that one is chosen."""

    auto = "auto"
    preview = "preview"
    fast = "fast"
    balanced = "balanced"
    accurate = "accurate"


def restore(
    context: typer.Context,
    images: Annotated[
        list[Path], typer.Argument(metavar="IMAGE...", help="Raw mosaics: 16-bit PNG, or camera raw such as DNG.")
    ],
    profile: FoundProfile,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the results; with --explain, for plan.json if given.")
    ] = None,
    panel_picture: PanelPicturePath = None,
    exposure_s: Annotated[
        float | None,
        typer.Option("--exposure-s", min=1e-7, max=86400.0, help="Exposure of the frames, if not in the file."),
    ] = None,
    tier: Annotated[
        TierChoice | None,
        typer.Option(
            "--tier",
            help="preview: no deblurring. fast: one linear filter per tile. balanced: takes out noise as well. "
            "accurate: with a network, in seconds. auto, the default: by --budget-ms and --min-psnr; balanced without "
            "them.",
        ),
    ] = None,
    budget_ms: Annotated[
        float | None,
        typer.Option("--budget-ms", min=0.0, max=86400e3, help="Time that a frame may take, for --tier auto."),
    ] = None,
    min_psnr: Annotated[
        float | None,
        typer.Option("--min-psnr", min=0.0, max=200.0, help="PSNR in dB that is enough, for --tier auto."),
    ] = None,
    explain: Annotated[
        bool, typer.Option("--explain", help="Print what would be done, its dB and ms, and restore nothing.")
    ] = False,
    plan: Annotated[
        Path | None, typer.Option("--plan", help="Do what this plan says, which --explain --out wrote.")
    ] = None,
    picture_format: Annotated[
        PictureFormat, typer.Option("--format", help="png: display-encoded, for viewing. exr: linear light in e-/s.")
    ] = PictureFormat.png,
) -> None:
    """Restore raw frames with a rig's profile."""
    if out is None and not explain:
        raise typer.BadParameter("needed unless --explain is given.", param_hint="'--out'")
    chosen = None if tier is TierChoice.auto else tier
    if (budget_ms is not None or min_psnr is not None) and (chosen is not None or plan is not None):
        raise typer.BadParameter("takes neither another --tier nor --plan.", param_hint="'--budget-ms', '--min-psnr'")
    if plan is not None and (tier is not None or explain):
        raise typer.BadParameter("takes neither --tier nor --explain.", param_hint="'--plan'")
    from udccal.cli.jobs.explain import Frames, Plans, explain_plan
    from udccal.cli.jobs.restore import restore_files
    from udccal.restoration.scene_plan import Wish

    frames = Frames(images, profile, panel_picture, exposure_s)
    plans = Plans(Wish(budget_ms, min_psnr) if chosen is None else Tier(chosen.value), plan)
    if explain:
        explain_plan(context.obj, frames, plans, out)
    elif out is not None:
        restore_files(context.obj, frames, plans, out, picture_format.value)
