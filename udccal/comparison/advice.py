"""The sentence at the top of a comparison: what to do, and why."""

from __future__ import annotations

from collections.abc import Sequence

from udccal.comparison.effects import Effect
from udccal.comparison.movement import Moved, Movement


def advice(
    changed: Sequence[tuple[str, Effect]], harmless: Sequence[str], moved: Movement, newer: str, chance: float
) -> str:
    """Return one sentence.

    Args:
        changed: each term that has changed, with the effect that is farthest beyond its limit.
        harmless: terms that have changed by less than matters.
        moved: the movement.
        newer: name of the profile that was made later: A or B.
        chance: probability below which the movement is significant.
    """
    if changed:
        reasons = ", ".join(f"{term} ({_said(effect)})" for term, effect in changed)
        return f"Use {newer}, the newer profile: the other one no longer describes {reasons}{_movement(moved, chance)}."
    if harmless:
        terms = " and ".join(harmless)
        return f"Go on with either profile: {terms} changed, too little to matter{_movement(moved, chance)}."
    return "Go on with either profile: they agree within their error bars."


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
