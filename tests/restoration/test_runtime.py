from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import equinox as eqx
import numpy as np
import pytest

from tests.scenes.toy_restorer import EXPOSURE_S, exposed, made
from udccal.cfa import cfa_named
from udccal.errors import RestorationError
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.restoration.checks import check_frame, check_panel_picture
from udccal.restoration.demosaic import demosaic
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.metrics import display_exposure, encode_srgb, least_squares_gain, psnr
from udccal.restoration.panel_mask import PanelMask
from udccal.restoration.preview import Preview
from udccal.restoration.rectify import Rectification
from udccal.restoration.runtime import Restorer
from udccal.restoration.tone import Tone, to_rgb8
from udccal.restoration.view import inscribed_view
from udccal.rig import RigDescription
from udccal.tiers import Tier


@pytest.fixture(scope="module")
def restorers(
    toy_rig: RigDescription, toy_noise: Noise, toy_geometry: Geometry, toy_grid: KernelGrid
) -> dict[Tier, Restorer]:
    return {tier: made(tier, toy_rig, toy_noise, toy_geometry, toy_grid) for tier in Tier}


@pytest.fixture(scope="module")
def restorer(restorers: dict[Tier, Restorer]) -> Restorer:
    return restorers[Tier.balanced]


@pytest.fixture(scope="module")
def frame(restorer: Restorer, toy_grid: KernelGrid, toy_scene: np.ndarray) -> np.ndarray:
    return exposed(restorer, toy_grid, toy_scene)


def scores(restorer: Restorer, frame: np.ndarray, toy_scene: np.ndarray) -> tuple[float, float]:
    truth = restorer.rectification.apply(toy_scene) / EXPOSURE_S
    exposure = display_exposure(truth)
    before = restorer.before(frame, EXPOSURE_S)
    pictures = (before * least_squares_gain(before, truth), restorer.restore(frame, EXPOSURE_S))
    one, other = (psnr(encode_srgb(p * exposure), encode_srgb(truth * exposure)) for p in pictures)
    return one, other


def test_restoration_brings_the_scene_back(restorer: Restorer, frame: np.ndarray, toy_scene: np.ndarray) -> None:
    before_dB, after_dB = scores(restorer, frame, toy_scene)
    assert after_dB > before_dB + 4.0


@pytest.mark.parametrize("tier", list(Tier))
def test_a_rig_that_changes_nothing_returns_the_scene(
    toy_rig: RigDescription, toy_noise: Noise, toy_geometry: Geometry, toy_grid: KernelGrid, tier: Tier
) -> None:
    points = replace(toy_grid, kernels=np.tile(np.pad(np.ones((1, 1)), 1), (4, 5, 3, 1, 1)))
    clear = replace(made(tier, toy_rig, toy_noise, toy_geometry, points), wire=np.ones((96, 128), np.float32))
    y, x = np.mgrid[:96, :128]
    scene = 3000 + 1500 * np.sin(x / 9)[..., None] * np.cos(y[..., None] / 7 + np.arange(3))
    found = replace(clear, wire=None).restore(exposed(clear, points, scene.astype(np.float32)), EXPOSURE_S) * EXPOSURE_S
    off = found - clear.rectification.apply(scene.astype(np.float32))
    assert np.sqrt(np.mean(off**2)) < 0.02 * 3000  # a sample has 2 % of noise


def test_a_tier_that_does_more_is_more_accurate(
    restorers: dict[Tier, Restorer], frame: np.ndarray, toy_scene: np.ndarray
) -> None:
    preview, fast, balanced, accurate = (scores(restorers[tier], frame, toy_scene)[1] for tier in Tier)
    assert fast > preview + 2.0
    assert balanced > fast + 0.3
    assert accurate > balanced


@pytest.mark.parametrize("tier", list(Tier))
def test_samples_that_clip_are_white_at_the_light_that_says_so(
    restorers: dict[Tier, Restorer], toy_grid: KernelGrid, toy_scene: np.ndarray, tier: Tier
) -> None:
    """In spite of the wire, and of the panel's light that is taken off."""
    restorer, lit = restorers[tier], toy_scene.copy()
    light = np.full((96, 128), 300.0 / EXPOSURE_S, np.float32)
    restorer = replace(restorer, mask=PanelMask(light, cfa_named(restorer.rig.camera.cfa)))
    lit[30:66, 40:88] = 20_000.0
    frame = exposed(restorer, toy_grid, lit)
    clips = restorer.clipping_light(EXPOSURE_S)
    inside = restorer.rectification.apply((lit == 20_000.0).astype(np.float32))[..., 1] > 0.999
    inside = cv2.erode(inside.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert inside.sum() > 300
    tenth, half = np.percentile(restorer.restore(frame, EXPOSURE_S)[inside], [10, 50])
    assert tenth > 0.95 * clips
    assert half > clips
    darker = replace(restorer, wire=None, mask=None)
    assert 1.01 * clips < darker.clipping_light(EXPOSURE_S) < 1.3 * clips
    hot = replace(restorer, noise=eqx.tree_at(lambda noise: noise.dark_current_e_per_s, restorer.noise, 2e6))
    assert hot.clipping_light(EXPOSURE_S) == np.inf


def test_a_display_shows_what_restore_returns(
    restorers: dict[Tier, Restorer], frame: np.ndarray, toy_scene: np.ndarray
) -> None:
    tone = Tone(display_exposure(restorers[Tier.balanced].rectification.apply(toy_scene) / EXPOSURE_S))
    for tier, restorer in restorers.items():
        expected = to_rgb8(tone.apply(restorer.restore(frame, EXPOSURE_S))).astype(int)
        found = restorer.display(frame, EXPOSURE_S, tone)
        # The preview demosaics and resamples bytes, by other filters.
        off = np.abs(found - expected)
        assert np.median(off) <= 3 if tier is Tier.preview else off.max() <= 1, tier


@pytest.mark.parametrize("tier", list(Tier))
def test_hot_and_dead_samples_are_not_displayed(restorers: dict[Tier, Restorer], tier: Tier) -> None:
    tone = Tone(EXPOSURE_S / 6000)
    even = np.rint(64 + 0.355 * np.random.default_rng(2).poisson(3000.0, (96, 128))).astype(np.uint16)
    broken = even.copy()
    broken[[40, 51, 62, 73, 84], [30, 41, 64, 77, 90]] = 3969, 0, 3969, 0, 3969
    shown, expected = (restorers[tier].display(frame, EXPOSURE_S, tone).astype(int) for frame in (broken, even))
    assert np.abs(shown - expected).max() <= 12


def test_a_preview_demosaics_only_what_the_view_reads(restorers: dict[Tier, Restorer], frame: np.ndarray) -> None:
    preview = restorers[Tier.preview]
    whole = demosaic(preview.scene_light(frame, EXPOSURE_S).signal_e, "RGGB", 0.65)
    assert preview._seen[0].start > 0
    expected = preview.rectification.apply(whole) / EXPOSURE_S
    np.testing.assert_allclose(preview.restore(frame, EXPOSURE_S), expected, atol=1e-4 * expected.max())


@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_a_preview_shows_the_colours_of_every_pattern(
    toy_rig: RigDescription, toy_noise: Noise, toy_geometry: Geometry, cfa: str
) -> None:
    view = inscribed_view(toy_geometry, 128, 96, 96, 54)
    rectification = Rectification.of(toy_geometry, view)
    light = np.array([800.0, 2000.0, 400.0])[cfa_named(cfa).channel_map(96, 128)]
    mosaic = np.rint(64 + 0.355 * light).astype(np.uint16)
    preview = Preview.of(toy_noise, None, None, cfa_named(cfa), rectification, (96, 128))
    found = preview.rgb8(mosaic, EXPOSURE_S, Tone(EXPOSURE_S / 2500))
    expected = to_rgb8(encode_srgb(np.array([0.32, 0.8, 0.16])[None, None]))[0, 0]
    assert np.abs(found.astype(int) - expected).max() <= 1


def test_a_dark_scene_stays_grey_where_the_panels_light_is_known_badly(
    restorer: Restorer, toy_grid: KernelGrid
) -> None:
    cfa, camera = cfa_named(restorer.rig.camera.cfa), restorer.rig.camera
    white = np.full((camera.rows, camera.columns), 4e5, np.float32)
    # The panel gives up to 6 % more red light, or blue, than the mask says.
    wrong = 0.06 * np.sin(np.arange(camera.columns) / 20.0)[:, None] * np.array([1.0, 0.0, -1.0])
    channels = cfa.channel_map(camera.rows, camera.columns)
    truly = white * (1 + wrong[np.arange(camera.columns), channels])
    counts = np.random.default_rng(9).poisson((truly * EXPOSURE_S + 20.0) * restorer.wire)
    frame = np.rint(64 + 0.355 * counts).astype(np.uint16)
    panel = restorer.rig.panel
    shown = np.full((panel.rows, panel.columns, 3), 255, np.uint8)
    colour_e = []
    for error, known in ((0.0, shown), (0.06, shown), (0.06, None)):
        picture = replace(restorer, mask=PanelMask(white, cfa, error)).restore(frame, EXPOSURE_S, known) * EXPOSURE_S
        smooth = cv2.blur(picture, (9, 9))
        colour_e.append(float(np.sqrt(np.mean((smooth[..., 0] - smooth[..., 2]) ** 2))))
    assert colour_e[0] > 100.0
    assert max(colour_e[1:]) < 0.5 * colour_e[0]


def test_colours_behind_an_even_panel_stay_when_its_picture_is_not_known(restorer: Restorer) -> None:
    cfa, camera = cfa_named(restorer.rig.camera.cfa), restorer.rig.camera
    white = np.full((camera.rows, camera.columns), 4e5, np.float32)
    scene = np.array([6e4, 3e4, 1e4])[cfa.channel_map(camera.rows, camera.columns)]
    scene[:, : camera.columns // 3] = 0.0
    counts = np.random.default_rng(9).poisson((white + scene) * EXPOSURE_S * restorer.wire)
    frame = np.rint(64 + 0.355 * counts).astype(np.uint16)
    found = replace(restorer, mask=PanelMask(white, cfa, 0.002)).restore(frame, EXPOSURE_S)
    inside = found[:, found.shape[1] * 2 // 3 :].mean(axis=(0, 1))
    np.testing.assert_allclose(inside, [6e4, 3e4, 1e4], rtol=0.15, atol=3e3)


def test_the_result_is_in_e_per_s(restorer: Restorer, frame: np.ndarray, toy_scene: np.ndarray) -> None:
    picture = restorer.restore(frame, EXPOSURE_S)
    assert picture.shape == (54, 96, 3)
    assert picture.dtype == np.float32
    truth = restorer.rectification.apply(toy_scene) / EXPOSURE_S
    np.testing.assert_allclose(picture.mean(axis=(0, 1)), truth.mean(axis=(0, 1)), rtol=0.01)


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (lambda frame: frame[:-2], "128 x 96 samples"),
        (lambda frame: frame.astype(np.float32), "16-bit samples"),
        (lambda frame: frame[..., None], "rows x columns of uint16"),
        (lambda frame: np.full_like(frame, 40000), "12 bits"),
    ],
)
def test_frames_that_are_not_the_rigs_are_refused(
    toy_rig: RigDescription, frame: np.ndarray, broken: Callable[[np.ndarray], np.ndarray], message: str
) -> None:
    with pytest.raises(RestorationError, match=message):
        check_frame(broken(frame), EXPOSURE_S, toy_rig)


@pytest.mark.parametrize("exposure_s", [0.0, -1.0, float("nan")])
def test_an_exposure_must_be_positive(restorer: Restorer, frame: np.ndarray, exposure_s: float) -> None:
    with pytest.raises(RestorationError, match="positive exposure"):
        restorer.restore(frame, exposure_s)
    with pytest.raises(RestorationError, match="positive exposure"):
        restorer.before(frame, exposure_s)
    with pytest.raises(RestorationError, match="positive exposure"):
        restorer.display(frame, exposure_s, Tone(1e-5))


def test_panel_pictures_of_another_panel_are_refused(toy_rig: RigDescription) -> None:
    for picture in (np.zeros((27, 47, 3), np.uint8), np.zeros((27, 48, 3), np.float32)):
        with pytest.raises(RestorationError, match="48 x 27 8-bit RGB"):
            check_panel_picture(picture, toy_rig)
    check_panel_picture(None, toy_rig)
    check_panel_picture(np.zeros((27, 48, 3), np.uint8), toy_rig)


@pytest.mark.parametrize("tier", list(Tier))
@pytest.mark.parametrize("kind", ["black", "dark", "full", "half full", "hot columns", "one electron"])
def test_extreme_frames_end_well(restorers: dict[Tier, Restorer], frame: np.ndarray, tier: Tier, kind: str) -> None:
    odd = frame.copy()
    if kind in ("black", "dark", "full"):
        odd[:] = {"black": 0, "dark": 64, "full": 4095}[kind]
    elif kind == "half full":
        odd[:, :60] = 3969
    elif kind == "hot columns":
        odd[:, 30:33] = 3969
    else:
        odd = (64 + np.random.default_rng(3).poisson(0.4, frame.shape)).astype(np.uint16)
    assert np.isfinite(restorers[tier].restore(odd, EXPOSURE_S)).all()
