"""``udccal doctor``: checks this computer before a calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from udccal.cli.bench_options import CameraKind, DisplayKind

_SESSION_HELP = "Folder of the session: checks that its disk has room."


def doctor(
    context: typer.Context,
    rig: Annotated[
        str | None, typer.Option("--rig", help="Rig to calibrate: checks its panel and the size of its session.")
    ] = None,
    session: Annotated[Path | None, typer.Option("--session", help=_SESSION_HELP)] = None,
    camera: Annotated[
        CameraKind | None, typer.Option("--camera", help="Camera to use: it must be ready, and fit --rig.")
    ] = None,
    serial: Annotated[str | None, typer.Option("--serial", help="Serial number; needed if there are several.")] = None,
    display: Annotated[DisplayKind | None, typer.Option("--display", help="Display to use: it must be ready.")] = None,
    monitor: Annotated[
        int | None, typer.Option("--monitor", help="Number of the monitor that is the panel, 0 where it is left out.")
    ] = None,
) -> None:
    """Check this computer before a capture. The exit status is 1 when something that you asked for cannot work."""
    from udccal.cli.jobs.doctor import report
    from udccal.doctor.examine import Wanted
    from udccal.rig import load_rig

    if serial is not None and camera not in (CameraKind.u3v, CameraKind.pylon):
        raise typer.BadParameter("--serial is a real camera's: give --camera u3v or pylon with it, or leave it out.")
    if monitor is not None and display is not DisplayKind.window:
        raise typer.BadParameter("--monitor is for a window: give --display window with it, or leave it out.")
    wanted = Wanted(
        camera=None if camera is None else camera.value,
        serial=serial,
        monitor=(monitor or 0) if display is DisplayKind.window else None,
        rig=None if rig is None else load_rig(rig),
        session=session,
    )
    if not report(context.obj, wanted):
        raise typer.Exit(1)
