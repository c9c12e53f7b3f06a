"""A capture plan: for every term with a target the cheapest captures that reach it, what they take, what helps next."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final, get_args

from udccal.planning.knobs import KNOBS
from udccal.planning.prediction import Predictor
from udccal.planning.predictors import predictor_for
from udccal.planning.search import Addition, Oracle, cheapest, worthwhile
from udccal.planning.state import RigState
from udccal.planning.steps import NOTHING, Cost, cost_of
from udccal.planning.targets import QUANTITIES, Target
from udccal.rig import Captures
from udccal.sessions.schema import TermName

# A target this much above the floor takes captures without end.
_NEAR_FLOOR = 1.001


@final
@dataclass(frozen=True)
class Setting:
    """One number of the captures: as the rig has it, and as planned."""

    name: str
    before: int
    planned: int


@final
@dataclass(frozen=True)
class Suggestion:
    """One number one step up: by how much sigma falls in per cent of itself, and what that takes."""

    term: TermName
    setting: Setting
    gain_percent: float
    cost: Cost


@final
@dataclass(frozen=True)
class TermPlan:
    """The plan of one term.

    Attributes:
        target, sigma, floor: in ``unit``; ``sigma`` is that of the planned captures, ``floor`` of endless ones.
        reached: whether the planned captures reach the target; where they do not, they are the rig's own.
        lowered_by: what would lower the floor; empty where there is none.
        per_second, per_set_up: the single additions that help most; None where none helps.
    """

    term: TermName
    unit: str
    meaning: str
    target: float
    sigma: float
    sigma_before: float
    floor: float
    reached: bool
    lowered_by: str
    settings: tuple[Setting, ...]
    cost: Cost
    cost_before: Cost
    per_second: Suggestion | None
    per_set_up: Suggestion | None


@final
@dataclass(frozen=True)
class CapturePlan:
    """The whole plan: captures of all terms, and what they take, those without a target as the rig has them."""

    captures: Captures
    terms: tuple[TermPlan, ...]
    untouched: tuple[TermName, ...]
    cost: Cost
    cost_before: Cost
    per_second: Suggestion | None
    per_set_up: Suggestion | None

    @property
    def reached(self) -> bool:
        """Whether every target is."""
        return all(term.reached for term in self.terms)


def make_plan(
    state: RigState, targets: Sequence[Target], progress: Callable[[TermName], None] = lambda term: None
) -> CapturePlan:
    """Plan the captures of a rig.

    Args:
        state: the rig, with the captures that it has now.
        targets: one per term at most.
        progress: called with a term's name when its plan begins.

    Raises:
        UdccalError: when a procedure is not installed, or does not tell what it takes.
    """
    captures, plans = state.rig.captures, []
    for target in targets:
        progress(target.term)
        captures, plan = _plan_term(state, target, captures)
        plans.append(plan)
    untouched = tuple(term for term in get_args(TermName) if term not in {plan.term for plan in plans})
    rest = sum((cost_of(term, state) for term in untouched), start=NOTHING)
    suggestions = [plan for plan in plans if plan.per_second is not None]
    return CapturePlan(
        captures=captures,
        terms=tuple(plans),
        untouched=untouched,
        cost=sum((plan.cost for plan in plans), start=rest),
        cost_before=sum((plan.cost_before for plan in plans), start=rest),
        per_second=_first([plan.per_second for plan in suggestions], _per_second),
        per_set_up=_first([plan.per_set_up for plan in suggestions], _per_set_up),
    )


def _plan_term(state: RigState, target: Target, captures: Captures) -> tuple[Captures, TermPlan]:
    term, before = target.term, state.rig.captures
    predictor = predictor_for(term, state)
    oracle = _oracle(term, state, predictor)
    floor = predictor.floor()
    found = cheapest(oracle, captures, target.sigma) if target.sigma > _NEAR_FLOOR * floor.sigma else None
    planned = captures if found is None else found
    more = [_suggestion(term, planned, one) for one in worthwhile(oracle, planned)]
    return planned, TermPlan(
        term=term,
        unit=QUANTITIES[term].unit,
        meaning=QUANTITIES[term].meaning,
        target=target.sigma,
        sigma=oracle.sigma(planned),
        sigma_before=oracle.sigma(before),
        floor=floor.sigma,
        reached=oracle.sigma(planned) <= target.sigma,
        lowered_by=floor.lowered_by,
        settings=tuple(Setting(knob.name, knob.of(before), knob.of(planned)) for knob in KNOBS[term]),
        cost=oracle.cost(planned),
        cost_before=oracle.cost(before),
        per_second=_first(more, _per_second),
        per_set_up=_first(more, _per_set_up),
    )


def _oracle(term: TermName, state: RigState, predictor: Predictor) -> Oracle:
    """What was asked once is remembered, by the numbers that matter for the term."""
    knobs = KNOBS[term]

    def restored(numbers: tuple[int, ...]) -> Captures:
        captures = state.rig.captures
        for knob, value in zip(knobs, numbers, strict=True):
            captures = knob.set(captures, value)
        return captures

    sigma = functools.cache(lambda numbers: predictor.sigma(restored(numbers)))
    cost = functools.cache(lambda numbers: cost_of(term, state.with_captures(restored(numbers))))

    def numbers_of(captures: Captures) -> tuple[int, ...]:
        return tuple(knob.of(captures) for knob in knobs)

    return Oracle(term, lambda captures: sigma(numbers_of(captures)), lambda captures: cost(numbers_of(captures)))


def _suggestion(term: TermName, planned: Captures, addition: Addition) -> Suggestion:
    setting = Setting(addition.knob.name, addition.knob.of(planned), addition.knob.of(addition.captures))
    return Suggestion(term, setting, 100 * (1 - math.exp(-addition.gain)), addition.cost)


def _per_second(one: Suggestion) -> float:
    return one.gain_percent / max(one.cost.seconds, 1e-9)


def _per_set_up(one: Suggestion) -> tuple[bool, float]:
    """What takes no set-up goes first."""
    return one.cost.set_ups <= 0, one.gain_percent / max(one.cost.set_ups, 1)


def _first(
    suggestions: Sequence[Suggestion | None], worth: Callable[[Suggestion], float | tuple[bool, float]]
) -> Suggestion | None:
    return max((one for one in suggestions if one is not None), key=worth, default=None)
