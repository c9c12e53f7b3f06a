from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from udccal.errors import RestorationError
from udccal.io.exr import read_rgb_exr
from udccal.io.png import read_rgb8
from udccal.restoration.metrics import least_squares_gain, psnr, ssim
from udccal.restoration.sinks import write_picture
from udccal.restoration.tone import Tone, display_exposure, encode_srgb, to_rgb8

RNG = np.random.default_rng(0)
PICTURE = (RNG.random((40, 50, 3)) * 5000).astype(np.float32)


def test_srgb_at_its_known_points() -> None:
    np.testing.assert_allclose(
        encode_srgb(np.array([-1.0, 0.0, 0.0031308, 0.2140, 1.0, 9.0])), [0, 0, 0.04045, 0.5, 1, 1], atol=2e-4
    )


def test_the_97th_percentile_is_shown_at_0_9() -> None:
    shown = encode_srgb(PICTURE * display_exposure(PICTURE))
    assert np.percentile(shown, 97) == pytest.approx(0.9, abs=1e-3)


def test_light_that_clips_is_white_however_much_there_is_of_it() -> None:
    lit = np.where(np.arange(40)[:, None, None] < 4, np.float32(6000.0), PICTURE)
    exposures = np.array([display_exposure(lit), display_exposure(lit, clips=6000.0)])
    np.testing.assert_allclose(encode_srgb(6000 * exposures), [0.9, 1.0], atol=1e-3)
    assert display_exposure(PICTURE, clips=8000.0) == display_exposure(PICTURE)


def test_gains_work_on_linear_light() -> None:
    even = np.full((2, 2, 3), 0.1, np.float32)
    shown = Tone(1.0, (1.0, 2.0, 0.5)).apply(even)
    np.testing.assert_allclose(shown[0, 0], encode_srgb(np.array([0.1, 0.2, 0.05])), atol=1e-6)


def test_psnr_and_ssim_know_good_from_bad() -> None:
    truth = cv2.GaussianBlur(RNG.random((60, 60, 3)), (0, 0), 2.0)
    assert psnr(truth + 0.1, truth) == pytest.approx(20.0, abs=0.01)
    assert ssim(truth, truth) == pytest.approx(1.0)
    assert psnr(truth, truth) == 120.0
    noisy = truth + RNG.normal(0, 0.05, truth.shape)
    assert ssim(noisy, truth) < 0.7 < ssim(truth + 0.01, truth)


def test_gains_are_found_back() -> None:
    np.testing.assert_allclose(least_squares_gain(PICTURE / np.array([2.0, 4.0, 0.5]), PICTURE), [2.0, 4.0, 0.5])


def test_pictures_are_written_as_their_name_says(tmp_path: Path) -> None:
    tone = Tone(display_exposure(PICTURE))
    write_picture(tmp_path / "a.exr", PICTURE, tone)
    write_picture(tmp_path / "a.png", PICTURE, tone)
    np.testing.assert_array_equal(read_rgb_exr(tmp_path / "a.exr"), PICTURE)
    np.testing.assert_array_equal(read_rgb8(tmp_path / "a.png"), to_rgb8(tone.apply(PICTURE)))


def test_other_forms_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RestorationError, match=r"Expected a picture name ending in"):
        write_picture(tmp_path / "a.jpg", PICTURE, Tone(1.0))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("exposure", [1e26, 1e30])
def test_a_tone_of_electrons_is_none_that_is_refused(exposure: float) -> None:
    assert Tone(exposure).of_electrons(1e-5) == Tone(1e30)
    assert Tone(3.0).of_electrons(0.5) == Tone(6.0)
    assert np.isfinite(Tone(exposure, (1e6, 1.0, 1.0)).of_electrons(1e-9).scale()).all()


def test_an_empty_picture_is_refused() -> None:
    with pytest.raises(RestorationError, match="Expected a picture, found one of 4 x 0 px"):
        Tone(1.0).rgb8(np.zeros((0, 4, 3), np.float32))


@pytest.mark.parametrize("picture", [np.full((2, 2, 3), np.nan), np.zeros((0, 2, 3))])
def test_a_picture_without_light_that_is_a_number_has_no_exposure(picture: np.ndarray) -> None:
    with pytest.raises(RestorationError, match="Expected a picture whose light is numbers"):
        display_exposure(picture)


def test_light_far_beyond_white_is_white() -> None:
    linear = np.array([[[1.0, 1e5, 1e30], [0.0, -1.0, 0.5]]], np.float32)
    tone = Tone(3.0)
    shown = tone.rgb8(linear)
    assert shown[0, 0].tolist() == [255, 255, 255]
    assert np.abs(shown.astype(int) - to_rgb8(tone.apply(linear))).max() <= 1


@pytest.mark.parametrize("light", [1e3, 1e4, 1e30, np.inf, -1e30])
def test_one_bright_place_changes_no_other(light: float) -> None:
    tone, bright = Tone(display_exposure(PICTURE)), PICTURE.copy()
    bright[7, 9] = light / tone.exposure if np.isfinite(light) else light
    given = bright.copy()
    expected = tone.rgb8(PICTURE)
    expected[7, 9] = 255 if light > 0 else 0
    np.testing.assert_array_equal(tone.rgb8(bright), expected)
    np.testing.assert_array_equal(bright, given)
