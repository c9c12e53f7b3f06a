"""Flats over a wire map: of the same rig, of one that moved or turned, and with a smudge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.profiles.conftest import fitted
from tests.scenes.wire import COLUMNS, PRNU, ROWS, drawn_truth, geometry, noisy, start
from tests.validation.judged import failed, named
from udccal.fitting.wire.data import WireData
from udccal.models.wire import Wire
from udccal.validation.limits import ValidationLimits
from udccal.validation.wire import judge_wire

pytestmark = pytest.mark.medium
PITCH_MM = 0.63
MOVED = 0.1 / PITCH_MM


@pytest.fixture(scope="module")
def truth() -> Wire:
    return drawn_truth(5, start(), geometry())


@pytest.fixture(scope="module")
def flat(truth: Wire) -> WireData:
    """A day's flat, in light that falls off to one side and has another colour."""
    seen = noisy(truth, 6, electrons=1e6)
    light = 1 + 0.02 * np.linspace(-1, 1, COLUMNS) * np.linspace(1, 2, ROWS)[:, None]
    return WireData(seen.signal * light, seen.variance * light, geometry(), start(), PRNU)


def test_another_days_flat_is_predicted(truth: Wire, flat: WireData) -> None:
    found = judge_wire(flat, fitted("wire", truth), ValidationLimits())
    assert not failed(found)
    assert 0.9 < (named(found, "chi-squared").value or 0.0) < 1.1
    assert found.z_map is not None
    assert float(np.nanstd(found.z_map.z)) < 1.3


@pytest.mark.parametrize(
    "change",
    [
        lambda wire: replace(wire, offset_periods=np.asarray(wire.offset_periods) + np.array([0.0, MOVED])),
        lambda wire: replace(wire, standoff_per_pitch=wire.standoff_per_pitch + MOVED),
        lambda wire: replace(wire, rotation_rad=np.asarray(wire.rotation_rad) + np.deg2rad(np.array([0.2, 0.0, 0.0]))),
    ],
    ids=["moved by 0.1 mm", "0.1 mm farther", "turned by 0.2 degree"],
)
def test_a_rig_that_moved_fails(truth: Wire, flat: WireData, change) -> None:  # type: ignore[no-untyped-def]
    found = judge_wire(flat, fitted("wire", change(truth)), ValidationLimits())
    assert "pattern by rows and columns" in failed(found)


def test_a_smudge_fails_the_part_where_it_is(truth: Wire, flat: WireData) -> None:
    y, x = np.mgrid[:ROWS, :COLUMNS]
    smudge = 1 - 0.05 * (np.hypot(x - 40, y - 80) < 12)
    dirty = replace(flat, signal=flat.signal * smudge, variance=flat.variance * smudge)
    found = judge_wire(dirty, fitted("wire", truth), ValidationLimits())
    assert "worst part of the sensor" in failed(found)
    assert found.z_map is not None
    row, column = np.unravel_index(int(np.nanargmin(found.z_map.z)), found.z_map.z.shape)
    assert np.hypot(column * COLUMNS / 32 - 40, row * ROWS / 24 - 80) < 15


def test_dead_pixels_are_no_smudge(truth: Wire, flat: WireData) -> None:
    signal = flat.signal.copy()
    signal[7::31, 3::29] = 0.0
    assert not failed(judge_wire(replace(flat, signal=signal), fitted("wire", truth), ValidationLimits()))


@pytest.mark.parametrize(
    ("field", "value"), [("row_open", np.nan), ("row_open", 1e200), ("footprint_per_pitch", 1e200)]
)
def test_a_number_out_of_its_range_is_refused(truth: Wire, flat: WireData, field: str, value: float) -> None:
    strange = replace(truth, **{field: np.float64(value)})
    found = judge_wire(flat, fitted("wire", strange), ValidationLimits())
    assert f"Expected 'wire.{field}' to be from" in named(found, "captures").what


def test_a_map_of_impossible_values_is_refused(truth: Wire, flat: WireData) -> None:
    strange = replace(truth, baseline=truth.baseline + 100.0)
    found = judge_wire(flat, fitted("wire", strange), ValidationLimits())
    assert "values that no panel gives" in named(found, "captures").what


def test_a_flat_of_few_pixels_cannot_be_judged(truth: Wire, flat: WireData) -> None:
    few = slice(0, 64), slice(0, 96)  # eight pixels for each part of the sensor, not all of which are looked at
    small = replace(flat, signal=flat.signal[few], variance=flat.variance[few])
    found = judge_wire(small, fitted("wire", truth), ValidationLimits())
    assert "No part of the sensor has enough pixels" in named(found, "captures").what


def test_a_clipped_flat_cannot_be_judged(truth: Wire, flat: WireData) -> None:
    found = judge_wire(replace(flat, clipped=0.5), fitted("wire", truth), ValidationLimits())
    assert failed(found) == {"captures"}
