from __future__ import annotations

import struct
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
import rawpy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.cameras.backends import picture
from tests.cameras.small_tiff import (
    Entry,
    Shot,
    directory,
    grey_entries,
    rational,
    shorts,
    text,
    whole,
    write_dng,
    write_tiff,
)
from udccal.cameras.picture_files.facts import Facts, read_facts
from udccal.cameras.picture_files.listing import pictures_in
from udccal.cameras.picture_files.raw import libraw_facts, raw_mosaic
from udccal.cameras.picture_files.sidecar import list_folder
from udccal.cameras.picture_files.tiff import read_tiff16
from udccal.errors import CameraError, FileFormatError, UdccalError
from udccal.io.png import write_png16

MOSAIC = picture(20, 30)


def write_grey(path: Path, *changed: Entry, mosaic: np.ndarray = MOSAIC) -> Path:
    tags = {entry.tag for entry in changed}
    entries = [entry for entry in grey_entries(mosaic) if entry.tag not in tags]
    write_tiff(path, [*entries, *(entry for entry in changed if entry.count)], mosaic.astype("<u2").tobytes())
    return path


# --- 16-bit TIFF


@pytest.mark.parametrize("compression", [1, 5, 8, 32946, 32773])
def test_tiff_is_read_without_loss(compression: int, tmp_path: Path) -> None:
    done, encoded = cv2.imencode(".tiff", MOSAIC, [cv2.IMWRITE_TIFF_COMPRESSION, compression])
    assert done
    (tmp_path / "a.tif").write_bytes(encoded.tobytes())
    np.testing.assert_array_equal(read_tiff16(tmp_path / "a.tif"), MOSAIC)


def test_tiff_written_field_by_field_is_read(tmp_path: Path) -> None:
    np.testing.assert_array_equal(read_tiff16(write_grey(tmp_path / "a.tif")), MOSAIC)


def test_tiff_in_tiles_is_read(tmp_path: Path) -> None:
    padded = np.zeros((32, 32), np.uint16)
    padded[:20, :30] = MOSAIC
    tiles = [padded[y : y + 16, x : x + 16] for y in (0, 16) for x in (0, 16)]
    samples = b"".join(tile.astype("<u2").tobytes() for tile in tiles)
    kept = [entry for entry in grey_entries(MOSAIC) if entry.tag not in (273, 278, 279)]
    for present in (4, 3):
        starts, lengths = [8 + 512 * index for index in range(present)], [512] * present
        entries = [*kept, whole(322, 16), whole(323, 16), whole(324, *starts), whole(325, *lengths)]
        write_tiff(tmp_path / f"{present}.tif", entries, samples)
    np.testing.assert_array_equal(read_tiff16(tmp_path / "4.tif"), MOSAIC)
    with pytest.raises(FileFormatError, match="damaged"):
        read_tiff16(tmp_path / "3.tif")


@pytest.mark.parametrize(
    ("entry", "found"),
    [
        (shorts(258, 8), "bits 8"),
        (shorts(277, 3), "channels 3"),
        (shorts(259, 7), "compression 7"),
        (shorts(262, 0), "photometric interpretation 0"),
        (shorts(262, 2), "photometric interpretation 2"),
        (Entry(262, 3, 0, b""), "photometric interpretation -1"),
        (shorts(339, 2), "sample format 2"),
        (shorts(274, 6), "orientation 6"),
        (whole(256, 0), "0 x 20"),
        (whole(257, 1 << 31), "30 x 2147483648"),
        (whole(256, 20_000), "20000 x 20"),
        (whole(273, 1 << 30), "damaged"),
        (whole(279, 1 << 30), "damaged"),
        (whole(279, 0), "damaged"),
        (whole(279, 600, 600), "damaged"),
        (whole(257, 21), "damaged"),
        (whole(278, 10), "damaged"),
        (whole(256, 31), "damaged"),
        (whole(324, 8), "damaged"),
        (Entry(273, 4, 0, b""), "damaged"),
    ],
)
def test_other_tiffs_are_refused(entry: Entry, found: str, tmp_path: Path) -> None:
    path = write_grey(tmp_path / "a.tif", entry)
    with pytest.raises(FileFormatError, match=rf"Expected .* found .*{found}"):
        read_tiff16(path)


def test_tiff_of_several_pictures_is_refused(tmp_path: Path) -> None:
    path = write_grey(tmp_path / "a.tif")
    content = bytearray(path.read_bytes())
    first = struct.unpack("<I", content[4:8])[0]
    count = struct.unpack("<H", content[first : first + 2])[0]
    struct.pack_into("<I", content, first + 2 + 12 * count, first)
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match="further pictures"):
        read_tiff16(path)


def test_tiff_cut_short_anywhere_is_refused(tmp_path: Path) -> None:
    whole_file = write_grey(tmp_path / "a.tif").read_bytes()
    # Header and directory before the samples, so that a cut leaves the directory whole.
    at = 8
    entries = [entry for entry in grey_entries(MOSAIC) if entry.tag != 273]
    length = len(directory([*entries, whole(273, 0)], at))
    front = struct.pack("<2sHI", b"II", 42, at) + directory([*entries, whole(273, at + length)], at)
    (tmp_path / "b.tif").write_bytes(front + MOSAIC.tobytes())
    np.testing.assert_array_equal(read_tiff16(tmp_path / "b.tif"), MOSAIC)
    for content in (whole_file, front + MOSAIC.tobytes()):
        for length in (0, 3, 8, 100, len(content) // 2, len(content) - 2):
            (tmp_path / "cut.tif").write_bytes(content[:length])
            with pytest.raises(FileFormatError, match=r"Expected .* found .*\."):
                read_tiff16(tmp_path / "cut.tif")


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.integers(0, 2000), value=st.binary(min_size=1, max_size=8))
def test_damaged_tiffs_are_read_or_refused(at: int, value: bytes, tmp_path: Path) -> None:
    content = bytearray(write_grey(tmp_path / "a.tif").read_bytes())
    at %= len(content)
    content[at : at + len(value)] = value
    (tmp_path / "a.tif").write_bytes(content)
    for read in (read_tiff16, read_facts):
        try:
            read(tmp_path / "a.tif")
        except FileFormatError:
            continue


# --- what files state


def test_facts_of_a_raw_file(tmp_path: Path) -> None:
    write_dng(tmp_path / "a.dng", MOSAIC, Shot((3, 200), 640, subseconds="123"))
    facts = read_facts(tmp_path / "a.dng")
    assert facts == Facts("Maker", "M1", "0042", 0.015, 640.0, 1714564800.123)


@pytest.mark.parametrize("exposure", [(0, 1), (1, 0), (0, 0), None])
def test_a_blank_exposure_is_none(exposure: tuple[int, int] | None, tmp_path: Path) -> None:
    write_dng(tmp_path / "a.dng", MOSAIC, Shot(exposure))
    assert read_facts(tmp_path / "a.dng").exposure_s is None


def test_blank_iso_and_impossible_times_are_none(tmp_path: Path) -> None:
    for taken in ("", "yesterday", "2024:13:01 12:00:00", "\0" * 19):
        write_dng(tmp_path / "a.dng", MOSAIC, Shot(iso=0, taken=taken))
        facts = read_facts(tmp_path / "a.dng")
        assert (facts.iso, facts.taken_s) == (None, None)


def test_sensitivities_beyond_16_bits_are_found(tmp_path: Path) -> None:
    write_tiff(tmp_path / "a.tif", grey_entries(MOSAIC), MOSAIC.tobytes(), [shorts(34855, 65535), whole(34867, 102400)])
    assert read_facts(tmp_path / "a.tif").iso == 102400.0


def test_fields_of_exif_may_stand_in_the_main_directory(tmp_path: Path) -> None:
    here = [rational(33434, Fraction(1, 8)), shorts(34855, 50), text(42033, "S7")]
    write_tiff(tmp_path / "a.tif", [*grey_entries(MOSAIC), *here], MOSAIC.tobytes(), [rational(33434, (0, 1))])
    facts = read_facts(tmp_path / "a.tif")
    assert (facts.exposure_s, facts.iso, facts.serial) == (0.125, 50.0, "S7")


def test_texts_are_short_and_printable(tmp_path: Path) -> None:
    write_dng(tmp_path / "a.dng", MOSAIC, Shot(make="M\x1b[2J\u00e9" + "x" * 500))
    vendor = read_facts(tmp_path / "a.dng").vendor
    assert len(vendor) == 100
    assert vendor.isprintable()


@pytest.mark.parametrize(
    "content",
    [
        b"II*\0",
        b"II*\0\xff\xff\xff\xff",
        b"II*\0\x08\0\0\0\xff\xff",
        b"II*\0\x08\0\0\0" + struct.pack("<H", 1) + struct.pack("<HHII", 271, 2, 1 << 31, 8) + bytes(4),
        b"II*\0\x08\0\0\0" + struct.pack("<H", 1) + struct.pack("<HHII", 34665, 4, 1, 1 << 30) + bytes(4),
        b"MM\0*\0\0\0\x08" + struct.pack(">H", 1) + struct.pack(">HHII", 271, 2, 60, 1 << 20) + bytes(4),
    ],
)
def test_fields_outside_the_file_are_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.dng").write_bytes(content)
    with pytest.raises(FileFormatError, match=r"Expected .* found .*\."):
        read_facts(tmp_path / "a.dng")


def test_fields_larger_than_any_camera_writes_are_not_read(tmp_path: Path) -> None:
    field = struct.pack("<HHII", 271, 2, 2 << 20, 64)
    with (tmp_path / "a.dng").open("wb") as file:
        file.write(b"II*\0\x08\0\0\0" + struct.pack("<H", 1) + field + bytes(4))
        file.truncate(8 << 20)
    with pytest.raises(FileFormatError, match="found 2097152 bytes at 64 of 8388608"):
        read_facts(tmp_path / "a.dng")


def test_libraw_is_believed_only_where_a_file_says_something(tmp_path: Path) -> None:
    write_dng(tmp_path / "a.dng", picture(48, 64), Shot((1, 50), 100))
    assert libraw_facts(tmp_path / "a.dng")[:2] == (pytest.approx(0.02), 100.0)
    write_dng(tmp_path / "b.dng", picture(48, 64), Shot((0, 1), 0))
    assert libraw_facts(tmp_path / "b.dng") == (None, None, None)
    (tmp_path / "c.raf").write_bytes(b"FUJIFILMCCD-RAW " + bytes(400))
    with pytest.raises(FileFormatError, match="whole camera raw file"):
        read_facts(tmp_path / "c.raf")


# LibRaw takes any file of 307 200 bytes for 640 x 480 samples of 8 bits, RGGB.
HEADERLESS = np.random.default_rng(5).integers(0, 256, 640 * 480, np.uint8).tobytes()


@pytest.mark.parametrize("start", [b"", b"IIII", b"MM\0\0"])
def test_a_raw_file_without_a_header_is_refused_though_libraw_guesses_one(start: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.RAW"
    path.write_bytes(start + HEADERLESS[len(start) :])
    with rawpy.imread(str(path)) as guessed:
        assert guessed.raw_image.shape == (480, 640)
    for read in (raw_mosaic, read_facts):
        with pytest.raises(FileFormatError, match=r"begin as a camera raw file .* found no header.*\. Convert it"):
            read(path)


@pytest.mark.parametrize(
    "start",
    [
        *(b"II*\0", b"MM\0*", b"IIU\0", b"IIRO", b"IIRS", b"MMOR", b"IIIITwaR", b"MMMMRawT"),
        *(b"FUJIFILM", b"\0MRM", b"\0\0\0\x18ftypcrx ", bytes(25) + b"ARECOYK"),
    ],
)
def test_headers_of_raw_files_are_left_to_libraw(start: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.raw").write_bytes(start + bytes(400))
    with pytest.raises(FileFormatError, match="whole camera raw file"):
        raw_mosaic(tmp_path / "a.raw")


# --- folders


def put(folder: Path, *names: str) -> Path:
    folder.mkdir(exist_ok=True)
    for name in names:
        write_png16(folder / name, MOSAIC)
    return folder


def test_pictures_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    put(tmp_path, "IMG_10.png", "IMG_9.png", "img_002.PNG", "a.png", "IMG_9b.png", ".hidden.png")
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / "IMG_9.jpg").write_text("x")
    names = [path.name for path in pictures_in(tmp_path)]
    assert names == ["a.png", "img_002.PNG", "IMG_9.png", "IMG_9b.png", "IMG_10.png"]


def test_a_table_says_order_exposure_gain_and_time(tmp_path: Path) -> None:
    put(tmp_path, "b.png", "a.png")
    (tmp_path / "frames.csv").write_text("file,exposure_s,gain_dB,timestamp_s\nb.png,0.25,6,10\na.png,1e-3,0,11.5\n")
    first, second = list_folder(tmp_path)
    assert (first.path.name, first.exposure_s, first.gain_dB, first.timestamp_s) == ("b.png", 0.25, 6.0, 10.0)
    assert (second.path.name, second.exposure_s, second.gain_dB, second.timestamp_s) == ("a.png", 1e-3, 0.0, 11.5)


@pytest.mark.parametrize("start", ["\ufeff", ""])
def test_a_table_may_leave_columns_out(start: str, tmp_path: Path) -> None:
    put(tmp_path, "a.png")
    (tmp_path / "frames.csv").write_text(f"{start}file,exposure_s\r\na.png,0.5\r\n", "utf-8")
    (listed,) = list_folder(tmp_path)
    assert (listed.exposure_s, listed.gain_dB, listed.timestamp_s) == (0.5, None, None)


def bad_tables() -> list[str | bytes]:
    header = "file,exposure_s\n"
    return [
        "",
        header,
        "exposure_s,file\n0.5,a.png\n",
        "file,exposure_s,iso\na.png,0.5,100\n",
        "file;exposure_s\na.png;0,5\n",
        header + "a.png\n",
        header + "a.png,0.5,0\n",
        header + "a.png,nan\n",
        header + "a.png,0\n",
        header + "a.png,-1\n",
        header + "a.png,inf\n",
        header + "a.png,1/60\n",
        header + '"a.png,0.5\n',
        header + "../a.png,0.5\n",
        header + "/etc/passwd,0.5\n",
        header + "b.png,0.5\n",
        header + "a.png,0.5\na.png,0.5\n",
        header + "a.png,0.5\nb.png,0.5\n",
        b"\xff\xfe\x00",
        header + "a.png,0.5\n" * 50_000,
        header + "x" * (5 << 20),
    ]


@pytest.mark.parametrize("table", bad_tables(), ids=range(len(bad_tables())))
def test_bad_tables_are_refused(table: str | bytes, tmp_path: Path) -> None:
    put(tmp_path, "a.png")
    (tmp_path / "frames.csv").write_bytes(table if isinstance(table, bytes) else table.encode())
    with pytest.raises(UdccalError, match=r"(?s)Expected .* found.* .*\.") as caught:
        list_folder(tmp_path)
    assert len(str(caught.value)) < 1000


def test_a_table_that_leaves_pictures_out_is_refused(tmp_path: Path) -> None:
    put(tmp_path, "a.png", "b.png")
    (tmp_path / "frames.csv").write_text("file,exposure_s\na.png,0.5\n")
    with pytest.raises(CameraError, match=r"found otherwise for b\.png"):
        list_folder(tmp_path)


@pytest.mark.parametrize("make", [Path.mkdir, Path.touch])
def test_folders_without_pictures_are_refused(make: Callable[[Path], None], tmp_path: Path) -> None:
    make(tmp_path / "empty")
    with pytest.raises(CameraError, match=r"(folder of pictures|pictures) .*found none"):
        list_folder(tmp_path / "empty")
