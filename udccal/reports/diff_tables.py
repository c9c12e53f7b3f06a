"""Tables and sentences of a comparison of two profiles, the same for the terminal and the page."""

from __future__ import annotations

from udccal.comparison.diff import ProfileDiff
from udccal.comparison.movement import Moved, Movement
from udccal.comparison.term_diff import TermDiff
from udccal.quantities import quantity
from udccal.reports.tables import Table, number, spread


def terms_table(found: ProfileDiff) -> Table:
    """Return each term's verdict, chi-squared and most important effect."""
    rows = tuple((one.term, one.verdict, *_chi2(one), *_worst(one)) for one in found.terms)
    return Table("Terms", ("term", "verdict", "χ²", "of", "effect", "value", "limit"), rows, frozenset({2, 3, 5, 6}))


def effects_table(one: TermDiff) -> Table:
    """Return all effects of a term."""
    rows = tuple((e.name, f"{e.value:.3g} {e.unit}", _limit(e.limit), spread(e.error)) for e in one.effects)
    # What stands for a term that nobody measured is the rig description's.
    nominal = ", with nominal numbers where none were measured" if one.verdict == "not compared" else ""
    return Table(
        f"What it does to what is seen{nominal}", ("effect", "value", "limit", "error"), rows, frozenset({1, 2, 3})
    )


def estimates_diff_table(one: TermDiff) -> Table:
    """Return all estimates of a term: A's value, B less A, and that in sigmas."""
    rows = tuple(
        (
            f"{quantity(one.term, e.name).plain} [{e.unit}]",
            number(e.a, e.sigma),
            number(e.difference, e.sigma),
            f"{e.difference / e.sigma:.1f}",
        )
        for e in one.estimates
    )
    return Table("Estimates", ("quantity", "A", "B − A", "in σ"), rows, frozenset({1, 2, 3}))


def movement_table(moved: Movement) -> Table:
    """Return the parts of the movement, its length and its angle."""
    rows = tuple((_PLAIN[part.name], *_value(part), part.unit) for part in (*moved.parts, moved.distance, moved.angle))
    return Table("From A to B, against the panel", ("", "moved", "σ", "unit"), rows, frozenset({1, 2}))


# Terms that tell where the camera was.
_TELLING = ("geometry", "wire", "backscatter")
_PLAIN = {
    "x": "x, to the panel's right",
    "y": "y, down the panel",
    "z": "z, towards the viewer",
    "tilt": "tilt, looking down",
    "roll": "roll",
    "yaw": "yaw",
    "distance": "distance",
    "angle": "angle",
}


def movement_sentence(found: ProfileDiff) -> str:
    """Return who tells the movement, whether it is significant, and whether the terms agree on it."""
    moved = found.movement
    if not moved.terms and any(one.same_captures and one.dof for one in found.terms if one.term in _TELLING):
        return "Both profiles were fitted to the same captures: they tell no movement."
    if not moved.terms:
        return "No term of both profiles tells where the camera was."
    said = "No movement is seen" if moved.p_value >= found.limits.chance else "The camera moved"
    said += f" (χ² {moved.chi2:.4g} of {moved.dof}; from {_listed(moved.terms)})."
    if moved.agreement_dof:
        agree = moved.agreement_p_value >= found.limits.chance
        said += f" These terms {'agree' if agree else 'do not agree'} on it"
        said += f" (χ² {moved.agreement_chi2:.4g} of {moved.agreement_dof})."
        said += "" if agree else " Something else changed, too."
    if moved.whole_pitches is None:
        said += f" Whole pitches of the panel are not known: {_why_no_pitches(found)}."
    return said


def _why_no_pitches(found: ProfileDiff) -> str:
    """Why wire and backscatter, which tell them together, do not."""
    of = {one.term: one for one in found.terms if one.term in ("wire", "backscatter")}
    if same := [name for name, one in of.items() if one.same_captures]:
        return (
            f"{_listed(tuple(same))} of both profiles {'was' if len(same) == 1 else 'were'} fitted to the same captures"
        )
    if lacking := [name for name in of if name not in found.movement.terms]:
        return f"not both profiles have measured {_listed(tuple(lacking))}"
    return "backscatter does not see its place well enough"


def finding(one: TermDiff) -> str:
    """Return chi-squared of a term as a sentence, with its largest deviation."""
    if one.verdict == "not compared":
        return "Not both profiles have measured this term: nothing can be told of it."
    if not one.dof:
        return "No estimate of this term has a covariance in both profiles: only the effects below are compared."
    largest = max(one.estimates, key=lambda e: abs(e.difference) / e.sigma)
    name = quantity(one.term, largest.name).plain
    return (
        f"χ² is {one.chi2:.4g} for {one.dof} estimates ({_probability(one.p_value)}); the farthest is {name}, "
        f"{abs(largest.difference) / largest.sigma:.1f} σ."
    )


def notes(one: TermDiff) -> tuple[str, ...]:
    """Return what a person should know of a term, with what chi-squared leaves out."""
    names = "; ".join(quantity(one.term, name).plain for name in one.not_covered)
    left = (f"Not in χ², as no covariance is kept of it: {names}.",) if names else ()
    return (*one.notes, *left)


def _worst(one: TermDiff) -> tuple[str, str, str]:
    """The most important effect; none of a term that was not compared, which would be of nominal numbers."""
    if one.verdict == "not compared":
        return "–", "–", "–"
    return one.worst.name, f"{one.worst.value:.3g} {one.worst.unit}", _limit(one.worst.limit)


def _chi2(one: TermDiff) -> tuple[str, str]:
    return (f"{one.chi2:.4g}", str(one.dof)) if one.dof else ("–", "–")


def _probability(p: float) -> str:
    return f"p = {p:.2g}" if p > 1e-99 else "p below 1e-99"


def _limit(limit: float | None) -> str:
    return "–" if limit is None else f"{limit:g}"


def _value(of: Moved) -> tuple[str, str]:
    return ("–", "–") if of.value is None else (number(of.value, of.sigma), spread(of.sigma))


def _listed(words: tuple[str, ...]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
