"""Writes the board of a rig as a PDF."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import final

from udccal.arrangements import BoardSpec
from udccal.board.instructions import sentences
from udccal.board.paper import Paper
from udccal.board.pdf import board_pdf
from udccal.board.set_up import set_up_of
from udccal.cli.jobs.apart import check_apart
from udccal.cli.output import Output
from udccal.errors import UdccalError
from udccal.io.atomic import write_atomically
from udccal.io.out_folder import check_writable, storing_in
from udccal.rig import load_rig


@final
@dataclass(frozen=True)
class PrintedBoard:
    """Result of ``board``; ``pages`` counts a cover too where there is one."""

    rig: str
    file: Path
    pages: int
    board: BoardSpec
    width_mm: float
    height_mm: float


def write_board(output: Output, rig_name: str, out: Path, paper: Paper | None) -> None:
    """Write the PDF, and say what is on it.

    Raises:
        RigError: when the rig is not known, or its board cannot be printed.
        UdccalError: when ``out`` is not the name of a PDF, is in a profile or a session, or cannot be written, or
            ``paper`` is too small.
    """
    if out.suffix.lower() != ".pdf" or out.is_dir():
        raise UdccalError(f"Expected the name of a file that ends in .pdf, found '{out}'. Give --out board.pdf.")
    rig = load_rig(rig_name)
    check_apart(out)
    check_writable(out.parent)
    set_up = set_up_of(rig)
    pdf, pages = board_pdf(rig.name, set_up, paper)
    with storing_in(out.parent):
        out.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(out, pdf)
    for sentence in sentences(rig.name, set_up):
        output.answer(sentence)
    output.say(f"{out}: {pages} {'page' if pages == 1 else 'pages'}")
    output.result(PrintedBoard(rig.name, out, pages, set_up.board, set_up.width_mm, set_up.height_mm))
