"""A small profile with every kind of field: numbers, small and large arrays, orders, text, nested models."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from udccal.fitting.nominal import absent_backscatter, absent_psf, absent_wire, nominal_geometry
from udccal.fitting.wire.fit import sensor_map
from udccal.models.noise import Noise
from udccal.profiles.profile import Profile, build_profile
from udccal.profiles.provenance import provenance_now
from udccal.result import (
    Candidate,
    Captures,
    Diagnostic,
    Estimate,
    EstimatePrior,
    FitResult,
    FitStatus,
    Outliers,
    ResidualSample,
)
from udccal.rig import RigDescription, load_rig
from udccal.sessions.schema import StoredCamera


def fitted(
    name: str, term: object, estimates: tuple[Estimate, ...] = (), status: FitStatus = FitStatus.CONVERGED
) -> FitResult:
    """A fit's result with some of everything, its numbers awkward to print."""
    count = len(estimates)
    return FitResult(
        name=name,
        term=term,
        status=status,
        estimates=estimates,
        cov=np.diag([e.sigma**2 for e in estimates]) if count else np.zeros((0, 0)),
        chi2_dof=1.0 / 3.0,
        samples=12345,
        candidates=(Candidate("order 1", 3, -10.1, True), Candidate("order 2", 6, -9.7, False)),
        diagnostics=(Diagnostic("residual RMS", 0.1 + 0.2, "e-"),),
        notes=("One frame was left out.",),
        outliers=(Outliers("frames that differ", 3, ("flat 2", "flat 7")),),
        residuals=ResidualSample(np.array([[0.5, 2.0], [95.0, 63.0]]), np.array([-1.5, 0.25])),
        captures=Captures(
            sha256="cd" * 32,
            files=4,
            frames=60,
            gain_dB=(0.0, 6.0),
            completed_at=("2026-01-02T03:04:05+00:00", "2026-01-02T03:14:05+00:00"),
            steps=("ab" * 8, "cd" * 8),
        ),
        effort="quick",
    )


@pytest.fixture(scope="session")
def toy_rig() -> RigDescription:
    """The reduced rig with a tiny sensor."""
    rig = load_rig("lg55-reduced")
    camera = rig.camera.model_copy(update={"columns": 96, "rows": 64, "pitch_um": 69.0})
    panel = rig.panel.model_copy(update={"columns": 32, "rows": 24})
    view = rig.view.model_copy(update={"columns": 64, "rows": 36})
    return rig.model_copy(update={"camera": camera, "panel": panel, "view": view})


@pytest.fixture(scope="session")
def toy_profile(toy_rig: RigDescription) -> Profile:
    rng = np.random.default_rng(4)
    geometry = nominal_geometry(toy_rig)
    noise = Noise(*(float(v) for v in (0.355, 64.1, 3969.0, 4.7, 0.08, 0.2, 1.0, 12.0, 2.0, 0.005)))
    psf = absent_psf(toy_rig, geometry)
    # Big enough to go into an EXR file.
    residual = np.pad(rng.normal(0, 1e-6, (1, 3, 15, 15)), 0)
    residual[0, :, 7, 7] = 1.0
    estimates = (
        Estimate("K_DN_per_e", 0.355, 1e-3, "DN/e-"),
        Estimate("black_DN", 64.1, 0.1, "DN", EstimatePrior(64.0, 0.12)),
    )
    wire = absent_wire(toy_rig, geometry)
    return build_profile(
        toy_rig,
        provenance_now(None, StoredCamera(vendor="Basler", model="acA2040", serial="1", backend="simulated")),
        noise=fitted("noise", noise, estimates),
        geometry=fitted("geometry", geometry),
        wire=replace(fitted("wire", wire), map_sigma=np.full((1, 3, 4), 1e-4, np.float32)),
        psf=fitted("psf", type(psf)(**{**vars(psf), "residual": residual})),
        backscatter=fitted("backscatter", absent_backscatter(toy_rig, geometry), status=FitStatus.ABSENT),
        wire_map=sensor_map(wire, toy_rig.camera.rows, toy_rig.camera.columns),
        parent="ab" * 32,
    )
