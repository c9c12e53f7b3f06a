"""What are no stamps, or too few, is refused by name."""

from __future__ import annotations

import inspect
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.scenes.two_gaussians import make
from tests.scenes.unchecked import checked_with
from udccal.errors import FitError
from udccal.fitting.psf_stamps.data import Stamps
from udccal.fitting.psf_stamps.fit import fit_psf_stamps
from udccal.fitting.psf_stamps.slope import without_slope


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"read_e": 0.0}, "read noise in e- from"),
        ({"clip_e": float("nan")}, "clipping level in e- from"),
        ({"position_px": np.zeros((2, 2), dtype=np.int64)}, "positions as an array of real numbers, 30 x 2"),
        ({"channel": np.full((30, 15, 15), 2)}, "channels 0, 1 and 2"),
        ({"channel": np.zeros((30, 15, 14), dtype=np.int64)}, "channels as an array of whole numbers, 30 x 15 x 15"),
        ({"values_e": np.zeros((30, 3, 15))}, "7 to 255 samples"),
        ({"values_e": np.ma.masked_less(make(1)[0].values_e, 0.0)}, "stamps without masked entries, found"),
        ({"position_px": np.ma.masked_less(make(1)[0].position_px, 99)}, "positions without masked entries, found"),
        ({"values_e": [[[0.0]]]}, "found list"),
        ({"values_e": None}, "found NoneType"),
        ({"values_e": np.zeros((30, 15, 15), dtype=complex)}, "found complex128"),
        ({"values_e": np.zeros(30)}, r"of shape \(30,\)"),
        ({"position_px": np.zeros((30, 2)).astype(str)}, "real numbers, 30 x 2"),
        ({"position_px": np.zeros((30, 2), dtype=bool)}, "found bool"),
        ({"position_px": np.zeros((30, 3), dtype=np.int64)}, r"found int64 of shape \(30, 3\)"),
        ({"position_px": np.full((30, 2), np.nan)}, "at most 1048576 px, found nan"),
        ({"position_px": np.full((30, 2), 1e30)}, "at most 1048576 px"),
        ({"position_px": np.full((30, 2), 40)}, "stamps from several places, found one"),
        ({"values_e": np.repeat(make(1)[0].values_e[:10], 3, axis=0)}, "found 20 that are copies"),
        ({"read_e": None}, "read noise in e- from 1e-06 to 1e.09, found NoneType"),
        ({"channel": [0, 1, 2]}, "channels as an array of whole numbers"),
    ],
)
def test_bad_stamps_are_refused(change: dict, words: str) -> None:
    with pytest.raises(FitError, match=words):
        checked_with(make(1)[0], change)


def test_numbers_may_be_arrays_of_no_axes() -> None:
    checked_with(make(1)[0], {"read_e": np.array(4.0), "clip_e": np.array(np.inf)})


def test_masked_arrays_without_masked_entries_are_plain_ones() -> None:
    stamps, _ = make(1)
    masked = replace(stamps, values_e=np.ma.masked_array(stamps.values_e))
    assert {type(one) for one in (masked.known, masked.value_e)} == {np.ndarray}
    np.testing.assert_array_equal(masked.value_e, stamps.value_e)


@pytest.mark.parametrize("value_e", [np.nan, 0.0, -100.0])
def test_stamps_without_light_are_refused(value_e: float) -> None:
    stamps, _ = make(1)
    with pytest.raises(FitError, match="light above the noise"):
        fit_psf_stamps(replace(stamps, values_e=np.full_like(stamps.values_e, value_e)))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_stamps_that_no_psf_describes_are_refused() -> None:
    stamps, _ = make(1)
    wild = np.where(np.random.default_rng(2).random(stamps.values_e.shape) < 0.1, 1e30, stamps.values_e)
    with pytest.raises(FitError, match="a psf can describe"):
        fit_psf_stamps(replace(stamps, values_e=wild, clip_e=1e9))


def test_what_are_no_stamps_is_refused() -> None:
    # Without the tests' own check of types, which programs do not have.
    with pytest.raises(FitError, match="Expected a Stamps, found None"):
        inspect.unwrap(fit_psf_stamps)(None)


@pytest.mark.usefixtures("as_other_programs_call")
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"orders": "a"}, "Expected a Orders, found 'a'"),
        ({"rules": {}}, "Expected a StampsRules, found dict"),
        ({"seed": "a"}, "a seed as a whole number from 0 to"),
    ],
)
def test_arguments_of_another_kind_are_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(FitError, match=words):
        fit_psf_stamps(make(1)[0], **change)


@pytest.mark.parametrize("count", [0, 3])
def test_fewer_than_four_stamps_are_too_few(count: int) -> None:
    stamps, _ = make(1)
    with pytest.raises(FitError, match=f"at least 4 stamps, found {count}"):
        fit_psf_stamps(replace(stamps, values_e=stamps.values_e[:count], position_px=stamps.position_px[:count]))


def test_flat_stamps_have_no_slope() -> None:
    """The equations of a slope had no light to divide by, and came out as a LinAlgError."""
    flat = np.full((10, 15, 15), 7.0) + np.arange(10)[:, None, None]
    stamps = Stamps(flat, np.arange(20).reshape(10, 2), 4.0)
    assert without_slope(stamps) == (stamps, ())


def test_the_slope_of_stamps_in_half_precision_is_that_of_double_precision() -> None:
    """Sums of a stamp overflowed."""
    stamps, _ = make(1)
    tilted = (stamps.values_e / 4 + stamps.offset_px[:, 0].reshape(15, 15)).astype(np.float16)
    half, double = (without_slope(replace(stamps, values_e=tilted.astype(kind))) for kind in ("f2", "f8"))
    assert half[1] == double[1] != ()
    np.testing.assert_array_equal(half[0].value_e, double[0].value_e)
