"""The expected PSNR against that of a toy rig's pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.toy_restorer import EXPOSURE_S, exposed, made
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.restoration.forecast import ExpectedError, expected_error
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.metrics import display_exposure, encode_srgb, psnr
from udccal.restoration.runtime import Restorer
from udccal.rig import RigDescription
from udccal.tiers import Tier


@pytest.fixture(scope="module")
def restorers(
    toy_rig: RigDescription, toy_noise: Noise, toy_geometry: Geometry, toy_grid: KernelGrid
) -> dict[Tier, Restorer]:
    return {tier: made(tier, toy_rig, toy_noise, toy_geometry, toy_grid) for tier in Tier}


def measured_dB(restorer: Restorer, frame: np.ndarray, scene: np.ndarray) -> float:
    truth = restorer.rectification.apply(scene) / EXPOSURE_S
    exposure = display_exposure(truth)
    return psnr(encode_srgb(restorer.restore(frame, EXPOSURE_S) * exposure), encode_srgb(truth * exposure))


def expected_of(restorers: dict[Tier, Restorer], frame: np.ndarray) -> ExpectedError:
    return expected_error(restorers[Tier.preview], restorers[Tier.balanced], frame, EXPOSURE_S, None)


@pytest.mark.parametrize("light", [1.0, 0.1])
def test_each_tier_is_about_as_good_as_expected(
    restorers: dict[Tier, Restorer], toy_grid: KernelGrid, toy_scene: np.ndarray, light: float
) -> None:
    scene = toy_scene * np.float32(light)
    frame = exposed(restorers[Tier.fast], toy_grid, scene)
    expected = expected_of(restorers, frame)
    for tier in Tier:
        within_dB = 1.5 if tier is Tier.preview else 3.0
        assert expected.psnr_dB(tier) == pytest.approx(measured_dB(restorers[tier], frame, scene), abs=within_dB), tier


def test_less_light_is_expected_to_be_worse(
    restorers: dict[Tier, Restorer], toy_grid: KernelGrid, toy_scene: np.ndarray
) -> None:
    frames = [exposed(restorers[Tier.fast], toy_grid, toy_scene * np.float32(light)) for light in (1.0, 0.1)]
    for tier in (Tier.fast, Tier.balanced, Tier.accurate):
        bright, dim = (expected_of(restorers, frame).psnr_dB(tier) for frame in frames)
        assert bright > dim + 0.5


def test_a_preview_that_is_blurred_more_is_expected_to_be_worse(
    restorers: dict[Tier, Restorer], toy_grid: KernelGrid, toy_scene: np.ndarray
) -> None:
    """Of the same scene, stripes are what a preview loses, and an even wall is not."""
    stripes, wall = toy_scene.copy(), np.full_like(toy_scene, toy_scene.mean())
    stripes[::4] = stripes[1::4] = 500.0
    dB = [
        expected_of(restorers, exposed(restorers[Tier.fast], toy_grid, scene)).psnr_dB(Tier.preview)
        for scene in (stripes, toy_scene, wall)
    ]
    assert dB[0] < dB[1] - 1.0
    assert dB[1] < dB[2] - 5.0


def test_detail_to_the_pixel_is_expected_to_lose_more(
    restorers: dict[Tier, Restorer], toy_grid: KernelGrid, toy_scene: np.ndarray
) -> None:
    fine = toy_scene * np.random.default_rng(3).uniform(0.5, 1.5, (*toy_scene.shape[:2], 1)).astype(np.float32)
    smooth, sharp = (
        expected_of(restorers, exposed(restorers[Tier.fast], toy_grid, scene)) for scene in (toy_scene, fine)
    )
    assert sharp.psnr_dB(Tier.balanced) < smooth.psnr_dB(Tier.balanced) - 3.0
    # With the other's loss, the forecast is that of another scene.
    assert replace(sharp, lost=smooth.lost).psnr_dB(Tier.balanced) > sharp.psnr_dB(Tier.balanced) + 1.0


def test_halos_of_lamps_are_errors_of_all_tiers_but_the_one_that_takes_them_off(
    restorers: dict[Tier, Restorer], toy_grid: KernelGrid, toy_scene: np.ndarray
) -> None:
    dark = expected_of(restorers, exposed(restorers[Tier.fast], toy_grid, toy_scene))
    assert dark.halos == 0.0
    lit = replace(dark, halos=1e-2)
    assert lit.psnr_dB(Tier.accurate) == dark.psnr_dB(Tier.accurate)
    for tier in (Tier.preview, Tier.fast, Tier.balanced):
        error = 10 ** (-dark.psnr_dB(tier) / 10) + 1e-2
        assert lit.psnr_dB(tier) == pytest.approx(-10 * np.log10(error))
