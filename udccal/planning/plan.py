"""A capture plan: the cheapest captures that reach every term's target, their cost, and the most useful additions."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, final

from udccal.errors import UdccalError
from udccal.planning.design import DESIGN_VARIABLES, QUANTITIES, Objective, Setting, Suggestion, cheapest, worthwhile
from udccal.planning.forecast import PREDICTORS
from udccal.planning.state import RigState
from udccal.planning.steps import Cost
from udccal.rig import Captures
from udccal.sessions.schema import TermName

# A target closer to the floor than this factor needs endless captures.
_NEAR_FLOOR: Final = 1.001
_NUMBER: Final = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
_FORM: Final = re.compile(rf"(?P<term>[^=\s]+)=(?P<value>{_NUMBER})(?P<unit>%|[a-zA-Z]*)")
_EXAMPLE: Final = "Write, for example, wire=0.05% or geometry=0.1px."


@final
@dataclass(frozen=True)
class TermPlan:
    """The plan of one term.

    Attributes:
        target, sigma, floor: in ``unit``; ``sigma`` is that of the planned captures, ``floor`` that of endless ones.
        reached: whether the planned captures reach the target; where no captures do, they are the rig's own.
        lowered_by: change that would lower the floor; empty where there is no floor.
        per_second, per_set_up: the additions that lower sigma most per second and per set-up; None where none does.
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
    """The whole plan: captures and cost of all terms; terms without a target keep the rig's captures."""

    captures: Captures
    terms: tuple[TermPlan, ...]
    untouched: tuple[TermName, ...]
    cost: Cost
    cost_before: Cost
    per_second: Suggestion | None
    per_set_up: Suggestion | None

    @property
    def reached(self) -> bool:
        """Whether the plan reaches every target."""
        return all(term.reached for term in self.terms)


def parse_targets(words: Sequence[str]) -> dict[TermName, float]:
    """Read targets such as ``wire=0.05%``: a term, "=", and a sigma with the term's unit of ``QUANTITIES``.

    Returns:
        the sigma that each term is to reach, in the order of the terms.

    Raises:
        UdccalError: when a word is no target, names no term or a wrong unit, or a term has two targets.
    """
    targets = [_target(word) for word in words]
    for term in QUANTITIES:
        if (many := sum(named == term for named, _ in targets)) > 1:
            raise UdccalError(f"Expected one target for {term}, found {many}. Keep one of them.")
    return {term: sigma for term in QUANTITIES for named, sigma in targets if named == term}


def _target(word: str) -> tuple[TermName, float]:
    match = _FORM.fullmatch(word.strip())
    if match is None or not 0 < float(match["value"]) < math.inf:
        raise UdccalError(f"Expected a target above zero, such as wire=0.05%, found '{word}'. {_EXAMPLE}")
    term = next((name for name in QUANTITIES if name == match["term"]), None)
    if term is None:
        raise UdccalError(f"Expected a target for {', '.join(QUANTITIES)}, found one for '{match['term']}'. {_EXAMPLE}")
    if match["unit"] != (unit := QUANTITIES[term].unit):
        found = f"'{match['unit']}'" if match["unit"] else "none"
        raise UdccalError(f"Expected the target of {term} in {unit}, found the unit {found} in '{word}'. {_EXAMPLE}")
    return term, float(match["value"])


def make_plan(
    state: RigState, targets: Mapping[TermName, float], progress: Callable[[TermName], None] = lambda term: None
) -> CapturePlan:
    """Plan captures for the sigmas that terms are to reach, in the units of ``QUANTITIES``.

    ``state`` has the captures that the rig has now; ``progress`` is called with a term's name when its plan begins.

    Raises:
        UdccalError: as ``steps_at``.
    """
    captures, plans = state.rig.captures, []
    for term, target in targets.items():
        progress(term)
        plan, captures = _plan_term(state, term, target, captures)
        plans.append(plan)
    untouched = tuple(term for term in QUANTITIES if term not in targets)
    rest = sum((state.cost(term) for term in untouched), start=Cost())
    return CapturePlan(
        captures=captures,
        terms=tuple(plans),
        untouched=untouched,
        cost=sum((plan.cost for plan in plans), start=rest),
        cost_before=sum((plan.cost_before for plan in plans), start=rest),
        per_second=max(filter(None, (p.per_second for p in plans)), key=lambda one: one.per_second, default=None),
        per_set_up=max(filter(None, (p.per_set_up for p in plans)), key=lambda one: one.per_set_up, default=None),
    )


def _plan_term(state: RigState, term: TermName, target: float, captures: Captures) -> tuple[TermPlan, Captures]:
    before, predictor, quantity, planned = state.rig.captures, PREDICTORS[term](state), QUANTITIES[term], captures
    objective = Objective(term, predictor.sigma, lambda some: state.with_captures(some).cost(term))
    limits = predictor.limits(before)
    if target > _NEAR_FLOOR * limits.floor:
        planned = cheapest(objective, captures, target) or captures
    more = worthwhile(objective, planned)
    plan = TermPlan(
        term=term,
        unit=quantity.unit,
        meaning=quantity.meaning,
        target=target,
        sigma=objective.sigma(planned),
        sigma_before=objective.sigma(before),
        floor=limits.floor,
        reached=objective.sigma(planned) <= target,
        lowered_by=limits.lowered_by,
        settings=tuple(Setting(one.name, one.of(before), one.of(planned)) for one in DESIGN_VARIABLES[term]),
        cost=objective.cost(planned),
        cost_before=objective.cost(before),
        per_second=max(more, key=lambda one: one.per_second, default=None),
        per_set_up=max(more, key=lambda one: one.per_set_up, default=None),
    )
    return plan, planned
