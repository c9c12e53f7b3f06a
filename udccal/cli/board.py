"""``udccal board``: prints the board that a rig is calibrated with."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from udccal.board.paper import Paper
from udccal.cli.options import RigName


def board(
    context: typer.Context,
    rig: RigName,
    out: Annotated[Path, typer.Option("--out", help="PDF file to write.")],
    paper: Annotated[
        Paper | None, typer.Option("--paper", help="Spread it over such sheets, to be cut and joined.")
    ] = None,
) -> None:
    """Write the rig's ChArUco board as a PDF at 1:1, with a ruler and the measures of the jig.

    Without --paper it is one page as large as the board needs.
    """
    from udccal.cli.jobs.board import write_board

    write_board(context.obj, rig, out, paper)
