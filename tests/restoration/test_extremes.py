"""Rigs and frames at the edge of what can be: every tier gives finite pictures, and none is worse than the preview."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.extremes import MOST_OVERSHOOT, overshoot, overshoot_of_a_pixel, step
from tests.scenes.toy_restorer import EXPOSURE_S, exposed, made
from udccal.cfa import cfa_named
from udccal.errors import RestorationError
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.restoration.checks import check_frame
from udccal.restoration.demosaic import demosaic
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.metrics import display_exposure, encode_srgb, psnr
from udccal.restoration.panel_mask import PanelMask
from udccal.restoration.runtime import Restorer
from udccal.restoration.tone import Tone
from udccal.rig import RigDescription
from udccal.tiers import Tier

# A tier may be worse than the preview by this much.
_LOSS_DB = 0.3


@pytest.fixture(scope="module")
def restorers(
    toy_rig: RigDescription, toy_noise: Noise, toy_geometry: Geometry, toy_grid: KernelGrid
) -> dict[Tier, Restorer]:
    return {tier: made(tier, toy_rig, toy_noise, toy_geometry, toy_grid) for tier in Tier}


def shown_psnr(restorer: Restorer, frame: np.ndarray, scene: np.ndarray) -> float:
    truth = restorer.rectification.apply(scene) / EXPOSURE_S
    exposure = display_exposure(truth)
    return psnr(encode_srgb(restorer.restore(frame, EXPOSURE_S) * exposure), encode_srgb(truth * exposure))


def no_worse_than_the_preview(restorers: dict[Tier, Restorer], frame: np.ndarray, scene: np.ndarray) -> None:
    found = {tier: shown_psnr(restorer, frame, scene) for tier, restorer in restorers.items()}
    assert all(dB >= found[Tier.preview] - _LOSS_DB for dB in found.values()), found


@pytest.mark.parametrize("light", [1.0, 0.1, 0.01, 1e-3, 2e-4], ids=lambda light: f"light x {light:g}")
def test_no_tier_is_worse_than_the_preview(
    restorers: dict[Tier, Restorer], toy_grid: KernelGrid, toy_scene: np.ndarray, light: float
) -> None:
    """The last one has 1 e- in its bright places."""
    scene = toy_scene * np.float32(light)
    no_worse_than_the_preview(restorers, exposed(restorers[Tier.fast], toy_grid, scene), scene)


@pytest.mark.parametrize("wire", ["1 %", "four rows of 0.0001", "four rows of 1.9 %", "every tenth row", "a patch"])
def test_hardly_any_light_comes_through(
    restorers: dict[Tier, Restorer], toy_grid: KernelGrid, toy_scene: np.ndarray, wire: str
) -> None:
    passed = np.full((96, 128), 0.01 if wire == "1 %" else 1.0, np.float32)
    if wire.startswith("four rows"):
        passed[40:44] = 1e-4 if wire.endswith("0001") else 0.019
    elif wire == "every tenth row":
        passed[::10] = 1e-3
    elif wire == "a patch":
        passed[30:50, 40:70] = 1e-3
    dim = {tier: replace(restorer, wire=passed) for tier, restorer in restorers.items()}
    frame = exposed(dim[Tier.fast], toy_grid, toy_scene)
    no_worse_than_the_preview(dim, frame, toy_scene)
    if wire != "1 %":
        # What the blind samples hide is all that is lost.
        whole = exposed(restorers[Tier.preview], toy_grid, toy_scene)
        best = shown_psnr(restorers[Tier.preview], whole, toy_scene)
        assert shown_psnr(dim[Tier.preview], frame, toy_scene) > best - 0.5


def test_dead_rows(restorers: dict[Tier, Restorer], toy_grid: KernelGrid, toy_scene: np.ndarray) -> None:
    frame = exposed(restorers[Tier.fast], toy_grid, toy_scene)
    best = shown_psnr(restorers[Tier.preview], frame, toy_scene)
    frame[40:44] = frame[60] = 64
    no_worse_than_the_preview(restorers, frame, toy_scene)
    assert shown_psnr(restorers[Tier.preview], frame, toy_scene) > best - 0.5


def test_a_preview_for_a_display_shows_no_blind_rows(
    restorers: dict[Tier, Restorer], toy_grid: KernelGrid, toy_scene: np.ndarray
) -> None:
    passed = np.ones((96, 128), np.float32)
    whole = replace(restorers[Tier.preview], wire=passed)
    frame = exposed(whole, toy_grid, toy_scene)
    tone = Tone(EXPOSURE_S / 6000)
    expected = whole.display(frame, EXPOSURE_S, tone).astype(float)
    dim = passed.copy()
    dim[40:42] = 1e-4
    frame[40:42] = 64
    shown = replace(restorers[Tier.preview], wire=dim).display(frame, EXPOSURE_S, tone)
    assert np.sqrt(np.mean((shown - expected) ** 2)) < 3


def test_a_transfer_with_zeros(
    toy_rig: RigDescription, toy_noise: Noise, toy_geometry: Geometry, toy_grid: KernelGrid, toy_scene: np.ndarray
) -> None:
    """Two equal peaks swallow every frequency at which they cancel."""
    kernels = np.zeros_like(toy_grid.kernels)
    kernels[..., 16, 4] = kernels[..., 24, 4] = 0.5
    grid = replace(toy_grid, kernels=kernels)
    restorers = {tier: made(tier, toy_rig, toy_noise, toy_geometry, grid) for tier in Tier}
    no_worse_than_the_preview(restorers, exposed(restorers[Tier.fast], grid, toy_scene), toy_scene)


@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_every_colour_pattern(
    toy_rig: RigDescription,
    toy_noise: Noise,
    toy_geometry: Geometry,
    toy_grid: KernelGrid,
    toy_scene: np.ndarray,
    cfa: str,
) -> None:
    rig = toy_rig.model_copy(update={"camera": toy_rig.camera.model_copy(update={"cfa": cfa})})
    restorers = {tier: made(tier, rig, toy_noise, toy_geometry, toy_grid) for tier in Tier}
    no_worse_than_the_preview(restorers, exposed(restorers[Tier.fast], toy_grid, toy_scene), toy_scene)


@pytest.mark.parametrize("tier", list(Tier))
def test_sensors_of_odd_sizes(
    toy_rig: RigDescription, toy_noise: Noise, toy_geometry: Geometry, toy_grid: KernelGrid, tier: Tier
) -> None:
    camera = toy_rig.camera.model_copy(update={"rows": 95, "columns": 127})
    rig = toy_rig.model_copy(update={"camera": camera})
    restorer = made(tier, rig, toy_noise, toy_geometry, toy_grid)
    frame = np.full((95, 127), 64 + round(0.355 * 2000), np.uint16)
    restored = replace(restorer, wire=None).restore(frame, EXPOSURE_S)
    np.testing.assert_allclose(restored * EXPOSURE_S, 2000.0, rtol=0.01)


def test_a_crop_of_one_pixel_is_no_frame(toy_rig: RigDescription) -> None:
    with pytest.raises(RestorationError, match="128 x 96 samples"):
        check_frame(np.zeros((1, 1), np.uint16), EXPOSURE_S, toy_rig)
    assert all(overshoot_of_a_pixel(tier) < 0.01 for tier in Tier)


@pytest.mark.parametrize("tier", list(Tier))
@pytest.mark.parametrize("kind", ["90 % saturated", "a peak a million times the median", "every tenth column hot"])
def test_frames_of_extremes(restorers: dict[Tier, Restorer], tier: Tier, kind: str) -> None:
    frame = (64 + np.random.default_rng(7).poisson(0.4, (96, 128))).astype(np.uint16)
    if kind == "90 % saturated":
        frame[:, :115] = 3969
    elif kind == "every tenth column hot":
        frame[:, ::10] = 3969
    else:  # the median is a hundredth of an electron
        frame[:] = 64
        frame[48:50, 64:66] = 3969
    restored = restorers[tier].restore(frame, EXPOSURE_S)
    assert np.isfinite(restored).all()
    assert restored.max() * EXPOSURE_S < 10 * 3969 / 0.355


@pytest.mark.parametrize("tier", list(Tier))
@pytest.mark.parametrize(
    "kind", ["an exposure of a nanosecond", "a full well", "a hundred times the noise", "no light"]
)
def test_cameras_at_their_limits(
    restorers: dict[Tier, Restorer], toy_grid: KernelGrid, toy_scene: np.ndarray, tier: Tier, kind: str
) -> None:
    restorer, exposure_s = restorers[tier], EXPOSURE_S
    frame = exposed(restorers[Tier.fast], toy_grid, toy_scene)
    if kind == "an exposure of a nanosecond":
        exposure_s = 1e-9
    elif kind == "a full well":
        frame[:] = 3969
    elif kind == "a hundred times the noise":
        restorer = replace(restorer, noise=replace(restorer.noise, sigma_d_e=500.0, sigma_row_DN=20.0))
        noisy = frame + np.random.default_rng(1).normal(0.0, 177.0, frame.shape)
        frame = np.clip(np.rint(noisy), 0, 3969).astype(np.uint16)
    else:
        frame[:] = 0
    restored = restorer.restore(frame, exposure_s) * exposure_s
    assert np.isfinite(restored).all()
    assert np.abs(restored).max() < 10 * 3969 / 0.355
    assert restorer.display(frame, exposure_s, Tone(exposure_s / 6000)).dtype == np.uint8


def test_a_panel_brighter_than_the_scene(
    restorers: dict[Tier, Restorer], toy_grid: KernelGrid, toy_scene: np.ndarray
) -> None:
    """Backscatter of 20 times the scene's light; the picture is not known, and the panel is white."""
    scene = toy_scene * np.float32(0.02)
    white = np.full((96, 128), 20 * float(scene.mean()) / EXPOSURE_S, np.float32)
    lit = {tier: replace(restorer, mask=PanelMask(white, cfa_named("RGGB"))) for tier, restorer in restorers.items()}
    wire = restorers[Tier.fast].wire
    assert wire is not None
    frame = exposed(restorers[Tier.fast], toy_grid, scene + np.float32(EXPOSURE_S) * white[..., None])
    no_worse_than_the_preview(lit, frame, scene)


@pytest.mark.parametrize("tier", list(Tier))
@pytest.mark.parametrize("axis", [0, 1], ids=["a step across", "a step down"])
@pytest.mark.parametrize("at", [0, 1], ids=["at a cell", "within a cell"])
@pytest.mark.parametrize("rising", [True, False], ids=["rising", "falling"])
def test_a_step_is_not_overshot(
    restorers: dict[Tier, Restorer], toy_grid: KernelGrid, tier: Tier, axis: int, at: int, rising: bool
) -> None:
    low, high = 500.0, 5000.0
    scene = step(axis, *((low, high) if rising else (high, low)), at=at)
    frame = exposed(restorers[tier], toy_grid, scene)
    assert overshoot(restorers[tier].restore(frame, EXPOSURE_S) * EXPOSURE_S, axis, low, high) <= MOST_OVERSHOOT
    shown = restorers[tier].display(frame, EXPOSURE_S, Tone(EXPOSURE_S / 8000)) / 255.0
    linear = 8000 * np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    assert overshoot(linear, axis, low, high) <= MOST_OVERSHOOT


def test_all_the_detail_of_a_demosaicing_overshoots(restorers: dict[Tier, Restorer], toy_grid: KernelGrid) -> None:
    scene = step(0, 500.0, 5000.0)
    preview = restorers[Tier.preview]
    mosaic = preview.scene_light(exposed(preview, toy_grid, scene), EXPOSURE_S).signal_e
    assert overshoot(preview.rectification.apply(demosaic(mosaic, "RGGB")), 0, 500.0, 5000.0) > MOST_OVERSHOOT


def test_an_overshoot_is_seen_from_either_side_and_so_is_what_is_not_finite() -> None:
    picture = step(0, 1.0, 3.0)
    assert overshoot(picture, 0, 1.0, 3.0) == 0.0
    for column, level in ((63, 0.8), (64, 3.2)):
        ringing = picture.copy()
        ringing[:, column] = level
        assert overshoot(ringing, 0, 1.0, 3.0) == pytest.approx(0.1, rel=1e-5)
        assert overshoot(ringing, 0, 1.0, 3.0, unit=4.0) == pytest.approx(0.05, rel=1e-5)
    picture[3, 5, 1] = np.inf
    assert np.isnan(overshoot(picture, 0, 1.0, 3.0))
