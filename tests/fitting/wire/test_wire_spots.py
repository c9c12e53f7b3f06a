"""Faint features of a flat that are no panel's: a note says where they are, and the sigmas hold them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.wire import COLUMNS, ROWS, drawn_truth, fitted, geometry, noisy, start, true_map
from udccal.fitting.wire.fit import sensor_map

pytestmark = pytest.mark.medium


def test_a_ring_of_less_than_a_per_cent_is_told_with_its_place() -> None:
    truth = drawn_truth(4, start(), geometry())
    flat = noisy(truth, 4)
    y, x = np.mgrid[:ROWS, :COLUMNS]
    ring = 1 + 0.007 * np.exp(-0.5 * ((np.hypot(x - 80, y - 70) - 12) / 2) ** 2)
    results = [fitted(each, start(), geometry()) for each in (flat, replace(flat, signal=flat.signal * ring))]
    clean, marked = ([note for note in result.notes if "dust" in note] for result in results)
    assert not clean
    assert len(marked) == 1
    assert "brighter than the map about column" in marked[0]
    error = sensor_map(results[1].term, ROWS, COLUMNS) / true_map(truth) - 1
    assert 100 * float(error.std()) < 1.5 * (results[1].diagnostic("wire_map_rms_sigma") or 0.0)
