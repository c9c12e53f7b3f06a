"""Tables of a fit speak to a technician: plain names first, each with a sentence, and the field's name last."""

from __future__ import annotations

from dataclasses import replace

import pytest

from udccal.profiles.profile import Profile
from udccal.profiles.store import load_profile
from udccal.reports.fit_tables import estimates_table, meanings_table
from udccal.reports.truth import TruthRow, truth_table
from udccal.result import Estimate
from udccal.sessions.schema import TermName


@pytest.fixture(scope="module")
def profile() -> Profile:
    return load_profile("lg55-reduced")


def test_numbers_are_listed_by_their_plain_names(profile: Profile) -> None:
    table = estimates_table("Fitted", profile.noise)
    assert table.columns[0] == "quantity"
    names = {row[-1]: row[0] for row in table.rows}
    assert (names["K_DN_per_e"], names["lambda_read"]) == ("gain", "shape of the read noise")
    assert {row[-1]: row[0] for row in estimates_table("", profile.backscatter).rows}["mix_rg"] == "green seen in red"


def test_each_number_has_a_sentence(profile: Profile) -> None:
    for result in profile.results:
        rows = meanings_table(result).rows
        assert len(rows) == len(result.numbers)
        for plain, what, name in rows:
            assert plain not in ("", name)
            assert what.endswith(".")


def test_a_number_that_is_not_listed_keeps_its_name_and_has_no_sentence(profile: Profile) -> None:
    own = replace(profile.noise, estimates=(Estimate("my_number", 1.0, 0.1, "1"),))
    assert meanings_table(own).rows == (("my_number", "", "my_number"),)


@pytest.mark.parametrize(
    ("term", "name", "shown"),
    [("noise", "sigma_d_e", "dark noise"), ("geometry", "rays, 95th percentile", "rays, 95th percentile")],
)
def test_the_comparison_with_the_truth_uses_the_same_names(term: TermName, name: str, shown: str) -> None:
    (row,) = truth_table((TruthRow(term, name, "1", None, None, 0.1, None),)).rows
    assert row[1] == shown
