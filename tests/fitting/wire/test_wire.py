"""The wire fit against the simulator's exact areas on a small sensor, with shot noise, PRNU and hot pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest

from udccal.cameras.protocol import CameraIdentity, Region, Settings
from udccal.fitting.noise.fit import nominal_noise
from udccal.fitting.wire.data import WireData, read_wire
from udccal.fitting.wire.fit import fit_wire, select, sensor_map
from udccal.fitting.wire.parameters import WireStart, wire_start
from udccal.models.geometry import Geometry
from udccal.models.wire import Wire, wire_map, wire_values
from udccal.result import FitResult, FitStatus
from udccal.rig import load_rig
from udccal.sessions.captured import AveragedFrames
from udccal.sessions.schema import DarkSubject, FlatSubject
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter
from udccal.simulation.truth import draw_truth
from udccal.simulation.wire import wire_map as true_wire_map

ROWS, COLUMNS = 192, 256
PRNU = 0.005


@dataclass(frozen=True)
class Bench:
    truth: np.ndarray
    geometry: Geometry
    start: WireStart
    standoff_per_pitch: float


@pytest.fixture(scope="module")
def bench() -> Bench:
    rig = load_rig("lg55-reduced")
    camera = rig.camera.model_copy(update={"rows": ROWS, "columns": COLUMNS, "pitch_um": 13.8})
    # A quarter of the sensor: rows of the panel are 12 to 22 px apart.
    rig = rig.model_copy(update={"camera": camera})
    truth = draw_truth(rig, 2)
    optics = truth.optics
    tilt = np.array(optics.R_panel_camera)
    angle = np.arccos((np.trace(tilt) - 1) / 2)
    axis = np.array([tilt[2, 1] - tilt[1, 2], tilt[0, 2] - tilt[2, 0], tilt[1, 0] - tilt[0, 1]])
    geometry = Geometry(
        focal_px=np.array([optics.fx_px, optics.fy_px]),
        principal_point_px=np.array([optics.cx_px, optics.cy_px]),
        distortion=np.array(optics.distortion),
        rotation_rad=axis / (2 * np.sin(angle)) * angle + np.array([5e-4, -3e-4, 4e-4]),
        pupil_mm=np.array([605.0, 189.0, -rig.mounting.standoff_mm.value]),
    )
    # The opening seen by oblique rays lies half the structure's depth further on.
    depth = truth.panel.depth_mm
    return Bench(
        truth=true_wire_map(truth),
        geometry=geometry,
        start=wire_start(rig),
        standoff_per_pitch=(depth / 2 - float(optics.pupil_mm[2])) / truth.panel.pitch_mm,
    )


def flat_of(truth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    level = 2000.0 * truth * np.tile([[0.7, 1.0], [1.0, 0.6]], (ROWS // 2, COLUMNS // 2))
    variance = level * 0.35 / 200
    response = 1 + PRNU * rng.standard_normal(truth.shape)
    signal = level * response + np.sqrt(variance) * rng.standard_normal(truth.shape)
    signal[rng.random(truth.shape) < 1e-4] *= 1.5
    return signal, variance


def fit_of(bench: Bench, signal: np.ndarray, variance: np.ndarray) -> FitResult[Wire]:
    return fit_wire(WireData(signal, variance, bench.geometry, bench.start, PRNU))


@pytest.fixture(scope="module")
def fitted(bench: Bench) -> FitResult[Wire]:
    return fit_of(bench, *flat_of(bench.truth, 1))


@pytest.mark.medium
def test_map_is_better_than_the_average_it_came_from(bench: Bench, fitted: FitResult[Wire]) -> None:
    found = np.asarray(wire_map(fitted.or_raise().term, ROWS, COLUMNS))
    error = float(np.sqrt(np.mean((found - bench.truth) ** 2)))
    # 49 thousand pixels of 0.5 % noise allow 0.02 to 0.03 % for some 70 parameters.
    assert error < 5e-4
    assert found.mean() == pytest.approx(1.0, abs=2e-4)
    assert np.ptp(bench.truth) > 0.3


@pytest.mark.medium
def test_shape_errors_are_as_large_as_claimed(bench: Bench, fitted: FitResult[Wire]) -> None:
    standoff = fitted.estimate("standoff_per_pitch")
    assert abs(standoff.value - bench.standoff_per_pitch) < 5 * standoff.sigma + 0.002
    assert standoff.sigma < 0.05
    assert 0.9 < fitted.chi2_dof < 1.1
    assert any(c.chosen for c in fitted.candidates)


@pytest.mark.medium
def test_every_fitted_element_of_the_term_is_an_estimate(fitted: FitResult[Wire]) -> None:
    """With its sigma and its place in the covariance: the posterior's own terms scatter by as much."""
    assert fitted.posterior is not None
    assert fitted.cov.shape == (len(fitted.estimates),) * 2
    elements = [one for one in fitted.estimates if "." in one.name]
    assert len(elements) >= 15
    assert len(fitted.numbers) == 10
    draws = fitted.posterior.draws(np.random.default_rng(3), 400)

    def element(term: Wire, name: str) -> float:
        array, *place = name.split(".")
        return float(np.asarray(getattr(term, array))[tuple(map(int, place))])

    for one in elements[:3] + elements[-8:]:
        assert one.value == pytest.approx(element(fitted.term, one.name), abs=1e-12), one.name
        scatter = np.std([element(draw, one.name) for draw in draws])
        assert scatter == pytest.approx(one.sigma, rel=0.15), one.name


@pytest.mark.medium
def test_the_map_of_sigma_is_the_posteriors(fitted: FitResult[Wire]) -> None:
    assert fitted.map_sigma is not None
    assert fitted.map_sigma.shape == (1, 16, 16)
    every = fitted.sigma_of(lambda wire: np.asarray(wire_map(wire, ROWS, COLUMNS)))
    cells = every.reshape(16, ROWS // 16, 16, COLUMNS // 16).swapaxes(1, 2).reshape(16, 16, -1)
    np.testing.assert_allclose(fitted.map_sigma[0], np.sqrt(np.mean(cells**2, axis=2)), rtol=0.3)
    stated = next(d.value for d in fitted.diagnostics if d.name == "wire_map_rms_sigma")
    assert 100 * float(np.sqrt(np.mean(fitted.map_sigma**2))) == pytest.approx(stated, rel=1e-5)


@pytest.mark.medium
def test_estimates_say_what_was_known_before(fitted: FitResult[Wire]) -> None:
    opening = fitted.estimate("row_open")
    assert opening.prior is not None
    assert (opening.prior.value, opening.prior.sigma) == pytest.approx((0.40, 0.04))
    assert not opening.by_prior
    assert fitted.estimate("offset_x_periods").prior is None


@pytest.mark.medium
def test_hot_pixels_are_left_out_and_listed(bench: Bench, fitted: FitResult[Wire]) -> None:
    left_out = next(d.value for d in fitted.diagnostics if d.name == "pixels_left_out")
    signal, _ = flat_of(bench.truth, 1)
    local = signal / (2000.0 * bench.truth * np.tile([[0.7, 1.0], [1.0, 0.6]], (ROWS // 2, COLUMNS // 2)))
    hot = {f"({y}, {x})" for y, x in np.argwhere(local > 1.2)}
    (outliers,) = fitted.outliers
    assert outliers.count == left_out
    assert hot
    assert hot <= set(outliers.places)
    assert "robust sigma" in outliers.rule


@pytest.mark.medium
def test_the_maps_sigma_covers_the_truth(bench: Bench, fitted: FitResult[Wire]) -> None:
    found = sensor_map(fitted.term, ROWS, COLUMNS)
    y, x = np.divmod(np.random.default_rng(3).choice(found.size, 1000, replace=False), COLUMNS)
    pixels = np.stack([x, y], axis=-1).astype(np.float64)
    values_at = jax.jit(lambda wire: wire_values(wire, pixels, ROWS, COLUMNS))
    sigma = fitted.sigma_of(values_at)
    # The diagnostic says the same of the whole map.
    stated = next(d.value for d in fitted.diagnostics if d.name == "wire_map_rms_sigma")
    assert 100 * np.sqrt(np.mean(sigma**2)) == pytest.approx(stated, rel=0.1)
    error = (found - bench.truth)[y, x]
    assert np.mean(np.abs(error) < 1.96 * sigma) >= 0.85
    # And it is no idle bound.
    assert np.sqrt(np.mean(error**2)) > 0.4 * np.sqrt(np.mean(sigma**2))
    assert sigma.max() < 2e-3


@pytest.mark.medium
def test_columns_of_unequal_gain_are_told_and_in_the_maps_sigma(bench: Bench, fitted: FitResult[Wire]) -> None:
    truth = bench.truth * (1 + 4e-3 * np.random.default_rng(5).standard_normal((1, COLUMNS)))
    uneven = fit_of(bench, *flat_of(truth, 1))
    assert any("Columns or rows of the sensor differ by 0." in note for note in uneven.notes)
    assert not any("Columns or rows" in note for note in fitted.notes)
    error = 100 * np.sqrt(np.mean((sensor_map(uneven.term, ROWS, COLUMNS) - truth / truth.mean()) ** 2))
    stated = uneven.diagnostic("wire_map_rms_sigma")
    assert stated == pytest.approx(error, rel=0.3)
    # What columns share moves the openings, by what their sigmas say.
    for name in ("column_open", "depth_per_pitch", "standoff_per_pitch"):
        one, even = uneven.estimate(name), fitted.estimate(name)
        assert abs(one.value - even.value) < 3 * one.sigma, name
    assert uneven.estimate("column_open").sigma > 1.5 * fitted.estimate("column_open").sigma


@pytest.mark.medium
def test_openings_that_are_no_rectangles_are_told(bench: Bench, fitted: FitResult[Wire]) -> None:
    """The map keeps what the harmonics are; numbers of the openings get a note."""
    term, told = fitted.term, "stronger or weaker than rectangular openings make them"
    second = int(np.flatnonzero((np.asarray(term.harmonics) == [0, 2]).all(axis=1))[0])
    fields = np.asarray(term.fields).copy()
    fields[second, 0, 0, 0] += 0.6
    truth = sensor_map(replace(term, fields=fields), ROWS, COLUMNS)
    result = fit_of(bench, *flat_of(truth / truth.mean(), 1))
    assert any(told in note for note in result.notes)
    assert np.std(sensor_map(result.or_raise().term, ROWS, COLUMNS) / truth * truth.mean()) < 6e-4
    assert not any(told in note for note in fitted.notes)


@pytest.mark.medium
def test_the_error_by_the_dark_level_is_stated(bench: Bench) -> None:
    """The map that a dark level of 1 % of the light makes is off by what is stated of it."""
    signal, variance = flat_of(bench.truth, 1)
    off, sites = 10.0, np.array([1400.0, 2000.0, 2000.0, 1200.0])
    data = WireData(signal + off, variance, bench.geometry, bench.start, 0.005, dark_sigma=off)
    result = fit_wire(data)
    error = sensor_map(result.or_raise().term, *signal.shape) / bench.truth - 1
    by_dark = off * np.mean(1 / sites) * np.std(1 / bench.truth)
    assert result.diagnostic("map_sigma_by_dark_level") == pytest.approx(100 * by_dark, rel=0.1)
    assert np.std(error) == pytest.approx(by_dark, rel=0.3)
    # With a level that is taken for exact, the error is silent.
    exact = fit_wire(replace(data, dark_sigma=0.0))
    assert result.diagnostic("wire_map_rms_sigma") > 0.8 * 100 * np.std(error)
    assert exact.diagnostic("wire_map_rms_sigma") < 0.5 * 100 * np.std(error)


@pytest.mark.medium
def test_no_panel_is_absent(bench: Bench) -> None:
    y, x = np.mgrid[:ROWS, :COLUMNS]
    shading = 1 - 0.2 * ((x / COLUMNS - 0.5) ** 2 + (y / ROWS - 0.5) ** 2)
    signal, variance = flat_of(shading / shading.mean(), 3)
    result = fit_of(bench, signal, variance)
    assert result.status is FitStatus.ABSENT
    assert result.ok
    found = np.asarray(wire_map(result.term, ROWS, COLUMNS))
    assert np.sqrt(np.mean((found - shading / shading.mean()) ** 2)) < 5e-4


@pytest.mark.parametrize("level", [0.0, -3.0])
def test_no_light_is_too_dark(bench: Bench, level: float) -> None:
    rng = np.random.default_rng(0)
    signal = level + 0.1 * rng.standard_normal((ROWS, COLUMNS))
    result = fit_of(bench, signal, np.full((ROWS, COLUMNS), 0.01))
    assert result.status is FitStatus.TOO_DARK


@pytest.mark.parametrize(("share", "status"), [(0.3, FitStatus.SATURATED), (0.0, FitStatus.TOO_DARK)])
def test_session_with_a_bad_flat(tmp_path: Path, bench: Bench, share: float, status: FitStatus) -> None:
    rig = load_rig("lg55-reduced")
    shape = (96, 128)
    rng = np.random.default_rng(0)
    dark = (60 + rng.random(shape)).astype(np.float32)
    flat = np.where(rng.random(shape) < share, np.float32(3890), dark[::-1])
    writer = SessionWriter.create(tmp_path / "s", rig, CameraIdentity("maker", "model", "1", "test"))
    settings = Settings(0.01, 0.0, Region(0, 0, shape[1], shape[0]))
    for step, subject, mean in (("dark", DarkSubject(), dark), ("flat", FlatSubject(), flat)):
        average = AveragedFrames(mean, np.ones(shape, np.float32), 4, settings, 0.0, 1.0)
        writer.add_step(f"wire/{step}", "wire", subject, [average])
    noise = eqx.tree_at(lambda n: n.saturation_DN, nominal_noise(rig), 3891.0)
    assert fit_wire(read_wire(Session.open(tmp_path / "s"), noise, bench.geometry)).status is status


def test_selection_keeps_what_matters_and_drops_what_does_not() -> None:
    rng = np.random.default_rng(4)
    design = rng.standard_normal((5000, 12))
    true = np.array([1.0, 0.5, 0.3, 0.2, 0, 0, 0, 0, 0.1, 0.1, 0, 0])
    data = design @ true + rng.standard_normal(5000)
    groups = np.array([-1, -1, 0, 0, 1, 1, 2, 2, 3, 3, 4, 4])
    chosen = select(design.T @ design, design.T @ data, float(data @ data), 5000, groups).best.fit
    assert set(groups[chosen.keep]) == {-1, 0, 3}
    assert np.all(chosen.values[~chosen.keep] == 0)
    assert np.sum((data - design @ chosen.values) ** 2) / 5000 == pytest.approx(1.0, abs=0.08)
