"""Steps that were skipped although a fit can do without them."""

from __future__ import annotations

import pytest

from udccal import planned_steps
from udccal.errors import UdccalError
from udccal.planned_steps import skipped_note, with_small_panel
from udccal.plugins import find_procedure
from udccal.rig import load_rig
from udccal.sessions.schema import TermName

RIG = load_rig("lg55-reduced")


def planned(term: TermName) -> list[str]:
    return [step.id for step in find_procedure(term)().steps(with_small_panel(RIG))]


@pytest.mark.parametrize("term", ["noise", "geometry", "wire", "psf", "backscatter"])
def test_nothing_is_said_of_a_term_that_is_captured_whole(term: TermName) -> None:
    assert skipped_note(term, RIG, {*planned(term), "geometry/one_more"}) == ""


def test_skipped_steps_are_counted_and_named() -> None:
    captured = set(planned("geometry")) - {"geometry/view_1", "geometry/view_4"}
    said = skipped_note("geometry", RIG, captured)
    assert said == "5 of 7 planned steps captured, without geometry/view_1, geometry/view_4."


def test_of_many_skipped_steps_the_first_are_named() -> None:
    said = skipped_note("psf", RIG, {"psf/p00_s0"})
    assert said.startswith("1 of 27 planned steps captured, without psf/p00_s1, psf/p00_s2, psf/p01_s0,")
    assert said.endswith("psf/p02_s0 and 20 more.")


def test_without_a_procedure_nothing_is_planned(monkeypatch: pytest.MonkeyPatch) -> None:
    def none_installed(term: str) -> type:
        raise UdccalError(f"Expected an installed procedure for {term}, found none. Install one.")

    monkeypatch.setattr(planned_steps, "find_procedure", none_installed)
    assert skipped_note("wire", RIG, {"wire/flat"}) == ""
