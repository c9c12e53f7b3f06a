from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from udccal.cfa import cfa_named
from udccal.errors import RestorationError
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.restoration.lowrank import KernelGrid
from udccal.restoration.metrics import display_exposure, encode_srgb, least_squares_gain, psnr
from udccal.restoration.plan import PlanOptions, build_deblurrers
from udccal.restoration.rectify import Rectification
from udccal.restoration.runtime import Restorer, check_frame, check_panel_picture
from udccal.restoration.view import inscribed_view
from udccal.rig import RigDescription

EXPOSURE_S = 0.01


@pytest.fixture(scope="module")
def restorer(toy_rig: RigDescription, toy_noise: Noise, toy_geometry: Geometry, toy_grid: KernelGrid) -> Restorer:
    camera, options = toy_rig.camera, PlanOptions(pad_rows=24, pad_columns=8, workers=1)
    view = inscribed_view(toy_geometry, camera.columns, camera.rows, toy_rig.view.columns, toy_rig.view.rows)
    y = np.mgrid[: camera.rows, : camera.columns][0]
    return Restorer(
        rig=toy_rig,
        noise=toy_noise,
        view=view,
        wire=(1 + 0.03 * np.sin(y / 5.0)).astype(np.float32),
        mask=np.full((camera.rows, camera.columns), 4.0e4, np.float32),
        response=None,
        deblurrers=build_deblurrers(toy_grid, toy_rig, options),
        rectification=Rectification.of(toy_geometry, view),
        options=options,
    )


@pytest.fixture(scope="module")
def frame(restorer: Restorer, toy_scene: np.ndarray) -> np.ndarray:
    """What the toy rig records of the toy scene: its own blur, wire and noise."""
    rng, rig = np.random.default_rng(1), restorer.rig
    planes = []
    for channel, deblurrer in enumerate(restorer.deblurrers):
        canvas = deblurrer.blur.canvas
        planes.append(canvas.frame(deblurrer.blur.forward(canvas.extended(toy_scene[..., channel]))))
    channels = cfa_named(rig.camera.cfa).channel_map(rig.camera.rows, rig.camera.columns)
    signal = np.take_along_axis(np.stack(planes, -1), channels[..., None], 2)[..., 0] * restorer.wire
    counts = rng.poisson(np.maximum(signal, 0.0)) + rng.normal(0, 5.0, signal.shape)
    return np.clip(np.rint(64 + 0.355 * counts), 0, 4095).astype(np.uint16)


def scores(restorer: Restorer, frame: np.ndarray, toy_scene: np.ndarray) -> tuple[float, float]:
    truth = restorer.rectification.apply(toy_scene) / EXPOSURE_S
    exposure = display_exposure(truth)
    before = restorer.before(frame, EXPOSURE_S)
    pictures = (before * least_squares_gain(before, truth), restorer.restore(frame, EXPOSURE_S))
    one, other = (psnr(encode_srgb(p * exposure), encode_srgb(truth * exposure)) for p in pictures)
    return one, other


def test_restoration_brings_the_scene_back(restorer: Restorer, frame: np.ndarray, toy_scene: np.ndarray) -> None:
    before_dB, after_dB = scores(restorer, frame, toy_scene)
    assert after_dB > before_dB + 3.0


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
        (lambda frame: frame[..., None], "of 3 dimensions"),
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


def test_panel_pictures_of_another_panel_are_refused(toy_rig: RigDescription) -> None:
    for picture in (np.zeros((27, 47, 3), np.uint8), np.zeros((27, 48, 3), np.float32)):
        with pytest.raises(RestorationError, match="48 x 27 8-bit RGB"):
            check_panel_picture(picture, toy_rig)
    check_panel_picture(None, toy_rig)
    check_panel_picture(np.zeros((27, 48, 3), np.uint8), toy_rig)


def test_a_saturated_and_a_dark_frame_end_well(restorer: Restorer, frame: np.ndarray) -> None:
    for level in (0, 64, 4095):
        assert np.isfinite(restorer.restore(np.full_like(frame, level), EXPOSURE_S)).all()
