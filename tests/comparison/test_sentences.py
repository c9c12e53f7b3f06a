"""What a comparison says: what to do, why whole pitches are not known, and what nobody measured."""

from __future__ import annotations

from dataclasses import replace

import pytest

from udccal.comparison.advice import advice, better_fits
from udccal.comparison.diff import FORMAT, VERSION, Compared, ProfileDiff
from udccal.comparison.effects import Effect
from udccal.comparison.limits import DiffLimits
from udccal.comparison.movement import Moved, Movement
from udccal.comparison.term_diff import TermDiff, Verdict
from udccal.profiles.profile import Profile
from udccal.reports.diff_tables import effects_table, finding, movement_sentence, terms_table
from udccal.result import FitStatus
from udccal.sessions.schema import TermName

NOWHERE = Moved("distance", None, None, "mm")
STILL = Movement((), NOWHERE, NOWHERE, None, 0.0, 0, 1.0, 0.0, 0, 1.0, ("geometry",))


def term(name: TermName, verdict: Verdict = "same", same_captures: bool = False) -> TermDiff:
    return TermDiff(name, verdict, 9.0, 3, 0.03, same_captures, (Effect("map", 0.5, "%", 0.2, None),), (), (), ())


def said(*terms: TermDiff, better: str = "") -> str:
    return advice(terms, STILL, "B", [], better, 0.001)


def test_fits_of_the_same_captures_are_never_chosen_by_their_date() -> None:
    """The rig is the same: the newer fit may have been the quick one."""
    found = said(term("noise"), term("wire", "changed", same_captures=True), better="A, whose fits had more effort")
    differ = "the fits of wire (map: 0.5 %, limit 0.2) differ, though both are of the same captures"
    assert found == f"Use A, whose fits had more effort: {differ}."
    alone = said(term("wire", "changed", same_captures=True))
    assert alone == f"Fit the captures again with full effort: {differ}."
    both = said(term("noise", "changed"), term("wire", "changed", same_captures=True))
    assert both.startswith("Use B, the newer profile: the other one no longer describes noise (map")
    assert both.endswith(f"limit 0.2); {differ}.")


def test_the_better_fits_end_well_and_have_more_effort(toy: Profile) -> None:
    full = replace(toy.noise, effort="full")
    quick, doubtful = replace(full, effort="quick"), replace(full, status=FitStatus.POOR_FIT)
    assert better_fits({"A": [full], "B": [quick]}) == "A, whose fits had more effort"
    assert better_fits({"A": [doubtful], "B": [quick]}) == "B, whose fits ended better"
    assert better_fits({"A": [full], "B": [full]}) == ""
    assert better_fits({"A": [], "B": []}) == ""


def test_a_term_that_was_not_compared_comes_before_harmless_changes() -> None:
    found = said(term("psf", "not compared"), term("wire", "changed, harmless"), term("noise"))
    assert found == ("Capture what a profile lacks: psf could not be compared; wire changed, too little to matter.")


def compared(*terms: TermDiff, telling: tuple[str, ...]) -> ProfileDiff:
    made, moved = Compared("2026-01-01", None), replace(STILL, terms=telling)
    return ProfileDiff(FORMAT, VERSION, "x", "same", "Go on.", made, made, terms, 0.0, moved, DiffLimits())


@pytest.mark.parametrize(
    ("same_captures", "telling", "why"),
    [
        (
            ("wire", "backscatter"),
            ("geometry",),
            "wire and backscatter of both profiles were fitted to the same captures",
        ),
        (("wire",), ("geometry", "backscatter"), "wire of both profiles was fitted to the same captures"),
        ((), ("geometry", "wire"), "not both profiles have measured backscatter"),
        ((), ("wire", "backscatter"), "backscatter does not see its place well enough"),
    ],
)
def test_the_reason_why_whole_pitches_are_not_known_is_the_true_one(
    same_captures: tuple[str, ...], telling: tuple[str, ...], why: str
) -> None:
    names: tuple[TermName, ...] = ("geometry", "wire", "backscatter")
    found = compared(*(term(name, same_captures=name in same_captures) for name in names), telling=telling)
    assert movement_sentence(found).endswith(f" Whole pitches of the panel are not known: {why}.")


def test_nominal_numbers_are_not_told_as_measured() -> None:
    lacking = term("psf", "not compared")
    (row,) = terms_table(compared(lacking, telling=())).rows
    assert row[-3:] == ("–", "–", "–")
    assert "nominal numbers" in effects_table(lacking).title
    assert "nominal" not in effects_table(term("psf", "changed")).title
    assert finding(lacking) == "Not both profiles have measured this term: nothing can be told of it."
