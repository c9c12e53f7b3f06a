"""``udccal plan``: computes how much to capture for an accuracy, before anything is captured."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from udccal.cli.options import RigName

_TARGET_HELP = (
    "One standard deviation to reach, such as wire=0.05%, psf=2%, noise=1%, geometry=0.1px, backscatter=1%; "
    "several may follow."
)
_PROFILE_HELP = "Profile with measured values. Default: that in the rig's folder, else the nominal values."


def plan(
    context: typer.Context,
    rig: RigName,
    target: Annotated[list[str], typer.Option("--target", metavar="TERM=SIGMA", help=_TARGET_HELP)],
    more: Annotated[list[str] | None, typer.Argument(metavar="[TERM=SIGMA]...", help="Further targets.")] = None,
    profile: Annotated[Path | None, typer.Option("--profile", help=_PROFILE_HELP)] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Write the rig with the planned captures here.")] = None,
) -> None:
    """Compute how many flats, boards, LED positions and pictures an accuracy takes, and how long. Captures nothing.

    The exit status is 1 when a target is out of reach.
    """
    from udccal.cli.jobs.plan import plan_captures

    if not plan_captures(context.obj, rig, [*target, *(more or ())], profile, out):
        raise typer.Exit(1)
