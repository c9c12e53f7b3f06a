"""Drawn cameras, views and frames, the smallest among them: every tier gives finite pictures, or a sentence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.toy_restorer import made
from udccal.cfa import cfa_named
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.restoration.deblur import deblur
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.panel_mask import PanelMask
from udccal.restoration.tone import Tone
from udccal.rig import RigDescription
from udccal.tiers import Tier

# The least of a rig's sensor and view, and a little more.
ROWS, COLUMNS, VIEW = (64, 97), (64, 131), (16, 40)


def drawn_frame(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """All 0, all saturated, beyond saturation, random, dark, or of hot samples and rows."""
    column = np.ones((1, shape[1]))
    return rng.choice(
        [
            np.zeros(shape),
            np.full(shape, 3969),
            np.full(shape, 4095),
            rng.integers(0, 4096, shape),
            64 + rng.poisson(0.3, shape),
            np.where(rng.random(shape) < 0.2, 4095, 64),
            np.where(rng.random((shape[0], 1)) < 0.5, 0, 4095) * column,
        ]
    ).astype(np.uint16)


@pytest.mark.parametrize("seed", range(4))
def test_every_tier_gives_finite_pictures(
    toy_rig: RigDescription, toy_noise: Noise, toy_geometry: Geometry, toy_grid: KernelGrid, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    rows, columns = (int(rng.integers(*bounds)) if seed else bounds[0] for bounds in (ROWS, COLUMNS))
    camera = toy_rig.camera.model_copy(
        update={"rows": rows, "columns": columns, "cfa": ("RGGB", "BGGR", "GRBG", "GBRG")[seed]}
    )
    sides = (int(rng.integers(*VIEW)) if seed else VIEW[0] for _ in range(2))
    view = toy_rig.view.model_copy(update=dict(zip(("rows", "columns"), sides, strict=True)))
    rig = toy_rig.model_copy(update={"camera": camera, "view": view})
    geometry = Geometry(**{**vars(toy_geometry), "principal_point_px": np.array([columns / 2, rows / 2])})
    light = np.full((rows, columns), 1e4, np.float32)
    for tier in Tier:
        restorer = made(tier, rig, toy_noise, geometry, toy_grid)
        assert restorer.wire is not None
        mask = PanelMask(light[restorer.rows], cfa_named(camera.cfa), 0.02)
        restorer = replace(restorer, wire=restorer.wire[restorer.rows], mask=mask)
        frame, exposure_s = drawn_frame(rng, (rows, columns)), float(rng.choice([1e-9, 0.01, 1.0, 86400.0]))
        assert np.isfinite(restorer.restore(frame, exposure_s)).all()
        shown = restorer.display(frame, exposure_s, Tone(float(rng.choice([0.0, exposure_s / 6000, 1e20]))))
        assert (shown.dtype, shown.shape) == (np.uint8, (view.rows, view.columns, 3))


@pytest.mark.parametrize("tier", [Tier.fast, Tier.balanced, Tier.accurate])
@pytest.mark.parametrize("shape", [(1, 1), (1, 97), (3, 2), (21, 1)])
def test_pictures_of_a_few_pixels_are_deblurred(toy_grid: KernelGrid, tier: Tier, shape: tuple[int, int]) -> None:
    picture = np.random.default_rng(1).random((*shape, 3))
    sharp = deblur(picture, toy_grid.kernels, toy_grid.x_px, toy_grid.y_px, tier=tier)
    assert sharp.shape == picture.shape
    assert np.isfinite(sharp).all()
