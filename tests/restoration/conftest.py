"""The toy rig that tests and benchmarks share, and a profile of a smaller one with every term."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes import toy_restorer
from udccal.fitting.nominal import absent_backscatter, absent_psf, absent_wire, nominal_geometry
from udccal.fitting.wire.fit import sensor_map
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.profiles.profile import Profile, build_profile
from udccal.profiles.provenance import provenance_now
from udccal.restoration.kernel_grid import KernelGrid
from udccal.rig import RigDescription


@pytest.fixture(scope="session")
def toy_rig() -> RigDescription:
    return toy_restorer.rig()


@pytest.fixture(scope="session")
def toy_noise() -> Noise:
    return toy_restorer.NOISE


@pytest.fixture(scope="session")
def toy_geometry() -> Geometry:
    return toy_restorer.geometry()


@pytest.fixture(scope="session")
def toy_grid() -> KernelGrid:
    return toy_restorer.grid()


@pytest.fixture(scope="session")
def toy_scene() -> np.ndarray:
    return toy_restorer.scene()


@pytest.fixture(scope="session")
def small_rig(toy_rig: RigDescription) -> RigDescription:
    """As small as the rig of the profiles' tests, so that the terms are compiled once for both."""
    camera = toy_rig.camera.model_copy(update={"columns": 96, "rows": 64, "pitch_um": 69.0})
    panel = toy_rig.panel.model_copy(update={"columns": 32, "rows": 24})
    return toy_rig.model_copy(update={"camera": camera, "panel": panel})


@pytest.fixture(scope="session")
def profile(small_rig: RigDescription, toy_noise: Noise) -> Profile:
    """Every term is present."""
    geometry = nominal_geometry(small_rig)
    point = absent_psf(small_rig, geometry)
    residual = np.pad(np.asarray(point.residual), ((0, 0), (0, 0), (7, 7), (7, 7)))
    dark = absent_backscatter(small_rig, geometry)
    lit = type(dark)(**{**vars(dark), "mask": np.full(np.shape(dark.mask), 2.0e4), "window": 24})
    wire, fitted = absent_wire(small_rig, geometry), toy_restorer.fitted
    return build_profile(
        small_rig,
        provenance_now(None, None),
        noise=fitted(toy_noise),
        geometry=fitted(geometry),
        wire=fitted(wire),
        psf=fitted(type(point)(**{**vars(point), "residual": residual})),
        backscatter=fitted(lit),
        wire_map=sensor_map(wire, small_rig.camera.rows, small_rig.camera.columns),
    )
