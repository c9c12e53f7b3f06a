from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from udccal.errors import FileFormatError
from udccal.io.exr import read_exr, read_rgb_exr, write_exr, write_rgb_exr


def planes(rows: int = 40, columns: int = 50) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {name: rng.normal(size=(rows, columns)).astype(np.float32) for name in ("mean", "variance")}


def test_channels_come_back_bit_for_bit(tmp_path: Path) -> None:
    written = planes()
    write_exr(tmp_path / "a.exr", written)
    found = read_exr(tmp_path / "a.exr")
    assert found.keys() == written.keys()
    for name, plane in written.items():
        assert found[name].dtype == np.float32
        np.testing.assert_array_equal(found[name], plane)


def test_rgb_keeps_its_order(tmp_path: Path) -> None:
    picture = np.random.default_rng(1).random((6, 8, 3)).astype(np.float32)
    write_rgb_exr(tmp_path / "a.exr", picture)
    np.testing.assert_array_equal(read_rgb_exr(tmp_path / "a.exr"), picture)


def test_a_picture_without_colour_is_refused_as_rgb(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", planes())
    with pytest.raises(FileFormatError, match=r"Expected channels R, G and B.*found mean, variance"):
        read_rgb_exr(tmp_path / "a.exr")


@pytest.mark.parametrize("kept", [0.0, 0.001, 0.05, 0.5, 0.999])
def test_truncated_files_are_refused(tmp_path: Path, kept: float) -> None:
    write_exr(tmp_path / "a.exr", planes())
    content = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(content[: int(kept * len(content))])
    with pytest.raises(FileFormatError, match=r"Expected .* OpenEXR file, found: .*Copy or capture it again"):
        read_exr(tmp_path / "a.exr")


def test_missing_and_foreign_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="found none"):
        read_exr(tmp_path / "none.exr")
    (tmp_path / "text.exr").write_text("not a picture")
    with pytest.raises(FileFormatError, match=r"Expected .* OpenEXR"):
        read_exr(tmp_path / "text.exr")


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_a_path_that_is_no_text_is_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="in UTF-8, found other bytes"):
        write_exr(tmp_path / "a\udcff.exr", planes())
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "a\udcff.exr").touch()
    with pytest.raises(FileFormatError, match="Rename the folder or file"):
        read_exr(tmp_path / "a\udcff.exr")


def test_a_header_that_claims_a_huge_picture_is_refused_before_reading(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", planes())
    content = bytearray((tmp_path / "a.exr").read_bytes())
    place = content.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    content[place + 8 : place + 12] = (200_000).to_bytes(4, "little")
    (tmp_path / "a.exr").write_bytes(content)
    with pytest.raises(FileFormatError):
        read_exr(tmp_path / "a.exr")


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_refused(tmp_path: Path, bad: float) -> None:
    written = planes()
    written["mean"][3, 4] = bad
    with pytest.raises(FileFormatError, match=r"finite numbers .* found NaN or infinity\. Check what they"):
        write_exr(tmp_path / "a.exr", written)
    assert list(tmp_path.iterdir()) == []


def test_channels_of_different_sizes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="one size"):
        write_exr(tmp_path / "a.exr", {"a": planes()["mean"], "b": planes(3, 4)["mean"]})


def test_shared_scenes_are_read(shared_data: Path) -> None:
    for path in sorted((shared_data / "hdr").glob("*.exr")):
        assert read_rgb_exr(path).max() > 0.5
