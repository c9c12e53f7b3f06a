"""The camera's pose by flats of a wire that is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.wire import COLUMNS, PRNU, ROWS, drawn_truth, geometry, noisy, start
from udccal.drift.pose import PoseChange, pose_change
from udccal.fitting.wire.data import WireData
from udccal.models.wire import Wire

pytestmark = pytest.mark.medium
_NAMES = "rotation about x", "about y", "about z", "stand-off", "offset x", "offset y", "focal length"


@pytest.fixture(scope="module")
def truth() -> Wire:
    return drawn_truth(5, start(), geometry())


@pytest.fixture(scope="module")
def flat(truth: Wire) -> WireData:
    seen = noisy(truth, 6, electrons=1e6)
    light = 1 + 0.02 * np.linspace(-1, 1, COLUMNS) * np.linspace(1, 2, ROWS)[:, None]
    return WireData(seen.signal * light, seen.variance * light, geometry(), start(), PRNU)


def off(found: PoseChange, expected: np.ndarray) -> np.ndarray:
    """In sigma."""
    return np.asarray((found.values - expected) / np.sqrt(np.diag(found.cov)))


@pytest.mark.parametrize(
    ("undo", "change"),
    [
        (lambda wire: wire, np.zeros(7)),
        (
            lambda wire: replace(wire, offset_periods=np.asarray(wire.offset_periods) - np.array([0.0, 0.08])),
            np.array([0, 0, 0, 0, 0, 0.08, 0]),
        ),
        (
            lambda wire: replace(wire, rotation_rad=np.asarray(wire.rotation_rad) - np.array([3e-3, 0, 0])),
            np.array([3e-3, 0, 0, 0, 0, 0, 0]),
        ),
        (
            lambda wire: replace(
                wire, geometry=replace(wire.geometry, focal_px=np.asarray(wire.geometry.focal_px) / 1.01)
            ),
            np.array([0, 0, 0, 0, 0, 0, np.log(1.01)]),
        ),
    ],
    ids=["nothing", "moved", "turned", "refocused"],
)
def test_a_change_is_found_within_its_error_bars(
    truth: Wire, flat: WireData, undo: Callable[[Wire], Wire], change: np.ndarray
) -> None:
    found = pose_change(undo(truth), flat)
    assert found.variance == pytest.approx(1.0, abs=0.1)
    assert np.abs(off(found, change)).max() < 4.0, dict(zip(_NAMES, off(found, change), strict=True))


@pytest.mark.parametrize(("part", "radius_px"), [(0.05, 4), (0.05, 8), (0.05, 16), (0.3, 8)])
def test_a_smudge_does_not_move_the_camera(truth: Wire, flat: WireData, part: float, radius_px: float) -> None:
    y, x = np.mgrid[:ROWS, :COLUMNS]
    smudge = 1 - part * np.exp(-0.5 * ((x - 40) ** 2 + (y - 80) ** 2) / radius_px**2)
    found = pose_change(truth, replace(flat, signal=flat.signal * smudge, variance=flat.variance * smudge))
    assert np.abs(off(found, np.zeros(7))).max() < 4.0
    assert found.variance < 1.1  # its faint edges are left out, too
    assert -1.2 * part < float(np.nanmin(found.left)) < -0.6 * part


def test_flats_of_another_panel_are_not_explained(truth: Wire, flat: WireData) -> None:
    other = replace(truth, standoff_per_pitch=1.2 * truth.standoff_per_pitch)
    assert pose_change(other, flat).variance > 1.5
