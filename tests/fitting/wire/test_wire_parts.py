"""The parts of the wire fit: slopes, weights, prior, choice of columns, search, and the test for patterns."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.scenes import wire as drawn
from udccal.cfa import cfa_named
from udccal.fitting.engine.least_squares import SolverRules, minimise
from udccal.fitting.wire.data import FlatNoise, Pixels, Weighed, WireData, flat_noise, sample_pixels, weighed
from udccal.fitting.wire.fit import select
from udccal.fitting.wire.jacobian import WireProblem, block_jacobian, expected_of, wire_derivatives
from udccal.fitting.wire.parameters import (
    Kind,
    WireRules,
    WireStart,
    ideal_wire,
    parameters_of,
    possible_harmonics,
    shape_sigma,
    shape_vector,
    with_shape,
)
from udccal.fitting.wire.residuals import Misfits, misfit, misfits
from udccal.fitting.wire.search import Descent, Search, scan_rows
from udccal.models.geometry import Geometry
from udccal.models.wire import Wire, log_baseline, modulation, slopes

ROWS, COLUMNS = 96, 128
HARMONICS = np.array([[0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [-1.0, 2.0], [0.0, 3.0]])
RULES = WireRules()
START = WireStart(12.0, 0.03, 3.0, 0.04, 0.4, 0.02, 0.9, 0.01, 0.05, 0.01)
GEOMETRY = Geometry(
    focal_px=np.array([120.0, 120.0]),
    principal_point_px=np.array([63.0, 48.5]),
    distortion=np.array([-0.05, 0.01, 0.0, 0.0, 0.0]),
    rotation_rad=np.array([-0.3, 0.01, 0.02]),
    pupil_mm=np.array([60.0, 30.0, -7.5]),
)


def uneven_wire(seed: int = 0) -> Wire:
    rng = np.random.default_rng(seed)
    wire = ideal_wire(GEOMETRY, START, HARMONICS)
    return eqx.tree_at(
        lambda w: (w.fields, w.baseline, w.amplitudes, w.rotation_rad, w.frequency),
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
    blank = sample_pixels(np.ones((ROWS, COLUMNS)), GEOMETRY, ROWS * COLUMNS, "RGGB")
    with jax.enable_x64(True):
        expected = expected_of(wire, np.ones(4), blank)
    value = expected + noise * np.random.default_rng(seed).standard_normal(len(expected))
    return eqx.tree_at(lambda p: (p.value, p.weight), blank, (value, blank.weight / noise**2))


def judge(wire: Wire, pixels: Pixels, noise: FlatNoise) -> Weighed:
    with jax.enable_x64(True):
        return weighed(pixels, expected_of(wire, np.ones(4), pixels), noise)


@pytest.mark.medium
def test_slopes_are_those_of_the_model() -> None:
    wire = uneven_wire()
    pixels = sample_pixels(np.ones((ROWS, COLUMNS)), GEOMETRY, 40, "RGGB")

    @jax.jit
    @jax.jacfwd
    def by_shape(steps: jax.Array) -> jax.Array:
        moved = with_shape(wire, shape_vector(wire) + steps)
        slope = slopes(moved, pixels.ideal)
        return jnp.exp(log_baseline(moved, pixels.scaled, slope)) * (1 + modulation(moved, slope, pixels.scaled))

    with jax.enable_x64(True):
        expected = np.asarray(by_shape(jnp.zeros(10)))
        _, base, found = wire_derivatives(wire, pixels)
        shape = (found * base).T
    # Sums over harmonics are in single precision.
    assert (np.abs(shape - expected).max(axis=0) <= 1e-4 * np.abs(expected).max(axis=0)).all()
    assert np.all(np.abs(expected).max(axis=0) > 1e-3)


@pytest.mark.medium
def test_columns_of_linear_coefficients_are_differences_of_the_map() -> None:
    wire = uneven_wire()
    pixels = sample_pixels(np.ones((ROWS, COLUMNS)), GEOMETRY, 40, "RGGB")
    with jax.enable_x64(True):
        parameters = parameters_of(wire, RULES, 4, np.full(len(HARMONICS), 1e-2))
        x = parameters.vector(wire, np.array([1.2, 0.9, 1.1, 1 / (1.2 * 0.9 * 1.1)]))
        base, design = block_jacobian(parameters, parameters.wire(x), pixels)[1:]
        level = base * parameters.gains(x)[pixels.site]
        # Shading, a site's gain, an amplitude, two corrections to the pupil.
        for column in (5, 46, 60, parameters.linear - 3, parameters.linear - 1):
            step, wanted = 1e-2 * (np.arange(len(x)) == column), design[column] * level
            less, more = (expected_of(parameters.wire(p), parameters.gains(p), pixels) for p in (x - step, x + step))
            np.testing.assert_allclose((more - less) / 2e-2, wanted, atol=2e-3 * np.abs(wanted).max())


def test_a_vector_of_parameters_makes_the_wire_that_it_was_read_from() -> None:
    wire = uneven_wire()
    # Polynomials have a total degree.
    low = [np.add.outer(np.arange(n), np.arange(n)) < n for n in (9, 4)]
    wire = eqx.tree_at(lambda w: (w.baseline, w.amplitudes), wire, (wire.baseline * low[0], wire.amplitudes * low[1]))
    with jax.enable_x64(True):
        parameters = parameters_of(wire, RULES, 4, np.full(len(HARMONICS), 1e-2))
        x = parameters.vector(wire, np.ones(4))
        fewer = parameters.kept(parameters.groups < 0)
        back, bare = parameters.wire(x), fewer.wire(fewer.vector(wire, np.ones(4)))
    for before, after in zip(jax.tree.leaves(wire), jax.tree.leaves(back), strict=True):
        np.testing.assert_allclose(after, before, atol=1e-12)
    # What is dropped is nothing.
    assert bare.baseline[0, 5] == 0.0
    assert not bare.amplitudes.any()


def test_a_joint_fit_converges_from_afar() -> None:
    # 43 of its sigma away: more steps than a fixed number of rounds would have allowed.
    built, lens = drawn.start(), drawn.geometry()
    truth = drawn.drawn_truth(5, built, lens)
    flat = drawn.noisy(truth, 5)
    values = flat.signal / np.tile(drawn.ELECTRONS * drawn.SITES, (drawn.ROWS // 2, drawn.COLUMNS // 2))
    line = FlatNoise(np.zeros(4), 1 / (drawn.ELECTRONS * drawn.SITES.ravel()), drawn.PRNU, np.full(4, np.inf))
    with jax.enable_x64(True):
        pixels = sample_pixels(values, lens, values.size, "RGGB")
        pixels = weighed(pixels, expected_of(truth, np.ones(4), pixels), line).pixels
        parameters = parameters_of(truth, RULES, 4)
        problem = WireProblem("afar", parameters, pixels, parameters.prior(built, RULES))
        near = minimise(problem, parameters.vector(truth, np.ones(4)))
        sigma = np.sqrt(np.diag(near.equations.cov()))
        far = minimise(problem, near.place + 43 * sigma * (np.arange(len(sigma)) == parameters.linear + 3))
    assert near.converged
    assert far.converged
    assert np.abs((far.place - near.place) / sigma).max() < 0.05


@pytest.mark.parametrize("cfa", ["RGGB", "mono"])
def test_variance_is_a_line_through_noisy_variances(cfa: str) -> None:
    rng = np.random.default_rng(1)
    values = rng.uniform(0.4, 1.6, (200, 300))
    true = 3.0 + 7.0 * 100 * values
    # Of four frames: three degrees of freedom; a few pixels blink.
    variance = true * rng.chisquare(3, values.shape) / 3
    variance[rng.random(values.shape) < 1e-3] *= 1e4
    sites = len(cfa_named(cfa).sites)
    noise = flat_noise(WireData(100 * values, variance, GEOMETRY, START, 0.0, cfa=cfa))
    at = np.array([0.5, 1.0, 1.5, 1.0])[:sites]
    np.testing.assert_allclose(noise.variance(np.arange(sites), at), (3.0 + 700 * at) / 100**2, rtol=0.05)


def test_what_clips_by_the_model_and_what_is_off_are_left_out_and_listed() -> None:
    wire = ideal_wire(GEOMETRY, START, HARMONICS)
    pixels = even_pixels(wire, 1e-3, 2)
    value = pixels.value.copy()
    value[[5, 700]] *= 1.3
    clip = float(np.quantile(pixels.value, 0.9))
    pixels = eqx.tree_at(lambda p: p.value, pixels, value)
    noise = FlatNoise(np.full(4, 1e-6), np.zeros(4), 0.0, np.full(4, clip))
    found = judge(wire, pixels, noise)
    outlying, clipped = found.outliers(COLUMNS)
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
    pixels = sample_pixels(values, GEOMETRY, values.size, "RGGB")
    assert pixels.used == values.size - 2
    assert np.isfinite(pixels.value).all()


def test_the_prior_is_the_rig_description_widened() -> None:
    sigma = shape_sigma(START, RULES)
    assert sigma[3:] == pytest.approx([0.06, 1.0, 1.0, 0.08, 0.04, 0.02, 0.02])
    with jax.enable_x64(True):
        parameters = parameters_of(ideal_wire(GEOMETRY, START, HARMONICS), RULES, 4, np.full(len(HARMONICS), 1e-2))
        prior = parameters.prior(START, RULES)
        built = parameters.vector(ideal_wire(GEOMETRY, START, HARMONICS), np.ones(4))
    assert prior.cost(built) == 0.0
    assert prior.root.any(axis=0).sum() == parameters.of(Kind.FIELD).sum() + 10


def test_harmonics_are_split_by_their_size() -> None:
    fitted, left_out = possible_harmonics(START), possible_harmonics(START, 1e-6, RULES.least_amplitude)
    assert fitted.bounds.min() >= RULES.least_amplitude > left_out.bounds.max()
    assert (np.diff(fitted.bounds) <= 0).all()
    orders = {tuple(order) for order in (*fitted.orders, *left_out.orders)}
    assert len(orders) == len(fitted.orders) + len(left_out.orders)
    # A harmonic and its negative are one.
    assert not any((-n, -m) in orders for n, m in orders)


def test_choice_takes_back_what_only_counts_together() -> None:
    # Of two nearly equal columns each alone can go; without both the fit is poor.
    rng = np.random.default_rng(5)
    shared = rng.standard_normal(4000)
    design = np.stack([np.ones(4000), *(shared + 1e-3 * rng.standard_normal(4000) for _ in range(4))], axis=1)
    data = 0.5 + 0.5 * shared + rng.standard_normal(4000)
    chosen = select(design.T @ design, design.T @ data, float(data @ data), 4000, np.array([-1, 0, 1, 2, 3])).best.fit
    assert chosen.keep.sum() == 2
    assert chosen.keep[0]


@pytest.mark.parametrize(("pattern", "found"), [(0.0, False), (6e-3, True)])
def test_patterns_are_told_from_noise(pattern: float, found: bool) -> None:
    wire = ideal_wire(GEOMETRY, START, HARMONICS)
    pixels = even_pixels(wire, 4e-3, 3)
    with jax.enable_x64(True):
        slope = np.asarray(slopes(wire, pixels.ideal))[1]
        value = pixels.value * (1 + pattern * np.cos(4 * np.pi * 12.0 * slope))
        pixels = eqx.tree_at(lambda p: p.value, pixels, value)
        judged = judge(wire, pixels, FlatNoise(np.full(4, 16e-6), np.zeros(4), 0.0, np.full(4, np.inf)))
        left = misfit(judged, wire, 1e-5, held_out=True)
    assert left.test.found is found
    if found:
        assert left.sigma == pytest.approx(pattern / np.sqrt(2), rel=0.25)
    else:
        assert left.sigma == 0.0
        assert left.test.p_value > 1e-3


def misfits_with(structure: np.ndarray, variance: float = 1.0) -> Misfits:
    """What residuals of the ideal map show where the sensor's response has this structure besides noise of 0.4 %."""
    wire = ideal_wire(GEOMETRY, START, HARMONICS)
    pixels = even_pixels(wire, 4e-3, 5)
    y, x = np.divmod(pixels.place, COLUMNS)
    pixels = eqx.tree_at(lambda p: p.value, pixels, pixels.value * (1 + structure[y, x]))
    judged = judge(wire, pixels, FlatNoise(np.full(4, 16e-6), np.zeros(4), 0.0, np.full(4, np.inf)))
    with jax.enable_x64(True):
        return misfits(judged, wire, 1e-5, True, variance, RULES)


@pytest.mark.parametrize(
    ("rows", "columns"), [(0.0, 3e-3), (3e-3, 0.0), (2e-3, 2e-3)], ids=["columns", "rows", "columns and rows"]
)
def test_lines_of_the_sensor_that_differ_are_part_of_the_model_error(rows: float, columns: float) -> None:
    rng = np.random.default_rng(6)
    lines = rows * rng.standard_normal((ROWS, 1)) + columns * rng.standard_normal((1, COLUMNS))
    found = misfits_with(lines)
    assert found.lines.test.found
    assert found.lines.sigma == pytest.approx(np.hypot(rows, columns), rel=0.25)
    assert found.sigma >= found.lines.sigma
    assert found.excess == 0


def test_a_spot_of_few_pixels_is_found_at_its_place_and_size() -> None:
    """A sum over the sensor's tiles did not show it: an edge, a ring and a blob of 0.3 to 0.5 % went unsaid."""
    structure = np.zeros((ROWS, COLUMNS))
    structure[75:95, 110:140] = -1e-2
    found = misfits_with(structure)
    assert found.spots.test.found
    assert not found.lines.test.found
    assert (COLUMNS * found.spot.across, ROWS * found.spot.down) == pytest.approx((125, 85), abs=16)
    assert found.spot.off == pytest.approx(-1e-2, rel=0.4)
    assert found.sigma == pytest.approx(1e-2 * np.sqrt(600 / structure.size), rel=0.6)


def test_the_edge_of_a_shadow_is_found_though_no_part_stands_out() -> None:
    y, x = np.mgrid[:ROWS, :COLUMNS]
    edge = 4e-3 * np.sign(x + y - 130) * np.exp(-np.abs(x + y - 130) / 15)
    found = misfits_with(edge)
    assert found.spots.test.found
    assert found.spots.sigma == pytest.approx(float(np.std(edge)), rel=0.4)


@pytest.mark.parametrize("seed", range(8))
def test_noise_shows_no_spots(seed: int) -> None:
    # White, and less than the noise that is expected: no part of it is a spot.
    assert not misfits_with(1e-3 * np.random.default_rng(seed).standard_normal((ROWS, COLUMNS))).spots.test.found


def test_noise_shows_no_lines() -> None:
    found = misfits_with(np.zeros((ROWS, COLUMNS)))
    assert not found.found
    assert found.sigma == 0


def test_residuals_of_a_poor_fit_are_all_in_the_model_error() -> None:
    # Neither the panel's period nor lines explain this.
    blotches = 8e-3 * np.random.default_rng(7).standard_normal((ROWS, COLUMNS))
    assert misfits_with(blotches, 4.0).sigma == pytest.approx(8e-3, rel=0.1)


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_scan_finds_the_standoff_from_afar(factor: float) -> None:
    wire = ideal_wire(GEOMETRY, START, HARMONICS)
    pixels = even_pixels(wire, 4e-3, 4)
    wrong = replace(START, standoff_per_pitch=START.standoff_per_pitch * factor)
    with jax.enable_x64(True):
        bare = ideal_wire(GEOMETRY, wrong, HARMONICS)
        bare = eqx.tree_at(lambda w: w.fields, bare, np.zeros_like(bare.fields))
        places, gain = scan_rows(bare, np.ones(4), wrong, pixels, RULES)
    assert float(places[0].standoff_per_pitch) == pytest.approx(12.0, rel=0.02)
    assert gain > 1000


def blank_search() -> Search:
    """A search that is given its pixels by hand."""
    noise, flat = FlatNoise(np.zeros(4), np.full(4, 1.6e-5), 0.0, np.full(4, np.inf)), np.ones((ROWS, COLUMNS))
    return Search(WireData(flat, 1.6e-5 * flat, GEOMETRY, START, 0.0, cfa="RGGB"), noise, RULES)


def test_a_footprint_that_was_tried_at_another_standoff_is_tried_again() -> None:
    wire, search = ideal_wire(GEOMETRY, START, HARMONICS), blank_search()
    pixels, bare = even_pixels(wire, 4e-3, 4), replace(wire, fields=0.0 * wire.fields)
    with jax.enable_x64(True):

        def at(standoff: float, footprint: float) -> Descent:
            lengths = {"standoff_per_pitch": np.float64(standoff), "footprint_per_pitch": np.float64(footprint)}
            return search._descent(replace(wire, **lengths), np.ones(4), pixels, SolverRules(iterations=0))

        for other, beside in ((at(13.5, 4.0), [2.0, 4.0]), (at(12.02, 4.0), [2.0])):
            places = search._beside([at(12.0, 3.0), other], [], bare, np.ones(4), pixels)
            assert [float(one.footprint_per_pitch) for one in places] == pytest.approx(beside)
            assert all(float(one.standoff_per_pitch) == pytest.approx(12.0) for one in places)


def test_a_search_ends_where_descents_leave_the_places_they_began_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every descent ends at a footprint of 3 periods; 2 and 4 are tried once."""
    wire, begun, search = ideal_wire(GEOMETRY, START, HARMONICS), list[float](), blank_search()
    pixels = even_pixels(wire, 4e-3, 4)
    with jax.enable_x64(True):
        ended = search._descent(wire, np.ones(4), pixels)

        def begin(self: Search, place: Wire, *others: object) -> Descent:
            begun.append(float(place.footprint_per_pitch))
            assert len(begun) < 10
            return ended

        monkeypatch.setattr(Search, "_begun", begin)
        found = search._search([replace(wire, fields=0.0 * wire.fields)], np.ones(4), HARMONICS, pixels)
    assert begun == pytest.approx([3.0, 2.0, 4.0], abs=0.2)
    assert float(found[0].wire.footprint_per_pitch) == pytest.approx(3.0, abs=0.2)
