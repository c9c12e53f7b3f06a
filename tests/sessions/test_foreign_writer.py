"""A session by another program, written after docs/session.md and nothing else, is read and fits."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from udccal.sessions.store import Session

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    folder = tmp_path_factory.mktemp("foreign") / "session"
    # A process of its own, which ends with an error if anything of udccal was imported.
    subprocess.run(
        [sys.executable, "-m", "tests.sessions.foreign_writer", str(folder)], check=True, cwd=HERE.parents[1]
    )
    return Session.open(folder)


@pytest.fixture(scope="module")
def world() -> dict:
    return runpy.run_path(str(HERE / "foreign_world.py"))


@pytest.mark.medium
def test_every_file_of_it_is_accepted(session: Session) -> None:
    for step in session.manifest.steps:
        for capture in step.captures:
            _ = session.frame(capture) if capture.kind == "frame" else session.average(capture)
        if step.subject.kind == "panel":
            assert session.picture(step.subject).shape == (90, 160, 3)
    assert {step.term for step in session.manifest.steps} == {"noise", "geometry", "wire", "psf", "backscatter"}


@pytest.mark.medium
def test_its_numbers_mean_what_the_page_says(session: Session, world: dict) -> None:
    (flat,) = session.step("wire/flat").captures
    (dark,) = session.step("wire/dark").captures
    electrons = (session.average(flat).mean - session.average(dark).mean) / world["K_DN_PER_E"]
    expected = world["flat_rate"]() * flat.exposure_s
    assert np.std(electrons / expected - 1) < 0.02  # shot noise of 40 frames and PRNU


@pytest.mark.slow
def test_it_fits(session: Session, world: dict) -> None:
    from udccal.calibration import calibrate
    from udccal.models.psf import psf_kernels
    from udccal.models.wire import wire_map

    results = calibrate(session, lambda *_: None)
    for term in ("noise", "geometry", "wire", "psf", "backscatter"):
        found = results.result(term)
        assert found.ok, (term, found.status, found.notes)
    noise = results.noise
    assert noise.estimate("K_DN_per_e").value == pytest.approx(world["K_DN_PER_E"], rel=0.02)
    assert noise.estimate("PRNU1288").value == pytest.approx(world["PRNU"], rel=0.1)
    focal = np.asarray(results.geometry.term.focal_px)
    np.testing.assert_allclose(focal, world["FOCAL_PX"], rtol=2e-3)
    rows, columns = world["ROWS"], world["COLUMNS"]
    wire = np.asarray(wire_map(results.wire.term, rows, columns))
    assert np.sqrt(np.mean((wire / world["wire"]() - 1) ** 2)) < 2e-3
    position = np.array([[250.0, 120.0]])
    kernel = np.asarray(psf_kernels(results.psf.term, position, 61, 41))[0]
    truth = world["psf"](250.0, 120.0)[90:151, 230:271].transpose(2, 0, 1)
    truth = truth / truth.sum(axis=(1, 2), keepdims=True)
    assert np.linalg.norm(kernel - truth) / np.linalg.norm(truth) < 0.05
