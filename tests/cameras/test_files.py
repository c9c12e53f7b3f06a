from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from tests.cameras.backends import picture
from tests.cameras.small_tiff import Shot, write_dng
from udccal.cameras.files import FileCamera
from udccal.cameras.picture_files.mosaics import read_raw
from udccal.cameras.protocol import Mode, Region, Settings, Trigger
from udccal.errors import CameraError, FileFormatError
from udccal.io.exr import write_exr
from udccal.io.png import write_png16

WHOLE = Region(0, 0, 16, 12)


@pytest.fixture
def pngs(tmp_path: Path) -> list[Path]:
    paths = [tmp_path / f"{index}.png" for index in range(3)]
    for seed, path in enumerate(paths):
        write_png16(path, picture(12, 16, seed))
    return paths


def dngs(folder: Path, *shots: Shot) -> list[Path]:
    paths = [folder / f"IMG_{index}.dng" for index in range(len(shots))]
    for seed, (path, shot) in enumerate(zip(paths, shots, strict=True)):
        write_dng(path, picture(48, 64, seed), shot)
    return paths


def test_a_real_raw_file_is_a_frame(shared_data: Path) -> None:
    path = shared_data / "raw" / "colorchart.dng"
    mosaic = read_raw(path)
    assert (mosaic.black_DN, mosaic.saturation_DN, mosaic.cfa) == (2056.0, 15000, "RGGB")
    assert mosaic.data.shape == (1156, 1734)  # of 1182 x 1888 with the masked border
    assert mosaic.exposure_s is None  # it writes 0 s, for which LibRaw says 1 s
    with FileCamera([path]) as camera:
        assert camera.bits == 14
        assert camera.mode == Mode("BayerRG14")
        assert (camera.identity.vendor, camera.identity.model) == ("Canon", "Canon EOS Kiss X4")
        (frame,) = camera.frames(1)
        np.testing.assert_array_equal(frame.data, mosaic.data)


def test_a_truncated_raw_file_is_refused(shared_data: Path, tmp_path: Path) -> None:
    content = (shared_data / "raw" / "colorchart.dng").read_bytes()
    (tmp_path / "half.dng").write_bytes(content[: len(content) // 2])
    with pytest.raises(FileFormatError, match="whole camera raw file"):
        read_raw(tmp_path / "half.dng")


@pytest.mark.parametrize("cfa", ["RGGB", "GRBG", "GBRG", "BGGR"])
def test_raw_files_say_their_pattern_and_settings(cfa: str, tmp_path: Path) -> None:
    paths = dngs(tmp_path, Shot((1, 250), 200, subseconds="5", cfa=cfa), Shot((1, 250), 200, cfa=cfa))
    with FileCamera(paths, exposure_s=None) as camera:
        assert (camera.cfa, camera.bits) == (cfa, 12)
        assert camera.identity.serial == "0042"
        first, second = camera.frames(2)
        assert first.settings == Settings(0.004, 0.0, Region(0, 0, 64, 48))
        np.testing.assert_array_equal(first.data, picture(48, 64, 0))
        np.testing.assert_array_equal(second.data, picture(48, 64, 1))
        # The clock of a camera that tells whole seconds may stand still, but not go back.
        assert (first.timestamp_s, second.timestamp_s) == (1714564800.5, 1714564800.5)


def test_gain_is_relative_to_the_first_file(tmp_path: Path) -> None:
    paths = dngs(tmp_path, Shot(iso=200), Shot(iso=400), Shot(iso=100), Shot(iso=None))
    with FileCamera(paths) as camera:
        gains = [frame.settings.gain_dB for frame in camera.frames(4)]
    assert gains == pytest.approx([0.0, 6.0206, -6.0206, 0.0], abs=1e-3)


def test_files_of_the_nearest_exposure_are_chosen(tmp_path: Path) -> None:
    exposures = ((1, 1000), (1, 100), (1, 10), (1, 100))
    with FileCamera(dngs(tmp_path, *(Shot(e) for e in exposures)), exposure_s=None) as camera:
        region = camera.sensor
        for asked, expected, indices in ((0.012, 0.01, [1, 3]), (1e-6, 1e-3, [0]), (50.0, 0.1, [2])):
            assert camera.configure(Settings(asked, 0.0, region)).exposure_s == expected
            frames = list(camera.frames(len(indices)))
            for frame, index in zip(frames, indices, strict=True):
                assert frame.settings.exposure_s == expected
                np.testing.assert_array_equal(frame.data, picture(48, 64, index))
            with pytest.raises(CameraError, match=f"all {len(indices)} files are used"):
                next(camera.frames(1))


def test_gain_goes_before_exposure(tmp_path: Path) -> None:
    paths = dngs(tmp_path, Shot((1, 100), 100), Shot((1, 10), 100), Shot((1, 100), 800))
    with FileCamera(paths) as camera:
        assert camera.configure(Settings(0.01, 17.0, camera.sensor)).gain_dB == pytest.approx(18.06, abs=0.01)
        assert camera.configure(Settings(0.2, 1.0, camera.sensor)) == Settings(0.1, 0.0, camera.sensor)


def test_configuring_begins_with_the_first_file_again(pngs: list[Path]) -> None:
    with FileCamera(pngs) as camera:
        for _ in range(2):
            camera.configure(Settings(1.0, 0.0, WHOLE))
            frames = list(camera.frames(3))
            assert [(f.data == picture(12, 16, seed)).all() for seed, f in enumerate(frames)] == [True] * 3
        assert frames[-1].frame_id == 5


def test_opening_begins_with_the_first_of_all_files_again(tmp_path: Path) -> None:
    camera = FileCamera(dngs(tmp_path, Shot((1, 1000)), Shot((1, 100)), Shot((1, 100))))
    for _ in range(2):
        with camera:
            exposures = [frame.settings.exposure_s for frame in camera.frames(3)]
            assert exposures == [0.001, 0.01, 0.01]
            camera.configure(Settings(0.01, 0.0, camera.sensor))
            next(camera.frames(1))


def test_files_that_do_not_say_their_exposure_can_be_refused(pngs: list[Path], tmp_path: Path) -> None:
    assert FileCamera(pngs, exposure_s=0.25).features.exposure_s.high == 0.25
    for paths in (pngs, dngs(tmp_path, Shot((0, 1))), dngs(tmp_path, Shot(None)), dngs(tmp_path, Shot((1, 0)))):
        with pytest.raises(CameraError, match="found neither"):
            FileCamera(paths, exposure_s=None)


@pytest.mark.parametrize("exposure_s", [0.0, -1.0, float("nan"), float("inf")])
def test_an_exposure_for_all_files_that_is_none_is_refused(exposure_s: float, pngs: list[Path]) -> None:
    with pytest.raises(CameraError, match=r"Expected an exposure above 0 s .*, found .*\. Use"):
        FileCamera(pngs, exposure_s=exposure_s)


def test_files_of_another_camera_are_refused(tmp_path: Path) -> None:
    for other in (Shot(serial="0043"), Shot(model="M2"), Shot(make="Other")):
        with pytest.raises(CameraError, match=r"files of one camera \(Maker M1 0042\)"):
            FileCamera(dngs(tmp_path, Shot(), other))


def test_loading_other_files_keeps_the_camera(pngs: list[Path], tmp_path: Path) -> None:
    (tmp_path / "more").mkdir()
    write_png16(tmp_path / "more" / "a.png", picture(12, 16, 9))
    with FileCamera(pngs) as camera:
        stream = camera.frames(3)
        next(stream)
        camera.load(tmp_path / "more")
        with pytest.raises(CameraError, match="began another one"):
            next(stream)
        (frame,) = camera.frames(1)
        np.testing.assert_array_equal(frame.data, picture(12, 16, 9))
        with pytest.raises(CameraError, match="files of one camera"):
            camera.load(dngs(tmp_path, Shot()))


def test_an_exr_of_one_channel_is_a_frame(tmp_path: Path) -> None:
    data = np.arange(48, dtype=np.float32).reshape(6, 8)
    write_exr(tmp_path / "a.exr", {"Y": data})
    with FileCamera([tmp_path / "a.exr"]) as camera:
        (frame,) = camera.frames(1)
    np.testing.assert_array_equal(frame.data, data)
    write_exr(tmp_path / "b.exr", {"Y": data, "Z": data})
    with pytest.raises(FileFormatError, match="one channel"):
        FileCamera([tmp_path / "b.exr"])
    write_exr(tmp_path / "c.exr", {"Y": data - 1})
    with pytest.raises(FileFormatError, match="one channel"):
        FileCamera([tmp_path / "c.exr"])


def test_odd_pictures_are_cut_to_whole_cells(tmp_path: Path) -> None:
    write_png16(tmp_path / "odd.png", picture(13, 17))
    with FileCamera([tmp_path / "odd.png"]) as camera:
        assert camera.sensor == WHOLE
        (frame,) = camera.frames(1)
        np.testing.assert_array_equal(frame.data, picture(13, 17)[:12, :16])


def test_mode_is_that_of_the_files(pngs: list[Path]) -> None:
    with FileCamera(pngs, cfa="BGGR", bits=12) as camera:
        assert camera.mode == Mode("BayerBG12")
        assert (camera.cfa, camera.bits) == ("BGGR", 12)
        for mode in (Mode("BayerRG12"), Mode("BayerBG12", 10.0), Mode("BayerBG12", trigger=Trigger.SOFTWARE)):
            with pytest.raises(CameraError, match=r"Expected .* found"):
                camera.set_mode(mode)
    assert FileCamera(pngs, cfa="mono").mode == Mode("Mono16")


def test_times_are_those_of_the_files_but_never_fall(pngs: list[Path]) -> None:
    for path, seconds in zip(pngs, (100, 50, 200), strict=True):
        os.utime(path, (seconds, seconds))
    with FileCamera(pngs) as camera:
        assert [frame.timestamp_s for frame in camera.frames(3)] == [100.0, 100.0, 200.0]


@pytest.mark.parametrize(("cfa", "bits"), [("RGBG", 12), ("", 12), ("RGGB", 0), ("RGGB", 17), ("X" * 10_000, 12)])
def test_layouts_that_no_camera_has_are_refused(cfa: str, bits: int, pngs: list[Path]) -> None:
    with pytest.raises(CameraError, match="pattern of mono, RGGB") as caught:
        FileCamera(pngs, cfa, bits)
    assert len(str(caught.value)) < 300


def test_bad_lists_and_files_are_refused(pngs: list[Path], tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="at least one file"):
        FileCamera([])
    with pytest.raises(FileFormatError, match="samples of 8 bits"):
        FileCamera(pngs, bits=8)
    with pytest.raises(CameraError, match="folder of pictures"):
        FileCamera(tmp_path / "nowhere")
    write_png16(tmp_path / "small.png", picture(4, 4))
    with FileCamera([*pngs, tmp_path / "small.png"]) as camera, pytest.raises(CameraError, match="size, pattern"):
        list(camera.frames(4))
    for name in ("none.dng", "none.png", "none.tif", "none.exr"):
        with pytest.raises(FileFormatError, match=r"at .*, found none"):
            FileCamera([tmp_path / name])


def test_files_that_go_bad_later_are_refused_when_they_are_due(pngs: list[Path], tmp_path: Path) -> None:
    with FileCamera([*pngs, *pngs]) as camera:
        stream = camera.frames(6)
        next(stream)
        pngs[1].write_bytes(pngs[1].read_bytes()[:-20])
        with pytest.raises(FileFormatError, match="cut short"):
            next(stream)
    paths = dngs(tmp_path, Shot(), Shot())
    with FileCamera(paths) as camera:
        write_dng(paths[1], picture(48, 64), Shot(cfa="BGGR"))
        with pytest.raises(CameraError, match="size, pattern and bits"):
            list(camera.frames(2))
