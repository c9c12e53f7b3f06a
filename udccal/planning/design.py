"""Quantities that stand for the terms, design variables of a capture, and the cheapest design that reaches a sigma.

The search starts from the least captures and repeats the addition with the best gain per second until the sigma is
reached. Then it prunes the design. It uses no random numbers.
"""

from __future__ import annotations

import functools
import math
from bisect import bisect_left
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Protocol, final, runtime_checkable

from udccal.planning.steps import Cost
from udccal.rig import Captures
from udccal.sessions.schema import TermName

# One step up adds this part of the present number, and one at least.
_SHARE: Final = 0.25
# An addition that lowers sigma by less than this part of it does not count.
_LEAST_GAIN: Final = 1e-6


@final
@dataclass(frozen=True)
class Quantity:
    """The quantity whose sigma stands for a term: its unit and its meaning."""

    unit: str
    meaning: str


QUANTITIES: Final[Mapping[TermName, Quantity]] = {
    "noise": Quantity("%", "conversion gain K, relative"),
    "geometry": Quantity("px", "where a ray lands, root mean square over the sensor"),
    "wire": Quantity("%", "wire map, root mean square over the sensor"),
    "psf": Quantity("%", "kernel, relative L2"),
    "backscatter": Quantity("%", "predicted light, root mean square, of its peak"),
}


@final
@dataclass(frozen=True)
class Limits:
    """What bounds a term's sigma apart from the number of captures.

    Attributes:
        floor: the sigma in the limit of endless captures, in the quantity's unit.
        lowered_by: a change that would lower the floor; empty where there is no floor.
        used: part of the captures' information on the quantity that the fit, at its default effort, uses; 1 is all.
    """

    floor: float
    lowered_by: str
    used: float = 1.0


@runtime_checkable
class Predictor(Protocol):
    """Predicts one term of one rig; it keeps the results that do not depend on the captures."""

    def sigma(self, captures: Captures) -> float:
        """Sigma of the term's quantity; infinite where the captures do not suffice for a fit."""

    def limits(self, captures: Captures) -> Limits:
        """The bounds of sigma, for captures that suffice for a fit."""


@final
@dataclass(frozen=True)
class DesignVariable:
    """One number of ``Captures``, between the least with which the term's fit can test itself and the most allowed.

    ``counted`` says in words what the number counts.
    """

    name: str
    least: int
    most: int
    counted: str

    def of(self, captures: Captures) -> int:
        """Its value."""
        return int(getattr(captures, self.name))

    def set(self, captures: Captures, value: int) -> Captures:
        """The captures with this value."""
        return captures.model_copy(update={self.name: value})


DESIGN_VARIABLES: Final[Mapping[TermName, tuple[DesignVariable, ...]]] = {
    # PRNU and DSNU depend on the stack, K on the levels: with fewer, the other noise quantities would suffer.
    "noise": (
        DesignVariable("noise_levels", 5, 400, "levels of light"),
        DesignVariable("noise_stack", 8, 1000, "frames of a stack"),
    ),
    "geometry": (DesignVariable("board_views", 3, 200, "views of the board"),),
    "wire": (DesignVariable("flats", 2, 20_000, "flats"),),
    "psf": (
        DesignVariable("psf_columns", 2, 24, "columns of LED positions"),
        DesignVariable("psf_rows", 2, 24, "rows of LED positions"),
        DesignVariable("psf_shifts", 1, 64, "shifts at each position"),
        DesignVariable("psf_exposures", 3, 12, "exposures of a bracket"),
    ),
    "backscatter": (
        DesignVariable("backscatter_pictures", 6, 200, "pictures on the panel"),
        DesignVariable("backscatter_frames", 2, 1000, "frames of a picture"),
    ),
}


@final
class Objective:
    """Sigma and cost of one term's captures, as functions of the captures that are evaluated once for each."""

    def __init__(self, term: TermName, sigma: Callable[[Captures], float], cost: Callable[[Captures], Cost]) -> None:
        self.term, self.sigma, self.cost = term, functools.cache(sigma), functools.cache(cost)


@final
@dataclass(frozen=True)
class Setting:
    """One design variable: as it was, and as planned."""

    name: str
    before: int
    planned: int


@final
@dataclass(frozen=True)
class Suggestion:
    """One design variable one step up: the fall of sigma in per cent of itself, and the cost."""

    term: TermName
    setting: Setting
    gain_percent: float
    cost: Cost

    @property
    def per_second(self) -> float:
        """Fall of the logarithm of sigma per second of the camera's time."""
        return -math.log(max(1 - self.gain_percent / 100, 1e-16)) / max(self.cost.seconds, 1e-9)

    @property
    def per_set_up(self) -> tuple[bool, float]:
        """Orders suggestions by their gain per set-up; those without a set-up go first."""
        return self.cost.set_ups <= 0, self.gain_percent / max(self.cost.set_ups, 1)


def worthwhile(objective: Objective, design: Captures) -> list[Suggestion]:
    """Steps up of one design variable each that lower sigma at all, in the order of the design variables."""
    before, found = objective.sigma(design), []
    for variable in DESIGN_VARIABLES[objective.term]:
        value = variable.of(design)
        more = variable.set(design, min(variable.most, value + max(1, round(_SHARE * value))))
        after = objective.sigma(more)
        # From an infinite sigma, any finite one is a gain, and further captures may lead to one.
        left = after / before if math.isfinite(before) else 0.0 if math.isfinite(after) else math.exp(-1)
        if left < 1 - _LEAST_GAIN:
            setting = Setting(variable.name, value, variable.of(more))
            cost = objective.cost(more) - objective.cost(design)
            found.append(Suggestion(objective.term, setting, 100 * (1 - left), cost))
    return found


def cheapest(objective: Objective, captures: Captures, target: float) -> Captures | None:
    """The cheapest captures found whose sigma is at most ``target``; None where no captures reach it."""
    design = captures.model_copy(update={one.name: one.least for one in DESIGN_VARIABLES[objective.term]})
    while not objective.sigma(design) <= target:
        additions = worthwhile(objective, design)
        if not additions:
            return None
        best = max(additions, key=lambda one: one.per_second).setting
        design = design.model_copy(update={best.name: best.planned})
    return _pruned(objective, design, target)


def _pruned(objective: Objective, design: Captures, target: float) -> Captures:
    """Lower every variable as far as the target allows, beginning with the one that saves most time."""

    def lowered(variable: DesignVariable) -> Captures:
        # More captures never raise sigma: halving an interval finds the fewest that suffice.
        counts = range(variable.least, variable.of(design))
        spared = bisect_left(counts, True, key=lambda count: objective.sigma(variable.set(design, count)) <= target)
        return variable.set(design, variable.least + spared)

    lower = map(lowered, DESIGN_VARIABLES[objective.term])
    best = min([design, *lower], key=lambda one: objective.cost(one).seconds)
    return design if best == design else _pruned(objective, best, target)
