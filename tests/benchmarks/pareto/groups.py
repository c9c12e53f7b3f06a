"""Which scenes are restored under which conditions: the groups of the tables."""

from __future__ import annotations

import enum
from dataclasses import dataclass

from tests.benchmarks.pictures import CONDITIONS, Conditions, Shot


class Group(enum.StrEnum):
    """A group of cases, which has a mean of its own.

    ``nineteen``: the scenes of ``make accuracy``. ``fine``: scenes with detail to the pixel. ``lamps``: those of the
    nineteen with lamps in view. ``dark``: little light. ``panel``: a panel from black to white, and one with faces.
    """

    nineteen = "nineteen"
    fine = "fine"
    lamps = "lamps"
    dark = "dark"
    panel = "panel"


# Groups that are compared with a camera without a panel.
COMPARED = (Group.nineteen, Group.fine)

USUAL = CONDITIONS[0]
_DARK = (Conditions("light / 8", light=1 / 8), Conditions("light / 64", light=1 / 64))
_GREYS = (("black", 0), ("grey 25 %", 64), ("grey 50 %", 128), ("white", 255), ("faces", None))
_PANEL = tuple(
    Conditions(f"{name}, {'known' if known else 'unknown'}", known=known, grey=grey)
    for name, grey in _GREYS
    for known in (True, False)
)
_LAMP_SCENES = ("Desk", "CandleGlass")
_DARK_SCENES = ("Carrots", "kodim07", "lobby view")
_PANEL_SCENES = ("kodim15", "park view")


@dataclass(frozen=True)
class Case:
    """One scene under one set of conditions, in a group."""

    group: Group
    shot: Shot
    conditions: Conditions

    @property
    def key(self) -> tuple[str, str]:
        """The same for cases that are the same picture: a case may be in two groups."""
        return self.shot.name, "" if self.conditions == USUAL else self.conditions.name


def cases_of(nineteen: list[Shot], fine: list[Shot]) -> list[Case]:
    """Every case of every group."""
    cases = [Case(Group.nineteen, shot, USUAL) for shot in nineteen]
    cases += [Case(Group.fine, shot, USUAL) for shot in fine]
    cases += [Case(Group.lamps, shot, USUAL) for shot in _named(nineteen, _LAMP_SCENES)]
    for group, names, several in ((Group.dark, _DARK_SCENES, _DARK), (Group.panel, _PANEL_SCENES, _PANEL)):
        cases += [Case(group, shot, conditions) for shot in _named(nineteen, names) for conditions in several]
    return cases


def _named(shots: list[Shot], names: tuple[str, ...]) -> list[Shot]:
    """The shots of these names; where some are left out for a quicker look, the first shot."""
    return [shot for shot in shots if shot.name in names] or shots[:1]
