"""``udccal board``: prints the board that a rig is calibrated with."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

from udccal.cli.options import RigName


class PaperChoice(enum.StrEnum):
    """Sheets of paper that a board can be spread over."""

    a4 = "a4"
    a3 = "a3"
    letter = "letter"


def board(
    context: typer.Context,
    rig: RigName,
    out: Annotated[Path, typer.Option("--out", help="PDF file to write.")],
    paper: Annotated[
        PaperChoice | None, typer.Option("--paper", help="Spread it over such sheets, to be cut and joined.")
    ] = None,
) -> None:
    """Write the rig's ChArUco board as a PDF at 1:1, with a ruler and the measures of the jig.

    Without --paper it is one page as large as the board needs.
    """
    from udccal.cli.jobs.board import write_board

    write_board(context.obj, rig, out, paper)
