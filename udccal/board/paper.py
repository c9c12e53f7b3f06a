"""Sheets of paper that a board can be spread over; the command line imports this without the rest."""

from __future__ import annotations

import enum


class Paper(enum.StrEnum):
    """Sheets by their names."""

    a4 = "a4"
    a3 = "a3"
    letter = "letter"


# Width and height of a sheet that stands upright.
SIDES_MM = {Paper.a4: (210.0, 297.0), Paper.a3: (297.0, 420.0), Paper.letter: (215.9, 279.4)}
