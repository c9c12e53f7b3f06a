"""Which numbers of ``Captures`` a plan may turn, and how far."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, final

from udccal.rig import Captures
from udccal.sessions.schema import TermName

# A step of a search adds this share of what there is, and one at least.
_SHARE: Final = 0.25


@final
@dataclass(frozen=True)
class Knob:
    """One number of ``Captures``, with the least that the term's fit can judge itself by, and the most to be asked.

    ``counted`` says in words what the number counts.
    """

    name: str
    least: int
    most: int
    counted: str

    def of(self, captures: Captures) -> int:
        """What it is set to."""
        return int(getattr(captures, self.name))

    def set(self, captures: Captures, value: int) -> Captures:
        """The captures with this number."""
        return captures.model_copy(update={self.name: value})

    def more(self, captures: Captures) -> Captures | None:
        """One step up; None where there is no more."""
        value = self.of(captures)
        if value >= self.most:
            return None
        return self.set(captures, min(self.most, value + max(1, round(_SHARE * value))))


KNOBS: Final = MappingProxyType[TermName, tuple[Knob, ...]](
    {
        # PRNU and DSNU live on the stack, K on the levels: below these, noise's other numbers would suffer.
        "noise": (Knob("noise_levels", 5, 400, "levels of light"), Knob("noise_stack", 8, 1000, "frames of a stack")),
        "geometry": (Knob("board_views", 3, 200, "views of the board"),),
        "wire": (Knob("flats", 2, 20_000, "flats"),),
        "psf": (
            Knob("psf_columns", 2, 24, "columns of LED positions"),
            Knob("psf_rows", 2, 24, "rows of LED positions"),
            Knob("psf_shifts", 1, 64, "shifts at each position"),
            Knob("psf_exposures", 3, 12, "exposures of a bracket"),
        ),
        "backscatter": (
            Knob("backscatter_pictures", 6, 200, "pictures on the panel"),
            Knob("backscatter_frames", 2, 1000, "frames of a picture"),
        ),
    }
)


def least_captures(term: TermName, captures: Captures) -> Captures:
    """The captures with a term's numbers at their least."""
    for knob in KNOBS[term]:
        captures = knob.set(captures, knob.least)
    return captures


def additions(term: TermName, captures: Captures) -> Iterator[tuple[Knob, Captures]]:
    """The captures with one of a term's numbers one step up, number by number."""
    for knob in KNOBS[term]:
        more = knob.more(captures)
        if more is not None:
            yield knob, more


def said(term: TermName, captures: Captures) -> str:
    """A term's numbers in words, for a table."""
    return ", ".join(f"{knob.name} {knob.of(captures)}" for knob in KNOBS[term])
