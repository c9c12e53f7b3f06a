"""The page of a validation, or of a comparison of sessions: what to do, then each term's checks with its map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from udccal.comparison.estimates import ORDER
from udccal.reports.figures import embedded_png
from udccal.reports.page import Advice, Fact, Illustration, ValidationPage, ValidationSection
from udccal.reports.validation_figures import z_figure
from udccal.reports.validation_tables import term_checks_table
from udccal.sessions.schema import TermName
from udccal.validation.checks import Check, ZMap
from udccal.validation.sessions import SessionComparison
from udccal.validation.validate import Validation


def validation_page(found: Validation, maps: Mapping[TermName, ZMap]) -> ValidationPage:
    """Build the page of one validation."""
    headline, mood = _headline(found)
    return ValidationPage(
        title=f"A profile of {found.rig}, validated by a session",
        advice=Advice(headline, mood, (found.advice,)),
        facts=(
            _counted(found.checks),
            Fact("profile made", found.profile_created_at),
            Fact("session begun", found.session_created_at),
            Fact("session", _whose(found)),
        ),
        sections=_sections(found.checks, maps),
    )


def _headline(found: Validation) -> tuple[str, str]:
    """The verdict and its colour: what was fitted to these captures, even in part, is no test of the profile."""
    if not found.ok:
        return "The profile does not hold.", "bad"
    known = (*found.own_terms, *found.partly_own_terms)
    tested = dict.fromkeys(one.term for one in found.checks if one.ok is not None and one.term not in known)
    if not known:
        return "The profile holds.", "good"
    if tested:
        return f"The profile holds for {' and '.join(tested)}.", "good"
    return "No test: the profile was fitted to these captures.", "careful"


def _whose(found: Validation) -> str:
    """Whether the profile was fitted to the session."""
    named = (("", found.own_terms), ("partly ", found.partly_own_terms))
    own = [f"{how}the profile's own for {', '.join(terms)}" for how, terms in named if terms]
    return "; ".join(own) or "another one"


def comparison_page(found: SessionComparison, maps: Mapping[TermName, ZMap]) -> ValidationPage:
    """Build the page of one comparison of sessions."""
    headline, mood = ("The rig is the same.", "good") if found.ok else ("The rig changed.", "bad")
    return ValidationPage(
        title=f"Two sessions of {found.rig}, compared",
        advice=Advice(headline, mood, (found.advice,)),
        facts=(
            _counted(found.checks),
            Fact("session begun", found.session_created_at),
            Fact("the other one begun", found.against_created_at),
        ),
        sections=_sections(found.checks, maps),
    )


def _counted(checks: Sequence[Check]) -> Fact:
    counted = [check for check in checks if check.ok is not None]
    return Fact("checks within their limits", f"{sum(bool(check.ok) for check in counted)} of {len(counted)}")


def _sections(checks: Sequence[Check], maps: Mapping[TermName, ZMap]) -> tuple[ValidationSection, ...]:
    return tuple(_section(term, [one for one in checks if one.term == term], maps.get(term)) for term in ORDER)


def _section(term: TermName, checks: list[Check], z_map: ZMap | None) -> ValidationSection:
    judged = [check.ok for check in checks if check.ok is not None]
    failed = judged.count(False)
    verdict = "not judged" if not judged else f"{failed} of {len(judged)} failed" if failed else "predicted"
    figure = () if z_map is None else (Illustration(embedded_png(z_figure(z_map)), z_map.caption, f"map of {term}"),)
    return ValidationSection(
        term=term,
        verdict=verdict,
        mood="absent" if not judged else "bad" if failed else "good",
        sentences=tuple(check.what for check in checks),
        checks=term_checks_table([check for check in checks if check.value is not None]),
        illustrations=figure,
    )
