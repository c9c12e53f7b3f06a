"""Harmonics too weak to be fitted: in the map's sigma where the residuals have them, and not where they have not."""

from __future__ import annotations

import equinox as eqx
import jax
import numpy as np
import pytest

from tests.fitting.wire.test_wire_parts import GEOMETRY, even_pixels
from tests.scenes.wire import start
from udccal.fitting.wire.data import FlatNoise, weighed
from udccal.fitting.wire.jacobian import expected_of
from udccal.fitting.wire.map_error import Omitted, Strengths, harmonics_alone, omitted, tied_sigma
from udccal.fitting.wire.parameters import WireRules, ideal_wire, possible_harmonics
from udccal.models.wire import Wire

START, RULES = start(), WireRules()
NOISE = 5e-4
# Of the template; two of three panels are there, to a share.
SHARES = (0.0, 0.85, 1.0)


@pytest.fixture(scope="module")
def wire() -> Wire:
    with jax.enable_x64(True):
        return ideal_wire(GEOMETRY, START, possible_harmonics(START).orders)


def found(wire: Wire, share: float, seed: int, noise: float = NOISE) -> tuple[Omitted, float]:
    """Fit a flat that has a fraction of the omitted harmonics; return the result and their RMS."""
    with jax.enable_x64(True):
        pixels = even_pixels(wire, noise, seed)
        weak = possible_harmonics(START, RULES.least_counted, RULES.least_amplitude)
        template = harmonics_alone(wire, weak.orders, pixels)
        pixels = eqx.tree_at(lambda p: p.value, pixels, pixels.value * (1 + share * template))
        line = FlatNoise(np.full(4, noise**2), np.zeros(4), 0.0, np.full(4, np.inf))
        judged = weighed(pixels, expected_of(wire, np.ones(4), pixels), line)
        left = omitted(START, wire, judged, RULES)
    assert left is not None
    return left, float(template[pixels.weight > 0].std())


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.medium
def test_the_share_is_found_within_its_error(wire: Wire, share: float) -> None:
    errors = []
    for seed in range(4):
        left, rms = found(wire, share, seed)
        errors.append((left.part - share) / left.part_sigma)
        assert left.rms == pytest.approx(rms, rel=0.1)
        assert left.part_sigma < 0.2
        assert (left.probability > 0.95) == (share > 0)
    assert np.abs(errors).max() < 3.5


@pytest.mark.medium
def test_where_noise_hides_them_they_are_as_likely_as_not(wire: Wire) -> None:
    left, _ = found(wire, 1.0, 0, noise=0.5)
    assert left.part_sigma > 50
    assert left.probability == pytest.approx(0.5, abs=0.05)
    assert left.sigma == pytest.approx(left.rms * np.sqrt(left.probability))


def test_what_is_surely_left_out_counts_whole_and_what_is_not_there_hardly() -> None:
    there, not_there = (Omitted(2e-4, share, 0.1).sigma for share in (1.0, 0.0))
    assert there == pytest.approx(2e-4, rel=0.01)
    assert not_there < 2e-5


def test_extreme_shares_have_a_probability() -> None:
    for share, sigma in ((0.0, 1e150), (40.0, 1e-6), (-40.0, 1e-6), (1.0, 1e-9), (0.0, 1e-9)):
        probability = Omitted(1e-4, share, sigma).probability
        assert 0.0 <= probability <= 1.0


def test_weak_harmonics_may_differ_by_more_than_the_strong_ones_show() -> None:
    """As of rounded openings: strong harmonics are a round pupil's within 1 %, those not fitted are off by half."""
    rng, strong = np.random.default_rng(3), np.arange(20) < 10
    known = np.where(strong, 1e6, 20.0)
    real = np.where(strong, 0.01, 0.5) * rng.standard_normal(20)
    strengths = Strengths(real + rng.standard_normal(20) / np.sqrt(known), known, ~strong)
    with jax.enable_x64(True):
        few = ideal_wire(GEOMETRY, START, possible_harmonics(START).orders[:20])
        pixels = even_pixels(few, NOISE, 0)
        line = FlatNoise(np.full(4, NOISE**2), np.zeros(4), 0.0, np.full(4, np.inf))
        seen = weighed(pixels, expected_of(few, np.ones(4), pixels), line)
    of_all = np.sum(seen.pixels.weight * seen.expected**2)
    error = np.sqrt(real[~strong] ** 2 @ known[~strong] / of_all)
    assert 0.7 < tied_sigma(strengths, few, seen, 1.0) / error < 2.0
