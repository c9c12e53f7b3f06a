"""Pictures deblurred by given kernels: nothing but the picture says how noisy it is."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.signal import fftconvolve

import udccal
from tests.scenes.grid_blur import blurred
from udccal.errors import RestorationError
from udccal.restoration.deblur import _finest, _noise_line
from udccal.restoration.kernel_grid import KernelGrid
from udccal.tiers import Tier

TILE = 96


@pytest.fixture(scope="module")
def sharp(toy_scene: np.ndarray) -> np.ndarray:
    return toy_scene / 6000.0


@pytest.fixture(scope="module")
def soft(toy_grid: KernelGrid, sharp: np.ndarray) -> np.ndarray:
    return np.stack([blurred(toy_grid, channel, sharp[..., channel]) for channel in range(3)], axis=-1)


def rms(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a - b)[8:-8, 8:-8] ** 2)))


def noisy(soft: np.ndarray, electrons: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.poisson(np.maximum(soft, 0) * electrons) + rng.normal(0, 3, soft.shape)) / electrons


def deblurred(picture: np.ndarray, grid: KernelGrid) -> np.ndarray:
    return udccal.deblur(picture, grid.kernels, grid.x_px, grid.y_px, tile_px=TILE, workers=1)


@pytest.mark.parametrize("electrons", [300.0, 3e4])
def test_a_blurred_picture_becomes_sharper_whatever_its_noise(
    toy_grid: KernelGrid, sharp: np.ndarray, soft: np.ndarray, electrons: float
) -> None:
    picture = noisy(soft, electrons)
    error = rms(deblurred(picture, toy_grid), sharp)
    assert error < {300.0: 0.9, 3e4: 0.55}[electrons] * rms(picture, sharp)


@pytest.mark.parametrize("tier", [tier for tier in Tier if tier is not Tier.preview])
@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_a_picture_with_hardly_any_noise_is_not_made_worse(tier: Tier, noise: float) -> None:
    """Light from beyond the border is no noise: taken for the scene's detail, it cost 8 to 19 dB here."""
    rng = np.random.default_rng(0)
    scene = gaussian_filter(rng.standard_normal((159, 161, 3)), (3, 3, 0))
    scene = (scene - scene.min()) / np.ptp(scene)
    scene[60:80, 60:80] *= 0.3
    scene[:, 80:83] = 1.0
    v, u = np.mgrid[-4:5, -4:5]
    kernel = np.exp(-0.5 * (u**2 / 9 + v**2 / 2.25))
    kernel /= kernel.sum()
    whole = np.stack([fftconvolve(scene[..., colour], kernel, mode="same") for colour in range(3)], axis=-1)
    picture, truth = whole[32:-32, 32:-32], scene[32:-32, 32:-32]
    picture = picture + noise * rng.standard_normal(picture.shape)
    found = udccal.deblur(
        picture, np.broadcast_to(kernel, (1, 1, 3, 9, 9)), np.array([48.0]), np.array([47.0]), tier=tier
    )
    before, after = (float(np.sqrt(np.mean((one - truth) ** 2))) for one in (picture, found))
    assert after < 0.7 * before


def test_the_most_accurate_picture_contradicts_the_samples_least(toy_grid: KernelGrid, soft: np.ndarray) -> None:
    """Blurred again by the given kernels, it is what was given, as far as noise lets anyone say."""
    picture, places = noisy(soft, 3e4), (toy_grid.x_px, toy_grid.y_px)
    off = {}
    for tier in (Tier.balanced, Tier.accurate):
        found = udccal.deblur(picture, toy_grid.kernels, *places, tile_px=TILE, workers=1, tier=tier)
        again = np.stack([blurred(toy_grid, channel, found[..., channel]) for channel in range(3)], axis=-1)
        off[tier] = rms(again, soft)
    assert off[Tier.accurate] < 0.9 * off[Tier.balanced]


@pytest.mark.parametrize("unit", [1e5, 1e30, 1e-30])
def test_units_do_not_matter(toy_grid: KernelGrid, soft: np.ndarray, unit: float) -> None:
    picture = noisy(soft, 3e3)
    scaled = deblurred(unit * picture, toy_grid) / np.float32(unit)
    np.testing.assert_allclose(scaled, deblurred(picture, toy_grid), rtol=1e-3, atol=5e-5)


@pytest.mark.parametrize("tier", [Tier.fast, Tier.balanced, Tier.accurate])
def test_kernels_that_do_not_blur_return_the_picture(tier: Tier) -> None:
    y, x = np.mgrid[:90, :101]
    picture = 0.5 + 0.3 * np.sin(x / 9)[..., None] * np.cos(y[..., None] / 7 + np.arange(3))
    found = udccal.deblur(picture, np.ones((1, 1, 3, 1, 1)), np.zeros(1), np.zeros(1), workers=1, tier=tier)
    np.testing.assert_allclose(found, picture, atol=1e-4)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", [np.float16, np.uint8, np.int16, ">u2", ">f4"])
def test_the_type_of_numbers_does_not_matter(toy_grid: KernelGrid, soft: np.ndarray, kind: str | type) -> None:
    picture = np.rint(100 * np.abs(noisy(soft, 3e3))).astype(kind)
    unchecked = inspect.unwrap(udccal.deblur)  # programs do not have the tests' own check of types
    places = np.arange(5, dtype=np.uint8) * 31, np.arange(4) * 31
    found = unchecked(picture, toy_grid.kernels, *places, tile_px=TILE, workers=1)
    exact = KernelGrid(*(np.asarray(each, float) for each in places), toy_grid.kernels)
    np.testing.assert_allclose(found, deblurred(picture.astype(float), exact), atol=1e-2)


@pytest.mark.parametrize("y_px", [np.array([30, 20, 10, 0], np.uint8), 2**60 + np.arange(4)])
def test_whole_numbers_that_do_not_ascend_are_refused(toy_grid: KernelGrid, soft: np.ndarray, y_px: np.ndarray) -> None:
    with pytest.raises(RestorationError, match="Expected ascending places"):
        inspect.unwrap(udccal.deblur)(soft, toy_grid.kernels, toy_grid.x_px, y_px)


@pytest.mark.parametrize("turned", [False, True], ids=["a row", "a column"])
@pytest.mark.parametrize("tier", [Tier.fast, Tier.balanced, Tier.accurate])
def test_the_noise_of_a_single_row_is_not_taken_for_detail(turned: bool, tier: Tier) -> None:
    wave = np.repeat((0.5 + 0.3 * np.sin(np.arange(200) / 7))[None, :, None], 3, axis=2)
    picture = wave + np.random.default_rng(0).normal(0, 0.1, wave.shape)
    bell = np.exp(-(np.hypot(*np.mgrid[-2:3, -2:3]) ** 2) / 2)
    kernels = np.tile(bell / bell.sum(), (1, 1, 3, 1, 1))
    order = (1, 0, 2) if turned else (0, 1, 2)
    found = udccal.deblur(picture.transpose(order), kernels, np.zeros(1), np.zeros(1), workers=1, tier=tier)
    assert np.std(found.transpose(order) - wave) < 0.2


def test_kernels_of_another_place_do_worse(toy_grid: KernelGrid, sharp: np.ndarray, soft: np.ndarray) -> None:
    wrong = KernelGrid(toy_grid.x_px, toy_grid.y_px, np.ascontiguousarray(toy_grid.kernels[::-1]))
    picture = noisy(soft, 3e4)
    assert rms(deblurred(picture, wrong), sharp) > 1.3 * rms(deblurred(picture, toy_grid), sharp)


def test_noise_is_a_line_over_light() -> None:
    rng = np.random.default_rng(4)
    light = rng.uniform(0.0, 1.0, (20, 3, 1, 1)) * np.ones((1, 1, 96, 96))
    tiles = (light + rng.normal(size=light.shape) * np.sqrt(1e-4 + 2e-4 * light)).astype(np.float32)
    np.testing.assert_allclose(_noise_line(tiles, _finest(96, 96)), (1e-4, 2e-4), rtol=0.1)


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_a_picture_without_noise_or_light_stays_finite(toy_grid: KernelGrid, level: float) -> None:
    even = np.full((96, 128, 3), level, np.float32)
    np.testing.assert_allclose(deblurred(even, toy_grid), even, atol=1e-3)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"picture": np.zeros((96, 128), np.float32)}, "Give three colours of both"),
        ({"picture": np.full((96, 128, 3), np.nan, np.float32)}, "found others, NaN or infinity"),
        ({"picture": np.full((96, 128, 3), 1e300)}, "Expected numbers between"),
        ({"x_px": np.full(4, np.nan)}, "Expected"),
        ({"picture": np.zeros((0, 128, 3), np.float32)}, "Give three colours of both"),
        ({"x_px": np.arange(3.0)}, "Give the picture's px at which each kernel lies"),
        ({"y_px": np.array([3.0, 2.0, 1.0, 0.0])}, "Expected ascending places"),
        ({"scale": 2.0}, "Divide each by its sum"),
        ({"tile_px": 40}, "Expected tiles of at least 96"),
    ],
)
def test_what_does_not_fit_is_refused(toy_grid: KernelGrid, change: dict, sentence: str) -> None:
    given = {"picture": np.zeros((96, 128, 3), np.float32), "x_px": toy_grid.x_px, "y_px": toy_grid.y_px, **change}
    kernels = toy_grid.kernels * given.pop("scale", 1.0)
    with pytest.raises(RestorationError, match=sentence):
        udccal.deblur(kernels=kernels, **given)


@pytest.mark.parametrize("tier", [Tier.fast, Tier.balanced, Tier.accurate])
def test_a_picture_without_noise_that_is_flat_in_most_places_becomes_sharper(toy_grid: KernelGrid, tier: Tier) -> None:
    drawn = np.full((96, 128, 3), 0.25)
    drawn[40:56, 50:80] = 1.0
    one = KernelGrid(np.zeros(1), np.zeros(1), toy_grid.kernels[:1, :1])
    flat = np.stack([blurred(one, channel, drawn[..., channel]) for channel in range(3)], axis=-1)
    # As 8 bits hold it: most samples are exactly the background.
    flat = np.rint(255 * flat) / 255
    found = udccal.deblur(flat, one.kernels, one.x_px, one.y_px, tile_px=TILE, workers=1, tier=tier)
    assert rms(found, drawn) < 0.8 * rms(flat, drawn)


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_clipped_or_blank_rows_do_not_hide_the_noise_of_the_others(
    toy_grid: KernelGrid, sharp: np.ndarray, soft: np.ndarray, level: float
) -> None:
    whole = noisy(soft, 1e3)
    part = np.where(np.arange(len(soft))[:, None, None] < 0.4 * len(soft), np.float32(level), whole)
    below = slice(int(0.75 * len(soft)), None)
    alone, beside = (deblurred(picture, toy_grid)[below] for picture in (whole, part))
    assert rms(beside, sharp[below]) < 1.2 * rms(alone, sharp[below])
