"""A toy rig with a psf like a panel's: a peak, orders above and below it, a long weak streak; all varying."""

from __future__ import annotations

import numpy as np
import pytest

from udccal.fitting.nominal import absent_backscatter, absent_psf, absent_wire, nominal_geometry
from udccal.fitting.wire.fit import sensor_map
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.profiles.profile import Profile, build_profile
from udccal.profiles.provenance import provenance_now
from udccal.restoration.kernel_grid import KernelGrid
from udccal.result import FitResult, FitStatus
from udccal.rig import RigDescription, load_rig

ROWS, COLUMNS = 96, 128


@pytest.fixture(scope="session")
def toy_rig() -> RigDescription:
    rig = load_rig("lg55-reduced")
    camera = rig.camera.model_copy(update={"columns": COLUMNS, "rows": ROWS, "pitch_um": 55.2})
    panel = rig.panel.model_copy(update={"columns": 48, "rows": 27})
    view = rig.view.model_copy(update={"columns": 96, "rows": 54})
    return rig.model_copy(update={"camera": camera, "panel": panel, "view": view})


@pytest.fixture(scope="session")
def toy_noise() -> Noise:
    return Noise(0.355, 64.0, 3969.0, 5.0, 0.1, 0.2, 1.0, 20.0, 2.0, 0.005)


@pytest.fixture(scope="session")
def toy_geometry(toy_rig: RigDescription) -> Geometry:
    return Geometry(
        focal_px=np.array([108.7, 108.7]),
        principal_point_px=np.array([(COLUMNS - 1) / 2 + 1.0, (ROWS - 1) / 2 - 1.0]),
        distortion=np.array([-0.06, 0.02, 2e-4, -2e-4, -0.005]),
        rotation_rad=np.array([-0.29, 0.01, 0.02]),
        pupil_mm=np.array([600.0, 190.0, -14.0]),
    )


@pytest.fixture(scope="session")
def toy_grid() -> KernelGrid:
    x_px, y_px = np.linspace(0, COLUMNS - 1, 5), np.linspace(0, ROWS - 1, 4)
    kernels = np.array([[[_kernel(x, y, c) for c in range(3)] for x in x_px / COLUMNS] for y in y_px / ROWS])
    return KernelGrid(x_px, y_px, kernels)


def _kernel(x: float, y: float, channel: int) -> np.ndarray:
    """Orders 1.6 px apart under an envelope that narrows down the field, sheared sideways at the sides."""
    v, u = np.mgrid[-20:21, -4:5].astype(float)
    width = 5.0 - 2.0 * y - 0.3 * channel
    sideways = u - 0.15 * (x - 0.5) * v
    streak = np.exp(-(sideways**2) / 0.4) * (np.exp(-0.5 * (v / width) ** 2) + 2e-2 / (1 + np.abs(v)))
    kernel = streak * (0.55 + 0.45 * np.cos(2 * np.pi * v / 1.6)) + 0.5 * (np.hypot(u, v) < 0.5)
    return (kernel / kernel.sum()).astype(np.float32)


@pytest.fixture(scope="session")
def toy_scene() -> np.ndarray:
    """Linear light in e-: smooth texture and a few edges."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:ROWS, :COLUMNS].astype(float)
    picture = np.stack([0.5 + 0.4 * np.sin(x / (4 + c)) * np.cos(y / (2.4 - 0.1 * c)) for c in range(3)], axis=-1)
    for _ in range(6):
        row, column = rng.integers(5, 60, 2)
        picture[row : row + 25, column : column + 30] *= rng.uniform(0.3, 1.4, 3)
    return (6000.0 * picture).astype(np.float32)


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

    def fitted(term: object) -> FitResult:
        return FitResult("test", term, FitStatus.CONVERGED, (), np.zeros((0, 0)), 1.0, 100)

    wire = absent_wire(small_rig, geometry)
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
