"""Numbers as text."""

from __future__ import annotations

import math

import pytest

from udccal.reports.tables import number, spread


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (0.355123, 0.00021, "0.35512"),
        (1739.4567, 0.12, "1739.46"),
        (1739.4567, 12.0, "1739"),
        (3892.4, 530.0, "3890"),
        (-0.0003586, 1.6e-6, "-0.0003586"),
        (-0.00015812, 1.1e-5, "-0.000158"),
        (-0.0612, 0.0031, "-0.0612"),
        (17.0, None, "17"),
        (3.14159, 0.0, "3.142"),
        (1.23e-9, 2e-11, "1.230e-09"),
    ],
)
def test_a_value_has_two_digits_of_its_sigma(value: float, sigma: float | None, text: str) -> None:
    assert number(value, sigma) == text


def test_what_is_not_known_says_so() -> None:
    assert number(math.nan, 1.0) == "not known"
    assert spread(math.inf) == "–"
    assert spread(None) == "–"
    assert [spread(sigma) for sigma in (0.0314, 0.1, 12.3, 534.0, 1.63e-6)] == [
        "0.031",
        "0.10",
        "12",
        "530",
        "0.0000016",
    ]
