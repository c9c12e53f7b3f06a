"""Faint columns, which fit nearly as well a part of a period on."""

from __future__ import annotations

import pytest

from tests.scenes.wire import COLUMNS, ROWS, drawn_truth, fitted, geometry, noisy, shape_values, start
from udccal.fitting.wire.parameters import SHAPE_NAMES

# A tenth of the pixels, as a fit of the default effort has of a large sensor.
_SAMPLES = ROWS * COLUMNS // 10
_OFFSET = SHAPE_NAMES.index("offset_x_periods")


# Descents of the first two ended 0.22 and 0.38 periods off. The third has a second minimum, whose cost is 2.5 more: one
# minimum alone would state 0.038 periods.
@pytest.mark.parametrize(("truth", "least", "most"), [(26, 0.0, 0.04), (41, 0.0, 0.04), (31, 0.05, 0.1)])
@pytest.mark.medium
def test_the_place_of_faint_columns_holds_and_its_sigma_has_all_likely_minima(
    truth: int, least: float, most: float
) -> None:
    """The offset is right by three of its sigmas, which only a second minimum makes wide."""
    wire = drawn_truth(truth, start(), geometry())
    offset = fitted(noisy(wire, 1000 * truth), start(), geometry(), samples=_SAMPLES).or_raise().numbers[_OFFSET]
    off = offset.value - shape_values(wire)[_OFFSET]
    assert abs(off - round(off)) < 3 * offset.sigma
    assert least < offset.sigma < most
