"""A toy rig's restorer, and what the rig records of a scene."""

from __future__ import annotations

import numpy as np

from tests.restoration.blur import blurred
from udccal.cfa import cfa_named
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.plan import PlanOptions
from udccal.restoration.rectify import Rectification
from udccal.restoration.runtime import Restorer
from udccal.restoration.sharpen import Sharpener
from udccal.restoration.view import inscribed_view
from udccal.rig import RigDescription
from udccal.tiers import Tier

EXPOSURE_S = 0.01


OPTIONS = PlanOptions(tile_rows=128, tile_columns=128, workers=1)


def made(tier: Tier, rig: RigDescription, noise: Noise, geometry: Geometry, grid: KernelGrid) -> Restorer:
    camera = rig.camera
    view = inscribed_view(geometry, camera.columns, camera.rows, rig.view.columns, rig.view.rows)
    rectification = Rectification.of(geometry, view)
    y = np.mgrid[: camera.rows, : camera.columns][0]
    sharpener = Sharpener.of(grid, rig, rectification.rows, tier, OPTIONS)
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
    """What the toy rig records of a scene: its own blur, wire and noise."""
    rng, rig = np.random.default_rng(1), restorer.rig
    planes = [blurred(grid, channel, scene[..., channel]) for channel in range(3)]
    channels = cfa_named(rig.camera.cfa).channel_map(rig.camera.rows, rig.camera.columns)
    signal = np.take_along_axis(np.stack(planes, -1), channels[..., None], 2)[..., 0] * restorer.wire
    counts = rng.poisson(np.maximum(signal, 0.0)) + rng.normal(0, 5.0, signal.shape)
    return np.clip(np.rint(64 + 0.355 * counts), 0, 3969).astype(np.uint16)
