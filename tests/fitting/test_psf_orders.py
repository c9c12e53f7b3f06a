"""Which residual is chosen beside diffraction, where it is known."""

from __future__ import annotations

from collections import Counter

import pytest

from tests.benchmarks.psf_orders import DEGREES, ENOUGH, World, chosen, world

RUNS = 34


@pytest.fixture(scope="module")
def known() -> World:
    return world()


@pytest.mark.slow
def test_the_right_degree_is_chosen_in_95_of_100_runs(known: World) -> None:
    counts = Counter((degree, chosen(known, degree, seed)) for degree in DEGREES for seed in range(RUNS))
    right = sum(counts[degree, degree] for degree in DEGREES)
    assert right >= ENOUGH * RUNS * len(DEGREES), counts
