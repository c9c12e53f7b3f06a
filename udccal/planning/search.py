"""The cheapest captures that reach a target: additions of the best gain per second, then pruning. No chance in it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

from udccal.planning.knobs import KNOBS, Knob, additions, least_captures
from udccal.planning.steps import Cost
from udccal.rig import Captures
from udccal.sessions.schema import TermName

_MOST_ADDITIONS = 200
# An addition that lowers the logarithm of sigma by less than this is none.
_LEAST_GAIN = 1e-6


@final
@dataclass(frozen=True)
class Oracle:
    """What captures of one term would give, and what they take."""

    term: TermName
    sigma: Callable[[Captures], float]
    cost: Callable[[Captures], Cost]


@final
@dataclass(frozen=True)
class Addition:
    """One number one step up: by how much the logarithm of sigma falls, and what it takes."""

    knob: Knob
    captures: Captures
    gain: float
    cost: Cost

    @property
    def per_second(self) -> float:
        """Gain per second of the camera's time."""
        return self.gain / max(self.cost.seconds, 1e-9)

    @property
    def per_set_up(self) -> float:
        """Gain per thing that a person sets up; endless where there is none to."""
        return self.gain / self.cost.set_ups if self.cost.set_ups > 0 else math.inf


def cheapest(oracle: Oracle, captures: Captures, target: float) -> Captures | None:
    """The captures with the term's numbers turned so that the target is reached; None where no number reaches it."""
    design = least_captures(oracle.term, captures)
    for _ in range(_MOST_ADDITIONS):
        if oracle.sigma(design) <= target:
            return _pruned(oracle, design, target)
        choices = worthwhile(oracle, design)
        if not choices:
            return None
        design = max(choices, key=lambda one: one.per_second).captures
    return None


def worthwhile(oracle: Oracle, design: Captures) -> list[Addition]:
    """Additions that lower sigma at all, in the order of the knobs."""
    before, spent = oracle.sigma(design), oracle.cost(design)
    found = []
    for knob, more in additions(oracle.term, design):
        after = oracle.sigma(more)
        # From what cannot be told at all, anything that can is a gain.
        gain = math.log(before / after) if math.isfinite(before) else 100.0 if math.isfinite(after) else 1.0
        if gain > _LEAST_GAIN:
            found.append(Addition(knob, more, gain, oracle.cost(more) - spent))
    return found


def _pruned(oracle: Oracle, design: Captures, target: float) -> Captures:
    """Every number at its least that still reaches the target, the one that saves most time first."""
    while True:
        lower = [_lowered(oracle, design, target, knob) for knob in KNOBS[oracle.term]]
        best = min(lower, key=lambda one: oracle.cost(one).seconds)
        if oracle.cost(best).seconds >= oracle.cost(design).seconds:
            return design
        design = best


def _lowered(oracle: Oracle, design: Captures, target: float, knob: Knob) -> Captures:
    """Halving the interval: more captures never tell less."""
    low, high = knob.least - 1, knob.of(design)
    while high - low > 1:
        middle = (low + high) // 2
        if oracle.sigma(knob.set(design, middle)) <= target:
            high = middle
        else:
            low = middle
    return knob.set(design, high)
