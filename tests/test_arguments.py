"""Checks of arguments: what is refused, in which words."""

from __future__ import annotations

import numpy as np
import pytest

from udccal.arguments import Numbers, check_array, check_count, check_number, number_of
from udccal.errors import FitError


@pytest.mark.parametrize("value", [True, None, "3", np.nan, -0.1, 1.1, np.zeros(1)])
def test_what_is_no_number_within_bounds_is_refused(value: object) -> None:
    with pytest.raises(FitError, match=r"Expected a part from 0 to 1, found .* Give one"):
        check_number(value, "a part", (0.0, 1.0), "Give one.", FitError)


@pytest.mark.parametrize("value", [0, 1, 0.5, np.float32(0.5), np.int8(1)])
def test_numbers_within_bounds_are_accepted(value: object) -> None:
    check_number(value, "a part", (0.0, 1.0), "Give one.", FitError)


@pytest.mark.parametrize("value", [True, 0, 9, 2.0, "2"])
def test_what_is_no_count_is_refused(value: object) -> None:
    with pytest.raises(FitError, match="Expected steps as a whole number from 1 to 8, found"):
        check_count(value, "steps", 1, 8, FitError)


@pytest.mark.parametrize(
    ("value", "numbers"),
    [
        ([[1, 2]], "real numbers"),
        (np.zeros((2, 3), complex), "real numbers"),
        (np.zeros((2, 3)), "whole numbers"),
        (np.zeros((2, 3), np.uint16), "8-bit values"),
        (np.zeros((2, 4), np.uint8), "8-bit values"),
        (np.zeros((3,), bool), "truth values"),
    ],
)
def test_arrays_of_another_kind_or_shape_are_refused(value: object, numbers: Numbers) -> None:
    with pytest.raises(FitError, match=f"Expected it as an array of {numbers}, rows x 3, found"):
        check_array(value, "it", numbers, ("rows", 3), "Give it.", FitError)


@pytest.mark.parametrize("numbers", ["real numbers", "whole numbers"])
def test_masked_entries_are_refused(numbers: Numbers) -> None:
    with pytest.raises(FitError, match="Expected it without masked entries, found 1 of 3 masked"):
        check_array(np.ma.masked_equal([1, 2, 3], 2), "it", numbers, (3,), "Give it.", FitError)
    check_array(np.ma.masked_equal([1, 2, 3], 4), "it", numbers, (3,), "Give it.", FitError)


def test_an_axis_with_a_name_has_any_length() -> None:
    for rows in (0, 5):
        check_array(np.zeros((rows, 3), np.uint8), "it", "8-bit values", ("rows", 3), "Give it.", FitError)


def test_the_number_in_an_array_of_no_axes_is_a_number() -> None:
    """Terms hold their numbers so: noise.PRNU1288 may be given on."""
    check_number(number_of(np.array(0.5)), "a part", (0.0, 1.0), "Give one.", FitError)
    for value in (None, "0.5", np.array(True), np.array([0.5]), [0.5]):
        with pytest.raises(FitError, match="Expected a part from 0 to 1"):
            check_number(number_of(value), "a part", (0.0, 1.0), "Give one.", FitError)
