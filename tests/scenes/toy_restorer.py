"""A toy rig with a psf like a panel's: a peak, orders above and below it, a long weak streak; all varying.

Its restorer at each tier, and what it records of a scene.
"""

from __future__ import annotations

import numpy as np

from tests.scenes.grid_blur import blurred
from udccal.cfa import cfa_named
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.plan import PlanOptions
from udccal.restoration.rectify import Rectification
from udccal.restoration.runtime import Restorer
from udccal.restoration.sharpen import Sharpener
from udccal.restoration.view import inscribed_view
from udccal.result import FitResult, FitStatus
from udccal.rig import RigDescription, load_rig
from udccal.tiers import Tier

EXPOSURE_S = 0.01
ROWS, COLUMNS = 96, 128
OPTIONS = PlanOptions(tile_rows=120, tile_columns=96, workers=1)
# A tile that begins to be used in this row reaches to the first one.
REACHED_PX = 20
NOISE = Noise(0.355, 64.0, 3969.0, 5.0, 0.1, 0.2, 1.0, 20.0, 2.0, 0.005)


def rig() -> RigDescription:
    shipped = load_rig("lg55-reduced")
    camera = shipped.camera.model_copy(update={"columns": COLUMNS, "rows": ROWS, "pitch_um": 55.2})
    panel = shipped.panel.model_copy(update={"columns": 48, "rows": 27})
    view = shipped.view.model_copy(update={"columns": 96, "rows": 54})
    return shipped.model_copy(update={"camera": camera, "panel": panel, "view": view})


def geometry() -> Geometry:
    return Geometry(
        focal_px=np.array([108.7, 108.7]),
        principal_point_px=np.array([(COLUMNS - 1) / 2 + 1.0, (ROWS - 1) / 2 - 1.0]),
        distortion=np.array([-0.06, 0.02, 2e-4, -2e-4, -0.005]),
        rotation_rad=np.array([-0.29, 0.01, 0.02]),
        pupil_mm=np.array([600.0, 190.0, -14.0]),
    )


def grid() -> KernelGrid:
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


def scene() -> np.ndarray:
    """Linear light in e-: smooth texture and a few edges."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:ROWS, :COLUMNS].astype(float)
    picture = np.stack([0.5 + 0.4 * np.sin(x / (4 + c)) * np.cos(y / (2.4 - 0.1 * c)) for c in range(3)], axis=-1)
    for _ in range(6):
        row, column = rng.integers(5, 60, 2)
        picture[row : row + 25, column : column + 30] *= rng.uniform(0.3, 1.4, 3)
    return (6000.0 * picture).astype(np.float32)


def fitted(term: object, status: FitStatus = FitStatus.CONVERGED) -> FitResult:
    """A result that states nothing but its term."""
    return FitResult("test", term, status, (), np.zeros((0, 0)), 1.0, 100)


def made(
    tier: Tier,
    rig: RigDescription,
    noise: Noise,
    geometry: Geometry,
    grid: KernelGrid,
    needed_alone: bool = False,
) -> Restorer:
    """The restorer of rows that the view needs, and of so many above that tiles reach all: a test's wire is of all."""
    camera = rig.camera
    view = inscribed_view(geometry, camera.columns, camera.rows, rig.view.columns, rig.view.rows)
    rectification = Rectification.of(geometry, view)
    y = np.mgrid[: camera.rows, : camera.columns][0]
    first, last = rectification.rows
    rows = first if needed_alone else min(first, REACHED_PX), last
    sharpener = Sharpener.of(grid, rig, rows, tier, OPTIONS)
    return Restorer(
        tier=tier,
        rig=rig,
        noise=noise,
        view=view,
        wire=(1 + 0.03 * np.sin(y / 5.0)).astype(np.float32),
        mask=None,
        panel=None,
        sharpener=None if tier is Tier.preview else sharpener,
        rectification=rectification,
        options=OPTIONS,
    )


def exposed(restorer: Restorer, grid: KernelGrid, scene: np.ndarray) -> np.ndarray:
    """What the toy rig records of a scene: its own blur, wire, dark current and noise."""
    return taken(restorer, recorded_e(restorer, grid, scene), seed=1)


def recorded_e(restorer: Restorer, grid: KernelGrid, scene: np.ndarray) -> np.ndarray:
    """The mosaic of a scene without noise, in e-."""
    camera = restorer.rig.camera
    planes = [blurred(grid, channel, scene[..., channel]) for channel in range(3)]
    channels = cfa_named(camera.cfa).channel_map(camera.rows, camera.columns)
    return np.take_along_axis(np.stack(planes, -1), channels[..., None], 2)[..., 0] * restorer.wire


def taken(restorer: Restorer, signal_e: np.ndarray, seed: int) -> np.ndarray:
    """A frame of a mosaic without noise."""
    rng, dark_e = np.random.default_rng(seed), float(restorer.noise.dark_current_e_per_s) * EXPOSURE_S
    counts = rng.poisson(np.maximum(signal_e, 0.0) + dark_e) + rng.normal(0, 5.0, signal_e.shape)
    return np.clip(np.rint(64 + 0.355 * counts), 0, 3969).astype(np.uint16)
