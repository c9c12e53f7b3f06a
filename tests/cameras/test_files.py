from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from udccal.cameras.files import FileCamera, read_raw
from udccal.cameras.protocol import Camera, Region, Settings
from udccal.errors import CameraError, FileFormatError
from udccal.io.exr import write_exr
from udccal.io.png import write_png16


@pytest.fixture
def pngs(tmp_path: Path) -> list[Path]:
    rng = np.random.default_rng(0)
    paths = [tmp_path / f"{index}.png" for index in range(3)]
    for path in paths:
        write_png16(path, rng.integers(0, 4096, (12, 16)).astype(np.uint16))
    return paths


def test_a_real_raw_file_is_a_frame(shared_data: Path) -> None:
    path = shared_data / "raw" / "colorchart.dng"
    mosaic = read_raw(path)
    assert (mosaic.black_DN, mosaic.saturation_DN, mosaic.cfa) == (2056.0, 15000, "RGGB")
    assert mosaic.data.shape == (1156, 1734)  # of 1182 x 1888 with the masked border
    with FileCamera([path]) as camera:
        assert isinstance(camera, Camera)
        assert camera.bits == 14
        (frame,) = camera.frames(1)
        np.testing.assert_array_equal(frame.data, mosaic.data)


def test_a_truncated_raw_file_is_refused(shared_data: Path, tmp_path: Path) -> None:
    content = (shared_data / "raw" / "colorchart.dng").read_bytes()
    (tmp_path / "half.dng").write_bytes(content[: len(content) // 2])
    with pytest.raises(FileFormatError, match="whole camera raw file"):
        read_raw(tmp_path / "half.dng")


def test_files_are_the_frames_in_order(pngs: list[Path]) -> None:
    with FileCamera(pngs, cfa="GBRG", bits=12) as camera:
        accepted = camera.configure(Settings(1.0, 0.0, Region(2, 4, 6, 8)))
        frames = list(camera.frames(3))
        assert [frame.frame_id for frame in frames] == [0, 1, 2]
        assert all(frame.settings.region == accepted.region for frame in frames)
        assert frames[0].data.shape == (8, 6)
        assert camera.cfa == "GBRG"
        with pytest.raises(CameraError, match="all 3 files are used"):
            next(camera.frames(1))


def test_an_exr_of_one_channel_is_a_frame(tmp_path: Path) -> None:
    data = np.arange(48, dtype=np.float32).reshape(6, 8)
    write_exr(tmp_path / "a.exr", {"Y": data})
    (frame,) = FileCamera([tmp_path / "a.exr"]).frames(1)
    np.testing.assert_array_equal(frame.data, data)
    write_exr(tmp_path / "b.exr", {"Y": data, "Z": data})
    with pytest.raises(FileFormatError, match="one channel"):
        FileCamera([tmp_path / "b.exr"])


def test_bad_lists_and_regions_are_refused(pngs: list[Path], tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="at least one file"):
        FileCamera([])
    with pytest.raises(CameraError, match="samples of 8 bits"):
        FileCamera(pngs, bits=8)
    with pytest.raises(CameraError, match="even-aligned region"):
        FileCamera(pngs).configure(Settings(1.0, 0.0, Region(1, 0, 4, 4)))
    write_png16(tmp_path / "small.png", np.zeros((4, 4), np.uint16))
    with pytest.raises(CameraError, match="size and pattern"):
        list(FileCamera([*pngs, tmp_path / "small.png"]).frames(4))
    with pytest.raises(FileFormatError, match=r"camera raw file at .*, found none"):
        FileCamera([tmp_path / "none.dng"])
