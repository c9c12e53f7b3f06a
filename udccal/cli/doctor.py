"""``udccal doctor``: what this computer has and lacks for a calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from udccal.cli.calibrate import CameraKind, DisplayKind

_SESSION_HELP = "Folder that the session is to go to: is there room for it?"


def doctor(
    context: typer.Context,
    rig: Annotated[
        str | None, typer.Option("--rig", help="The rig to be calibrated: its panel and its session.")
    ] = None,
    session: Annotated[Path | None, typer.Option("--session", help=_SESSION_HELP)] = None,
    camera: Annotated[CameraKind | None, typer.Option("--camera", help="The camera to be used must be ready.")] = None,
    display: Annotated[
        DisplayKind | None, typer.Option("--display", help="The display to be used must be ready.")
    ] = None,
    monitor: Annotated[int, typer.Option("--monitor", help="Number of the panel among the monitors.")] = 0,
) -> None:
    """Say what this computer has and lacks. Leaves with status 1 when something that was asked for cannot work."""
    from udccal.cli.jobs.doctor import report
    from udccal.doctor.examine import Wanted
    from udccal.rig import load_rig

    wanted = Wanted(
        camera=None if camera is None else camera.value,
        monitor=monitor if display is DisplayKind.window else None,
        rig=None if rig is None else load_rig(rig),
        session=session,
    )
    if not report(context.obj, wanted):
        raise typer.Exit(1)
