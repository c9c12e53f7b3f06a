"""The sentence at the top of a comparison: what to do, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from udccal.comparison.effects import Effect
from udccal.comparison.movement import Moved, Movement
from udccal.comparison.term_diff import TermDiff
from udccal.result import FitResult


def advice(
    terms: Sequence[TermDiff], moved: Movement, newer: str, lacking: Sequence[str], better: str, chance: float
) -> str:
    """Return one sentence.

    Args:
        terms: as compared.
        moved: the movement.
        newer: name of the profile that was made later: A or B.
        lacking: terms that the newer profile lacks and the other one has.
        better: of two fits of the same captures that differ, which is better, and why; empty where neither is.
        chance: probability below which the movement is significant.
    """
    by = {verdict: [one for one in terms if one.verdict == verdict] for verdict in {one.verdict for one in terms}}
    harmless, unknown = (_names(by.get(verdict, ())) for verdict in ("changed, harmless", "not compared"))
    left = f"; {unknown} could not be compared" if unknown else ""
    refitted, changed = ([one for one in by.get("changed", ()) if one.same_captures is same] for same in (True, False))
    fits = f"the fits of {_reasons(refitted)} differ, though both are of the same captures" if refitted else ""
    if changed:
        also = f"; {fits}" if fits else ""
        found = f"the other one no longer describes {_reasons(changed)}{_movement(moved, chance)}{also}{left}."
        if lacking:
            return f"Capture {' and '.join(lacking)} for {newer}, the newer profile, then use it: {found}"
        return f"Use {newer}, the newer profile: {found}"
    if fits:
        return f"{f'Use {better}' if better else 'Fit the captures again with full effort'}: {fits}{left}."
    if len(by.get("not compared", ())) == len(terms):
        return "Capture the terms that a profile lacks: nothing could be compared."
    if unknown:
        others = f"{harmless} changed, too little to matter{_movement(moved, chance)}" if harmless else ""
        return f"Capture what a profile lacks: {unknown} could not be compared; {others or 'the other terms agree'}."
    if harmless:
        return f"Go on with either profile: {harmless} changed, too little to matter{_movement(moved, chance)}."
    return "Go on with either profile: they agree within their error bars."


def _names(terms: Sequence[TermDiff]) -> str:
    return " and ".join(one.term for one in terms)


def better_fits(results: Mapping[str, Sequence[FitResult]]) -> str:
    """Return which profile has the better fits of the same captures, and why; empty where neither has.

    Args:
        results: of the fits that differ, by the name of the profile.
    """
    (a, of_a), (b, of_b) = results.items()
    for why, good in (
        ("whose fits ended better", lambda one: not one.warning),
        ("whose fits had more effort", lambda one: one.effort == "full"),
    ):
        more = sum(map(good, of_a)) - sum(map(good, of_b))
        if more:
            return f"{a if more > 0 else b}, {why}"
    return ""


def _reasons(terms: Sequence[TermDiff]) -> str:
    return ", ".join(f"{one.term} ({_said(one.worst)})" for one in terms)


def _said(effect: Effect) -> str:
    return f"{effect.name}: {effect.value:.2g} {effect.unit}, limit {effect.limit:g}"


def _movement(moved: Movement, chance: float) -> str:
    if moved.p_value >= chance:
        return ""
    found = [*_said_of("moved", moved.distance), *_said_of("turned", moved.angle)]
    return f"; the camera {' and '.join(found)}" if found else ""


def _said_of(verb: str, of: Moved) -> list[str]:
    """A length or angle with its sigma, where it is larger than that."""
    if of.value is None or of.sigma is None or of.value <= 3 * of.sigma:
        return []
    return [f"{verb} by {of.value:.4f} ± {of.sigma:.4f} {of.unit}"]
