"""Strengths of images: stars correct them where they can, and tell how far they are open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.stamps import drawn
from tests.scenes.two_gaussians import make
from udccal.fitting.psf_stamps.data import Stamps, StampsRules
from udccal.fitting.psf_stamps.field import polynomials
from udccal.fitting.psf_stamps.fit import fit_psf_stamps
from udccal.fitting.psf_stamps.probability import State, expectation
from udccal.fitting.psf_stamps.search import start
from udccal.fitting.psf_stamps.strengths import drawn_strengths, settled
from udccal.numerics import in_float64

RULES = replace(StampsRules(), draws=(16, 2000))


def with_strengths() -> tuple[Stamps, State]:
    """Stamps, and a field of two images with the strengths 1 and x."""
    stamps, rules = make(1)[0], StampsRules()
    state = start(stamps, rules, 1).with_images(np.eye(3)[:2], rules)
    nodes = state.field.nodes.copy()
    # An image that is neither the light nor the place of the first.
    nodes[:, 1] = 0.3 * np.roll(nodes[:, 0], 3, axis=1) * state.kept[..., 1]
    return stamps, replace(state, field=replace(state.field, nodes=nodes))


def open_part(stamps: Stamps, state: State) -> np.ndarray:
    """What is free of 1 and x, a sigma of it."""
    draws = drawn_strengths(stamps, state, RULES).reshape(2, 3, -1)
    return draws.std(axis=2) * np.sign(draws[..., draws[1, 2].argmax()])


def seen_by(stamps: Stamps, state: State, seed: int) -> Stamps:
    """Stamps of what a state describes, with noise."""
    mean_e = expectation(stamps, state).mean_e.reshape(stamps.values_e.shape)
    sigma_e = np.sqrt(np.maximum(mean_e, 0.0) + stamps.read_e**2)
    return replace(stamps, values_e=mean_e + sigma_e * np.random.default_rng(seed).standard_normal(mean_e.shape))


@in_float64
def test_strengths_of_images_are_as_open_as_stars_leave_them() -> None:
    """Of images with the strengths 1 and x, stars leave y open; more light tells it better."""
    stamps, state = with_strengths()
    sigma = []
    for more in (1.0, 100.0):
        lit = replace(stamps, read_e=np.sqrt(more) * stamps.read_e)
        draws = drawn_strengths(lit, replace(state, light_e=more * state.light_e), RULES).reshape(2, 3, -1)
        np.testing.assert_array_equal(draws[0], 0.0)
        at_stars = polynomials(stamps.unit, 1) @ draws[1]
        np.testing.assert_allclose(state.field.strengths(stamps.unit).T @ at_stars, 0.0, atol=1e-9)
        sigma.append(draws[1].std(axis=1)[np.abs(draws[1]).mean(axis=1).argmax()])
    assert sigma[0] / sigma[1] == pytest.approx(10.0, rel=0.1)


@pytest.mark.parametrize("term", [2, 4])
@in_float64
def test_strengths_go_where_stars_have_them(term: int) -> None:
    """Of the own degree, and of one more than the search allows; what is in step with 1 and x, nodes take up."""
    stamps, found = with_strengths()
    found, every = replace(found, field=replace(found.field, mix=np.eye(6)[:2])), polynomials(stamps.unit, 2)
    free = np.eye(6)[term] - np.pad(np.linalg.lstsq(every[:, :2], every[:, term], rcond=None)[0], (0, 4))
    truth = replace(found, field=replace(found.field, mix=found.field.mix + 0.1 * np.array([[0.0], [1.0]]) * free))
    moved = settled(seen_by(stamps, truth, 1), with_strengths()[1])
    at = polynomials(np.random.default_rng(5).uniform(-0.9, 0.9, (50, 2)), 2)
    sigma = (at @ drawn_strengths(stamps, moved, RULES).reshape(2, 6, -1)[1]).std(axis=1)
    before, after = (at @ (one.field.mix[1] - truth.field.mix[1]) for one in (found, moved))
    assert np.abs(after / sigma).max() < 4
    assert np.linalg.norm(after) < 0.1 * np.linalg.norm(before)


@in_float64
def test_strengths_that_stars_agree_with_stay() -> None:
    """Without a prior by the evidence, each would move by one sigma of the stars' noise."""
    stamps, truth = with_strengths()
    sigma = open_part(stamps, truth)[1, 2]
    moves = [settled(seen_by(stamps, truth, seed), truth).field.mix[1, 2] / sigma for seed in range(20)]
    assert np.median(np.abs(moves)) < 0.3


def test_one_image_has_no_strengths() -> None:
    stamps, rules = make(1)[0], StampsRules()
    state = start(stamps, rules, 1)
    assert settled(stamps, state) is state
    assert not drawn_strengths(stamps, state, RULES).any()


@pytest.mark.medium
def test_an_image_whose_strength_few_stars_tell_is_within_its_error_bars() -> None:
    data = drawn("coma", 60012, 20, 15, 6976.908343339181, 2.323407029492466, (4.7054, 0.9411), 0.3360969897651572)
    _, _, z = data.errors(fit_psf_stamps(data.stamps).term, 8)
    # With strengths held as the search finds them, 5.2.
    assert np.quantile(np.abs(z), 0.999) < 4.5
