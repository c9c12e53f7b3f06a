"""``udccal simulate``: shows a photograph as a simulated rig would see it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from udccal.cli.options import OutFolder, RigName, Seed

_PANEL_HELP = "8-bit RGB PNG that the panel shows, as seen from behind; without it the panel is dark."


def simulate(
    context: typer.Context,
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="Photographs: PNG, JPEG, HDR or EXR.")],
    rig: RigName,
    out: OutFolder,
    panel_picture: Annotated[Path | None, typer.Option("--panel-picture", help=_PANEL_HELP)] = None,
    seed: Seed = 0,
) -> None:
    """Degrade photographs as a simulated rig would see them: a raw mosaic, a preview, and the ideal view."""
    from udccal.cli.jobs.simulate import simulate_files

    simulate_files(context.obj, images, rig, out, panel_picture, seed)
