"""Forecast sigmas against those of fits of simulated captures, at two designs each."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.toy_rigs import write_toy_rig
from udccal.benches.bench import simulated_bench, simulated_rig
from udccal.benches.capture import capture
from udccal.fitting.noise.data import read_noise
from udccal.fitting.noise.fit import fit_noise
from udccal.fitting.wire.data import read_wire
from udccal.fitting.wire.fit import fit_wire
from udccal.planning.noise import NoisePredictor
from udccal.planning.state import RigState, nominal_state
from udccal.planning.wire import WirePredictor
from udccal.reports.true_values import true_geometry
from udccal.rig import RigDescription, load_rig
from udccal.sessions.schema import TermName
from udccal.sessions.store import Session
from udccal.simulation.truth import draw_truth

_OFF = 0.15


def captured(rig: RigDescription, term: TermName, folder: Path) -> Session:
    with simulated_bench(simulated_rig(rig, 0)) as bench:
        capture(folder, bench, [term])
    return Session.open(folder)


def as_it_is(rig: RigDescription) -> RigState:
    """Return the state of the simulated rig, as its profile would give it."""
    truth = draw_truth(rig, 0)
    state = nominal_state(rig)
    noise = replace(state.noise, K_DN_per_e=truth.sensor.K_DN_per_e, PRNU1288=truth.sensor.PRNU1288)
    return replace(state, noise=noise, geometry=true_geometry(truth))


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> RigDescription:
    return load_rig(write_toy_rig(tmp_path_factory.mktemp("rig")))


@pytest.mark.medium
def test_the_gain_is_known_as_well_as_foretold(toy: RigDescription, tmp_path: Path) -> None:
    predictor, stated = NoisePredictor(as_it_is(toy)), []
    for levels in (6, 24):
        captures = toy.captures.model_copy(update={"noise_levels": levels, "noise_stack": 4})
        rig = toy.model_copy(update={"captures": captures})
        K = fit_noise(read_noise(captured(rig, "noise", tmp_path / str(levels)))).estimate("K_DN_per_e")
        stated.append(100 * K.sigma / K.value)
        assert predictor.sigma(captures) == pytest.approx(stated[-1], rel=_OFF)
    # A prediction that does not scale would miss one of them.
    assert stated[0] > 1.5 * stated[1]


@pytest.mark.medium
def test_a_quick_fit_of_the_wire_is_foretold_by_its_pixels(toy: RigDescription) -> None:
    state, size = nominal_state(toy), toy.camera.rows * toy.camera.columns
    full, quick = WirePredictor(state), WirePredictor(replace(state, wire_pixels=size // 9))
    assert quick.sigma(toy.captures) == pytest.approx(3 * full.sigma(toy.captures), rel=0.2)
    assert "more pixels would lower it" in full.limits(toy.captures).lowered_by
    assert "udccal fit takes more of the sensor's pixels" in quick.limits(toy.captures).lowered_by


@pytest.mark.slow
def test_the_wire_map_is_known_as_well_as_foretold(toy: RigDescription, tmp_path: Path) -> None:
    state, stated = as_it_is(toy), []
    predictor = WirePredictor(state)
    for flats in (2, 60):
        captures = toy.captures.model_copy(update={"flats": flats})
        session = captured(toy.model_copy(update={"captures": captures}), "wire", tmp_path / str(flats))
        fit = fit_wire(read_wire(session, state.noise, state.geometry))
        stated.append(next(item.value for item in fit.diagnostics if item.name == "wire_map_rms_sigma"))
        model = next(item.value for item in fit.diagnostics if item.name == "wire_map_model_sigma")
        assert np.sqrt(predictor.sigma(captures) ** 2 + model**2) == pytest.approx(stated[-1], rel=_OFF)
    assert stated[0] > 1.3 * stated[1]
