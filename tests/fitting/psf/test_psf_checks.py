"""Crops that cannot be are refused with a sentence before any fit; samples of which nothing is known are not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.scenes.unchecked import checked_with, unchecked
from udccal.errors import FitError
from udccal.fitting.nominal import absent_wire, nominal_geometry
from udccal.fitting.psf.data import PsfData, PsfRules, Shots
from udccal.fitting.psf.fit import fit_psf
from udccal.result import FitStatus
from udccal.rig import load_rig


def shots(count: int = 4) -> Shots:
    ones = np.ones((count, 41, 21))
    place, channel = np.full((count, 2), 100), np.arange(41 * 21).reshape(41, 21) % 3
    each = np.arange(count)
    return Shots(place * 1.0, place, each, np.ones(count), 1e3 * ones, ones, channel + 0 * each[:, None, None], ones)


def spoilt(name: str, value: float) -> dict[str, np.ndarray]:
    values = getattr(shots(), name).copy()
    values[1, 2, 3] = value
    return {name: values}


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"rate": np.ones((3, 41, 21))}, "float64 of shape"),
        ({"rate": np.ones((4, 40, 21))}, r"float64 of shape \(4, 40, 21\)"),
        ({"rate": [1.0]}, "list"),
        ({"position": np.arange(4) * 1.0}, "float64 of shape"),
        ({"position": np.arange(4) * 2}, r"\[0, 2, 4, 6\]"),
        ({"weight": None}, "NoneType"),
        (spoilt("weight", -1.0), "1 samples without, the first in shot 1, row 2, column 3"),
        (spoilt("weight", np.nan), "1 samples without"),
        (spoilt("rate", np.nan), "1 samples without"),
        (spoilt("noise_per_rate", np.inf), "1 samples without"),
        (spoilt("channel", 3), "1 samples without"),
        ({"disc_px": np.full(4, np.nan)}, "3444 samples without"),
    ],
)
def test_crops_that_cannot_be_are_refused(change: dict[str, Any], found: str) -> None:
    with pytest.raises(FitError, match=rf"^Expected .*, found {found}.*\. [A-Z].*\.$"):
        checked_with(shots(), change)


@pytest.mark.usefixtures("as_other_programs_call")
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rig": None}, "Expected a RigDescription, found NoneType"),
        ({"geometry": None}, "Expected a Geometry, found NoneType"),
        ({"wire": "a"}, "Expected a Wire, found 'a'"),
        ({"rules": {}}, "Expected a PsfRules, found dict"),
    ],
)
def test_arguments_of_another_kind_are_refused(change: dict[str, Any], words: str) -> None:
    rig = load_rig("lg55-reduced")
    geometry = nominal_geometry(rig)
    right = {"data": PsfData(None), "rig": rig, "geometry": geometry, "wire": absent_wire(rig, geometry)}
    with pytest.raises(FitError, match=words):
        fit_psf(**right | change)


@pytest.mark.usefixtures("as_other_programs_call")
def test_what_are_no_crops_or_counts_is_refused() -> None:
    with pytest.raises(FitError, match="Expected a Shots, found 'a'"):
        PsfData("a")  # type: ignore[arg-type]
    with pytest.raises(FitError, match="pictures taken as a whole number from 0"):
        PsfData(None, taken=None)  # type: ignore[arg-type]


def test_rates_may_be_anything_where_nothing_is_known() -> None:
    unknown = replace(shots(), **spoilt("weight", 0.0), **spoilt("rate", np.nan))
    assert unknown.rate[1, 2, 3] == 0
    np.testing.assert_array_equal(np.delete(unknown.rate, 1, axis=0), np.delete(shots().rate, 1, axis=0))
    one_less = unchecked(shots(), **spoilt("weight", 0.0))
    assert PsfData(one_less).known(PsfRules()).shots is one_less


@pytest.mark.parametrize(("unseen", "status"), [(1, None), (2, FitStatus.TOO_FEW_DATA), (4, FitStatus.TOO_FEW_DATA)])
def test_pictures_of_which_nothing_is_known_do_not_count(unseen: int, status: FitStatus | None) -> None:
    weight = np.ones((4, 41, 21))
    weight[:unseen] = 0.0
    known = PsfData(replace(shots(), weight=weight)).known(PsfRules())
    assert known.shots is not None
    assert (known.shots.count, known.shots.positions, known.unknown) == (4 - unseen, 4 - unseen, unseen)
    unfit = known.unfit(PsfRules())
    assert (unfit and unfit[0]) == status
    assert unfit is None or "have a sample of which something is known" in unfit[1]
