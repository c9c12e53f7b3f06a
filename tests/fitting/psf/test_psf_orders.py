"""Which residual is chosen in addition to diffraction, and which image without it, where they are known."""

from __future__ import annotations

from collections import Counter

import pytest

from tests.scenes import psf_free_orders
from tests.scenes.psf_orders import ENOUGH, KINDS, World, chosen, world

RUNS = 25
FREE_RUNS = 8


@pytest.fixture(scope="module")
def known() -> World:
    return world()


@pytest.mark.slow
def test_the_right_degree_and_width_are_chosen_in_95_of_100_runs(known: World) -> None:
    counts = Counter((kind, chosen(known, kind, seed)) for kind in KINDS for seed in range(RUNS))
    right = sum(counts[kind, kind] for kind in KINDS)
    assert right >= ENOUGH * RUNS * len(KINDS), counts


@pytest.mark.slow
def test_the_right_degree_of_an_image_without_diffraction_is_chosen() -> None:
    degrees = psf_free_orders.DEGREES
    counts = Counter((d, psf_free_orders.chosen(d, seed)) for d in degrees for seed in range(FREE_RUNS))
    right = sum(counts[degree, degree] for degree in degrees)
    assert right >= ENOUGH * FREE_RUNS * len(degrees), counts


def test_diffraction_is_kept_where_it_is_all_there_is(known: World) -> None:
    assert chosen(known, KINDS[0], 100) == KINDS[0]


def test_a_narrow_residual_is_found_narrow(known: World) -> None:
    assert chosen(known, KINDS[2], 100) == KINDS[2]
