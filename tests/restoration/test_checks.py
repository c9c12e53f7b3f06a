"""What restoration is given from outside: each thing that is wrong is refused in a sentence."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.cameras.small_tiff import Shot, write_dng
from udccal.cli.jobs.explain import Frames, Plans, explain_plan
from udccal.cli.output import Output
from udccal.errors import FileFormatError, RestorationError
from udccal.io.png import write_png16
from udccal.profiles.profile import Profile
from udccal.profiles.store import write_profile
from udccal.restoration import one_frame
from udccal.restoration.checks import check_frame, check_panel_picture, check_raw_file
from udccal.restoration.deblur import deblur
from udccal.restoration.device.restorer import DeviceRestorer
from udccal.restoration.plan import PlanOptions
from udccal.restoration.runtime import Restorer
from udccal.restoration.scene_plan import Wish
from udccal.restoration.tone import Tone
from udccal.result import FitStatus
from udccal.rig import RigDescription
from udccal.tiers import Tier

pytestmark = pytest.mark.usefixtures("as_other_programs_call")
RIGHT = Shot(make="M", cfa="RGGB")


@pytest.fixture
def profile_folder(profile: Profile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("udccal.cli.jobs.explain.keep_compilations", lambda: None)
    write_profile(tmp_path / "profile", replace(profile, psf=replace(profile.psf, status=FitStatus.ABSENT)))
    return tmp_path / "profile"


def grey(profile: Profile) -> np.ndarray:
    return np.full((profile.rig.camera.rows, profile.rig.camera.columns), 900, np.uint16)


@pytest.mark.parametrize(
    ("shot", "message"),
    [
        (replace(RIGHT, cfa="GBRG"), r"colour pattern RGGB of rig 'lg55-reduced', found GBRG\. Use the profile"),
        (replace(RIGHT, white=16383), r"bits per sample 12 .* found 14\."),
        (replace(RIGHT, black=256), r"black level in DN 64 ± 8 .* found 256\."),
    ],
)
def test_a_raw_file_of_another_camera_is_refused(
    profile: Profile, profile_folder: Path, tmp_path: Path, shot: Shot, message: str
) -> None:
    write_dng(tmp_path / "frame.dng", grey(profile), shot)
    given = Frames([tmp_path / "frame.dng"], profile_folder, None, None)
    with pytest.raises(RestorationError, match=r"frame\.dng: Expected a raw file with the " + message):
        explain_plan(Output(), given, Plans(Tier.fast, None), None)


def test_a_file_of_one_pixel_is_refused(profile_folder: Path, tmp_path: Path) -> None:
    write_png16(tmp_path / "a.png", np.zeros((1, 1), np.uint16))
    given = Frames([tmp_path / "a.png"], profile_folder, None, 0.01)
    with pytest.raises(FileFormatError, match="96 x 64 samples, found 1 x 1"):
        explain_plan(Output(), given, Plans(Tier.fast, None), None)


@pytest.mark.parametrize("black_DN", [0.0, 56.0, 64.25, 72.0])
def test_a_black_level_may_be_off_by_its_tolerance_or_not_stated(profile: Profile, black_DN: float) -> None:
    check_raw_file("RGGB", 12, black_DN, profile)


@pytest.mark.medium
def test_the_command_refuses_what_does_not_fit(profile: Profile, profile_folder: Path, tmp_path: Path) -> None:
    write_dng(tmp_path / "right.dng", grey(profile), RIGHT)
    write_dng(tmp_path / "turned.dng", grey(profile), replace(RIGHT, cfa="BGGR"))
    write_png16(tmp_path / "frame.png", grey(profile))
    for words, status, found in (
        (["turned.dng"], 1, "found BGGR"),
        (["frame.png", "--exposure-s", "1e300"], 2, "'--exposure-s': Input should be less than or equal to 86400"),
        (["right.dng"], 0, None),
    ):
        command = [sys.executable, "-m", "udccal.cli.main", "restore", *words, "--profile", "profile", "--out", "out"]
        done = subprocess.run(
            [*command, "--tier", "preview", "--json"], capture_output=True, text=True, timeout=280, cwd=tmp_path
        )
        assert done.returncode == status, done.stderr
        assert (tmp_path / "out").exists() is (found is None)
        assert found is None or found in json.loads(done.stdout)["error"]


@pytest.mark.parametrize("exposure_s", [0, -1.0, 1e-10, 1e300, np.nan, np.inf, True, "0.01", None, np.array([0.01])])
def test_an_exposure_is_a_number_of_seconds(toy_rig: RigDescription, exposure_s: object) -> None:
    with pytest.raises(RestorationError, match=r"Expected a positive exposure in seconds from 1e-09 to 86400, found"):
        check_frame(np.zeros((96, 128), np.uint16), exposure_s, toy_rig)


@pytest.mark.parametrize("exposure_s", [1, 1e-9, np.float32(0.01), 86400.0])
def test_exposures_that_can_be_are_accepted(toy_rig: RigDescription, exposure_s: object) -> None:
    check_frame(np.zeros((96, 128), np.uint16), exposure_s, toy_rig)


@pytest.mark.parametrize(
    ("mosaic", "found"),
    [
        ([[64, 64], [64, 64]], "list"),
        (7, "int"),
        (None, "NoneType"),
        (np.zeros((96, 128), np.int32), r"int32 of shape \(96, 128\)"),
        (np.zeros((96, 128, 3), np.uint16), r"uint16 of shape \(96, 128, 3\)"),
    ],
)
def test_a_frame_is_an_array_of_16_bits(toy_rig: RigDescription, mosaic: object, found: str) -> None:
    with pytest.raises(RestorationError, match=f"rows x columns of uint16, found {found}. Give the raw frame"):
        check_frame(mosaic, 0.01, toy_rig)


@pytest.mark.parametrize("picture", [[[0, 0, 0]], 3, np.zeros((27, 48), np.uint8), np.zeros((27, 48, 4), np.uint8)])
def test_a_panel_picture_is_an_array_of_8_bits(toy_rig: RigDescription, picture: object) -> None:
    with pytest.raises(RestorationError, match="48 x 27 8-bit RGB pixels as the panel has, found"):
        check_panel_picture(picture, toy_rig)


def test_masked_entries_are_refused(toy_rig: RigDescription) -> None:
    """What lies under a mask was restored as if nobody had masked it."""
    frame, shown = (np.ma.masked_all(shape, kind) for shape, kind in (((96, 128), np.uint16), ((27, 48, 3), np.uint8)))
    with pytest.raises(RestorationError, match="a frame without masked entries, found 12288 of 12288 masked"):
        check_frame(frame, 0.01, toy_rig)
    with pytest.raises(RestorationError, match="a panel picture without masked entries"):
        check_panel_picture(shown, toy_rig)
    with pytest.raises(RestorationError, match="picture without masked entries"):
        deblur(np.ma.masked_all((96, 96, 3)), np.ones((1, 1, 3, 1, 1)), np.array([48.0]), np.array([48.0]))


def test_one_frame_is_checked_before_the_profile_is_prepared(profile: Profile, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("udccal.restoration.one_frame.Restorer", None)
    small = np.zeros((10, 10), np.uint16)
    with pytest.raises(RestorationError, match="Expected a frame of 96 x 64 samples"):
        one_frame.restore(small, 0.01, profile)
    with pytest.raises(RestorationError, match="Expected a panel picture of 32 x 24"):
        one_frame.restore(grey(profile), 0.01, profile, np.zeros((2, 2, 3), np.uint8))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"workers": 0}, r"PlanOptions\.workers as a whole number from 1 to 256, found 0"),
        ({"workers": True}, "PlanOptions.workers .* found True"),
        ({"workers": 2.0}, r"PlanOptions.workers .* found 2\.0"),
        ({"grid_rows": -1}, "PlanOptions.grid_rows .* found -1"),
        ({"kernel_rows": None}, "PlanOptions.kernel_rows .* found NoneType"),
        ({"tile_rows": 95}, "PlanOptions.tile_rows as a whole number from 96"),
        ({"grid_columns": np.nan}, "PlanOptions.grid_columns .* found nan"),
        ({"network_views": 5}, "PlanOptions.network_views as a whole number from 1 to 4"),
        ({"interpolation": "cubic"}, "to be one of Interpolation.LINEAR, .* found 'cubic'"),
        ({"interpolation": 2}, "to be one of .*Interpolation.CUBIC, .* found 2"),
        ({"kernel_rows": 256}, "PlanOptions.kernel_rows to be odd, found 256"),
    ],
)
def test_options_that_cannot_be_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(RestorationError, match=message):
        PlanOptions(**options)


@pytest.mark.parametrize("options", [{"workers": 2}, {}, 3])
def test_options_are_plan_options(profile: Profile, options: Any) -> None:
    with pytest.raises(RestorationError, match="Expected options as PlanOptions, found"):
        Restorer.from_profile(profile, Tier.fast, options)


@pytest.mark.parametrize("without", [None, "wire", {"wirre"}, {"wire", 3}, 7])
def test_stages_left_out_are_stages(profile: Profile, without: Any) -> None:
    with pytest.raises(RestorationError, match="Expected a set of stages, of wire and backscatter, found"):
        Restorer.from_profile(profile, Tier.preview, without=without)


def test_what_is_no_restorer_or_picture_is_refused() -> None:
    not_one: Any = "a"
    with pytest.raises(RestorationError, match="Expected a Restorer, found 'a'"):
        DeviceRestorer.of(not_one)
    for picture in ([1.0], None, np.zeros((2, 2)), np.zeros((2, 2, 3), complex)):
        with pytest.raises(RestorationError, match="a picture as an array of real numbers, rows x columns x 3, found"):
            Tone(1.0).rgb8(picture)


@pytest.mark.parametrize("exposure", [-1.0, np.nan, np.inf, True, "1"])
def test_a_tone_of_no_exposure_is_refused(exposure: Any) -> None:
    with pytest.raises(RestorationError, match=r"an exposure of the display from 0 to 1e\+30, found"):
        Tone(exposure)


@pytest.mark.parametrize("gains", [(1.0, 1.0, 1.0, 1.0), (), 1.0, [1.0, 1.0, 1.0]])
def test_a_tone_has_three_gains(gains: Any) -> None:
    with pytest.raises(RestorationError, match="a tuple of three gains"):
        Tone(1.0, gains)


@pytest.mark.parametrize("gain", [-0.1, np.nan, True, None])
def test_a_gain_is_a_number(gain: Any) -> None:
    with pytest.raises(RestorationError, match=r"a gain of a colour from 0 to 1e\+06, found"):
        Tone(1.0, (1.0, gain, 1.0))


@pytest.mark.parametrize("wish", [{"budget_ms": -1.0}, {"budget_ms": np.nan}, {"min_psnr_dB": np.inf}])
def test_a_wish_is_a_number(wish: Any) -> None:
    with pytest.raises(RestorationError, match=r"Expected a (budget in ms|least PSNR in dB) from 0 to"):
        Wish(**wish)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"picture": [[1, 2], [3]]}, "picture as an array of real numbers, found list"),
        ({"picture": None}, "picture as an array of real numbers, found NoneType"),
        ({"picture": np.ones((20, 30, 3)) * 1j}, "real numbers, found complex128"),
        ({"kernels": np.full((1, 1, 3, 4, 3), 1 / 12)}, "kernels of odd rows and columns, .* found 4 x 3"),
        ({"kernels": np.full((1, 1, 3, 3, 3), np.inf)}, "found others, NaN or infinity"),
        ({"kernels": np.zeros((0, 0, 3, 3, 3)), "x_px": [], "y_px": []}, "ascending places of 0 columns"),
        ({"x_px": 0.0}, r"found x_px of shape \(\) and y_px of \(1,\)"),
        ({"tile_px": True}, "tile_px as a whole number"),
        ({"workers": 0}, "workers as a whole number from 1 to 256, found 0"),
    ],
)
def test_what_cannot_be_deblurred_is_refused(given: dict[str, Any], message: str) -> None:
    right = {"picture": np.ones((20, 30, 3)), "kernels": np.full((1, 1, 3, 3, 3), 1 / 9), "x_px": [0.0], "y_px": [0.0]}
    assert np.allclose(deblur(**right), 1.0, atol=0.01)
    with pytest.raises(RestorationError, match=message):
        deblur(**{**right, **given})
