"""The parts of the wire fit: slopes, weights, prior, choice of columns, search, and the test for patterns."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from udccal.fitting.wire.basis import Normal, Pixels, model_columns, sample_pixels
from udccal.fitting.wire.harmonics import WireStart, full_basis, plain_basis
from udccal.fitting.wire.joint import Joint
from udccal.fitting.wire.misfit import SIGNIFICANT, misfit, robust_ratio
from udccal.fitting.wire.noise import FlatNoise, Judged, flat_noise, judge, listed
from udccal.fitting.wire.phase import solve
from udccal.fitting.wire.prior import rig_prior
from udccal.fitting.wire.scan import ideal_wire, scan_rows
from udccal.fitting.wire.select import select
from udccal.fitting.wire.slopes import move, shape_vector, wire_slopes
from udccal.models.geometry import Geometry
from udccal.models.wire import Wire, log_baseline, modulation, slopes

ROWS, COLUMNS = 96, 128
HARMONICS = np.array([[0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [-1.0, 2.0], [0.0, 3.0]])
START = WireStart(12.0, 0.03, 3.0, 0.04, 0.4, 0.02, 0.9, 0.01, 0.05, 0.01)
GEOMETRY = Geometry(
    focal=np.array([120.0, 120.0]),
    centre=np.array([63.0, 48.5]),
    distortion=np.array([-0.05, 0.01, 0.0, 0.0, 0.0]),
    rotation=np.array([-0.3, 0.01, 0.02]),
    pupil=np.array([60.0, 30.0, -7.5]),
)


def uneven_wire(seed: int = 0) -> Wire:
    rng = np.random.default_rng(seed)
    wire = ideal_wire(GEOMETRY, START, HARMONICS)
    return eqx.tree_at(
        lambda w: (w.fields, w.baseline, w.amplitudes, w.rotation, w.frequency),
        wire,
        (
            np.asarray(wire.fields) + 0.05 * rng.standard_normal(np.shape(wire.fields)),
            0.1 * rng.standard_normal((9, 9)),
            0.01 * rng.standard_normal((2, 2, 4, 4)),
            np.array([0.01, 0.02, -0.03]),
            np.tile([1.5, 0.8], (len(HARMONICS), 1)),
        ),
    )


def even_pixels(wire: Wire, noise: float, seed: int) -> Pixels:
    """Pixels of the ideal map with white noise."""
    blank = sample_pixels(np.ones((ROWS, COLUMNS)), np.full((ROWS, COLUMNS), noise**2), GEOMETRY, 1)
    with jax.enable_x64(True):
        whole, base, _ = model_columns(wire, blank, plain_basis(), shape=False)
    value = whole * base + noise * np.random.default_rng(seed).standard_normal(len(whole))
    return eqx.tree_at(lambda p: p.value, blank, value)


def test_slopes_are_those_of_the_model() -> None:
    wire = uneven_wire()
    pixels = sample_pixels(np.ones((ROWS, COLUMNS)), np.ones((ROWS, COLUMNS)), GEOMETRY, 301)

    @jax.jit
    @jax.jacfwd
    def by_shape(steps: jax.Array) -> jax.Array:
        moved = move(wire, steps)
        slope = slopes(moved, pixels.ideal)
        return jnp.exp(log_baseline(moved, pixels.scaled, slope)) * (1 + modulation(moved, slope, pixels.scaled))

    with jax.enable_x64(True):
        expected = np.asarray(by_shape(jnp.zeros(10)))
        found = wire_slopes(wire, pixels.ideal, pixels.scaled)
        shape = (np.asarray(found.shape) * np.asarray(found.base)).T
    np.testing.assert_allclose(shape, expected, atol=1e-9 * np.abs(expected).max())
    assert np.all(np.abs(expected).max(axis=0) > 1e-3)


def test_columns_of_linear_coefficients_are_differences_of_the_map() -> None:
    wire = uneven_wire()
    pixels = sample_pixels(np.ones((ROWS, COLUMNS)), np.ones((ROWS, COLUMNS)), GEOMETRY, 301)
    basis = full_basis(np.full(len(HARMONICS), 1e-2), plain_basis())
    with jax.enable_x64(True):
        whole, base, design = model_columns(wire, pixels, basis, shape=False)
        for column in (5, basis.fixed + 3, basis.size - 1):
            leaf = "baseline" if column < basis.fixed else "fields"
            place = tuple(basis.baseline[column] if leaf == "baseline" else basis.fields[column - basis.fixed])
            changed = np.array(getattr(wire, leaf))
            changed[place] += 1e-6
            other = eqx.tree_at(lambda w, name=leaf: getattr(w, name), wire, changed)
            there, base_there, _ = model_columns(other, pixels, basis, shape=False)
            np.testing.assert_allclose((there * base_there - whole * base) / 1e-6, design[column] * base, atol=1e-5)


def test_shape_vector_and_move_agree() -> None:
    wire = uneven_wire()
    steps = np.linspace(-0.02, 0.03, 10)
    with jax.enable_x64(True):
        moved = shape_vector(move(wire, steps))
    np.testing.assert_allclose(moved - shape_vector(wire), steps, atol=1e-12)


def test_variance_is_a_line_through_noisy_variances() -> None:
    rng = np.random.default_rng(1)
    values = rng.uniform(0.4, 1.6, (200, 300))
    true = 3.0 + 7.0 * 100 * values
    # Of four frames: three degrees of freedom; a few pixels blink.
    variance = true * rng.chisquare(3, values.shape) / 3
    variance[rng.random(values.shape) < 1e-3] *= 1e4
    noise = flat_noise(values, variance, np.full(4, 100.0), 0.0, np.inf)
    at = np.array([0.5, 1.0, 1.5, 1.0])
    np.testing.assert_allclose(noise.variance(np.arange(4), at), (3.0 + 700 * at) / 100**2, rtol=0.05)


def test_what_clips_by_the_model_and_what_is_off_are_left_out_and_listed() -> None:
    wire = ideal_wire(GEOMETRY, START, HARMONICS)
    pixels = even_pixels(wire, 1e-3, 2)
    value = pixels.value.copy()
    value[[5, 700]] *= 1.3
    clip = float(np.quantile(pixels.value, 0.9))
    pixels = eqx.tree_at(lambda p: p.value, pixels, value)
    noise = FlatNoise(np.full(4, 1e-6), np.zeros(4), 0.0, np.full(4, clip))
    with jax.enable_x64(True):
        found = judge(wire, np.ones(4), pixels, noise)
    outlying, clipped = listed(found, COLUMNS)
    assert outlying.count == 2
    # A row's samples begin further along than those of the row above.
    assert outlying.places == ("(0, 5)", "(5, 65)")
    assert clipped.count == pytest.approx(0.1 * ROWS * COLUMNS, rel=0.3)
    # The rule looks at what is expected, not at what noise made of it.
    assert np.all(found.expected[found.pixels.weight > 0] < clip)
    assert np.any(found.pixels.value[found.pixels.weight > 0] > found.expected[found.pixels.weight > 0].max())


def test_no_number_has_no_weight() -> None:
    values = np.ones((ROWS, COLUMNS))
    values[3, 4], values[5, 6] = np.nan, np.inf
    pixels = sample_pixels(values, np.full(values.shape, 1e-4), GEOMETRY, 1)
    assert pixels.used == values.size - 2
    assert np.isfinite(pixels.value).all()


def test_prior_and_data_meet_by_their_precisions() -> None:
    normal = Normal(np.diag([4.0, 1e-12]), np.array([8.0, 0.0]), 20.0, 100, np.zeros((1, 2)))
    step, cov = solve(normal, np.array([1.0, 1.0]), np.array([3.0, 2.0]), 1.0)
    # (8 - 3) / (4 + 1); what the data do not see goes back to the prior's centre, with the prior's sigma.
    np.testing.assert_allclose(step, [1.0, -2.0], rtol=1e-9)
    np.testing.assert_allclose(np.diag(cov), [0.2, 1.0], rtol=1e-9)
    prior = rig_prior(START)
    assert prior.sigma[7] == pytest.approx(0.04)


def test_choice_takes_back_what_only_counts_together() -> None:
    # Of two nearly equal columns each alone can go; without both the fit is poor.
    rng = np.random.default_rng(5)
    shared = rng.standard_normal(4000)
    design = np.stack([np.ones(4000), *(shared + 1e-3 * rng.standard_normal(4000) for _ in range(4))], axis=1)
    data = 0.5 + 0.5 * shared + rng.standard_normal(4000)
    chosen = select(design.T @ design, design.T @ data, float(data @ data), 4000, np.array([-1, 0, 1, 2, 3]))
    assert chosen.keep.sum() == 2
    assert chosen.keep[0]


def joint_of(wire: Wire, pixels: Pixels) -> Joint:
    judged = Judged(pixels, np.zeros(0), 0, np.zeros(0, dtype=bool))
    tiles = np.random.default_rng(0).standard_normal((48, 2)) * [1.0, 10.0]
    return Joint(wire, np.ones(4), plain_basis(), True, np.eye(2) / 48, 1.0, judged, (), True, 1, np.zeros(2), tiles)


@pytest.mark.parametrize(("pattern", "found"), [(0.0, False), (6e-3, True)])
def test_patterns_are_told_from_noise(pattern: float, found: bool) -> None:
    wire = ideal_wire(GEOMETRY, START, HARMONICS)
    pixels = even_pixels(wire, 4e-3, 3)
    with jax.enable_x64(True):
        slope = np.asarray(slopes(wire, pixels.ideal))[1]
        value = pixels.value * (1 + pattern * np.cos(4 * np.pi * 12.0 * slope))
        pixels = eqx.tree_at(lambda p: p.value, pixels, value)
        judged = judge(wire, np.ones(4), pixels, FlatNoise(np.full(4, 16e-6), np.zeros(4), 0.0, np.full(4, np.inf)))
        left = misfit(joint_of(wire, pixels), judged, 1e-5, held_out=True)
    assert left.found is found
    if found:
        assert left.sigma == pytest.approx(pattern / np.sqrt(2), rel=0.25)
    else:
        assert left.sigma == 0.0
        assert left.p_value > SIGNIFICANT


def test_tiles_that_differ_by_more_than_noise_widen_the_error() -> None:
    wire = ideal_wire(GEOMETRY, START, HARMONICS)
    ratio = robust_ratio(joint_of(wire, even_pixels(wire, 4e-3, 3)))
    assert ratio[0] < 1.4
    assert ratio[1] == pytest.approx(10.0, rel=0.3)


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_scan_finds_the_standoff_from_afar(factor: float) -> None:
    wire = ideal_wire(GEOMETRY, START, HARMONICS)
    pixels = even_pixels(wire, 4e-3, 4)
    wrong = replace(START, standoff_per_pitch=START.standoff_per_pitch * factor)
    with jax.enable_x64(True):
        bare = ideal_wire(GEOMETRY, wrong, HARMONICS)
        bare = eqx.tree_at(lambda w: w.fields, bare, np.zeros_like(bare.fields))
        places = scan_rows(bare, np.ones(4), wrong, rig_prior(wrong), pixels)
    assert float(places[0].wire.standoff_per_pitch) == pytest.approx(12.0, rel=0.02)
    assert places[0].gain > 1000
